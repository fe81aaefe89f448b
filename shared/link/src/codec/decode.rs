//! A body to a model: all of it, or what has arrived.

use std::ops::Range;

use cosurf_scene::Splats;
use cosurf_scene::splats::sh_coefficients;
use cosurf_wire::ModelHeader;
use cosurf_wire::body::{
    BodyError, BodyPlan, CameraRecord, HEAD_BYTES, LOG_SCALE_MAX, Pack, PackKind, SHAPE_FRAME_BYTES,
    ShLayout, Shape, ShapeFrame, SplatPacks, plan_bytes, read_changes, read_shapes,
};

use super::basis::Basis;
use super::pack::unpack;
use super::shapes::{Form, unround};
use crate::body::{BodyFault, Model, camera};

/// Where only one splat in k is here its lengths grow by k to this power. To cover the same area it would be a
/// half; but the most important splats are the larger ones, and a quarter gave the best PSNR on trained models
/// (at a fifth of the bytes, 1 to 4 dB more than none).
const GROWTH: f32 = 0.25;

/// Checks all of a body against its announcement: sizes, every pack, every mean inside the bounds. Allocates
/// for one pack at a time.
pub fn check_body(header: &ModelHeader, body: &[u8]) -> Result<(), BodyFault> {
    let plan = BodyPlan::of_whole(body)?;
    check_announced(&plan, header)?;
    let mut unpacker = Unpacker::new(plan, body);
    unpacker.cameras()?;
    for SplatPacks { shapes, changes, .. } in plan.splat_packs() {
        unpacker.shapes(&shapes, changes.as_ref(), |_| ())?;
    }
    if let Some(basis) = unpacker.basis()? {
        for pack in plan.packs_of(PackKind::Sh) {
            unpacker.unpack(&pack, basis.layout)?;
        }
    }
    Ok(())
}

fn check_announced(plan: &BodyPlan<'_>, header: &ModelHeader) -> Result<(), BodyFault> {
    let own = plan.head();
    let announced = (header.splats, header.cameras, header.sh_degree, header.bounds);
    let is_so = (own.splats, own.cameras, own.sh_degree, own.bounds) == announced;
    if is_so { Ok(()) } else { Err(BodyFault::NotAsAnnounced) }
}

/// Unpacks a body, checking all but its agreement with an announcement.
pub fn body_to_model(body: &[u8]) -> Result<Model, BodyFault> {
    let plan = BodyPlan::of_whole(body)?;
    model(plan, body, |_| true)
}

/// Unpacks what has arrived of a body: `is_here` tells of any range of `body`, which is as long as the whole,
/// whether its bytes are right. `None` as long as no splat is there. What comes later adds splats and colours
/// that depend on the direction.
///
/// Where splats are missing, those of a base are what stands in for them; without a base those that are here are made
/// larger ([`GROWTH`]).
pub fn part_to_model(
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<Model>, BodyFault> {
    let Some(plan) = plan_here(body, &is_here)? else { return Ok(None) };
    part(plan, body, is_here)
}

/// The same of a body that was announced, if it is what was announced.
pub(crate) fn announced_part(
    header: &ModelHeader,
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<Model>, BodyFault> {
    let Some(plan) = plan_here(body, &is_here)? else { return Ok(None) };
    check_announced(&plan, header)?;
    part(plan, body, is_here)
}

/// What is where in a body; `None` where that has not arrived.
fn plan_here(body: &[u8], is_here: impl Fn(Range<usize>) -> bool) -> Result<Option<BodyPlan<'_>>, BodyError> {
    let Some(head) = body.first_chunk().filter(|_| is_here(0..HEAD_BYTES)) else { return Ok(None) };
    let plan_bytes = plan_bytes(head);
    if plan_bytes > body.len() {
        return Err(BodyError::Truncated);
    }
    if !is_here(0..plan_bytes) {
        return Ok(None);
    }
    let plan = BodyPlan::new(body)?;
    let (expected, found) = (plan.body_bytes(), body.len() as u64);
    if expected != found {
        return Err(BodyError::WrongSize { expected, found });
    }
    Ok(Some(plan))
}

fn part(
    plan: BodyPlan<'_>,
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<Model>, BodyFault> {
    let whole = plan.head().splats as usize;
    let mut model = model(plan, body, |pack| is_here(pack.range.clone()))?;
    if !plan.has_base() {
        stand_in(&mut model.splats, whole);
    }
    Ok((!model.splats.is_empty()).then_some(model))
}

/// Makes splats larger, in proportion, to stand in for the rest of `whole`.
fn stand_in(splats: &mut Splats, whole: usize) {
    let growth = GROWTH * (whole as f32 / splats.len().max(1) as f32).ln();
    for log_scale in &mut splats.log_scales {
        *log_scale = log_scale.map(|v| (v + growth).min(LOG_SCALE_MAX));
    }
}

fn model(plan: BodyPlan<'_>, body: &[u8], is_here: impl Fn(&Pack) -> bool) -> Result<Model, BodyFault> {
    let mut unpacker = Unpacker::new(plan, body);
    let sh_degree = plan.head().sh_degree;
    let packs_here = || {
        let here = plan
            .splat_packs()
            .filter(|packs| is_here(&packs.shapes) && packs.room.as_ref().is_none_or(&is_here));
        // A base has colours of its own until it changes.
        here.map(|packs| match &packs.changes {
            Some(changes) if !is_here(changes) => SplatPacks { changes: None, sh: None, ..packs },
            _ => packs,
        })
    };
    let count = |packs: &SplatPacks| usize::from(packs.shapes.entry.splats);
    let splats_here = packs_here().map(|packs| count(&packs)).sum();
    let mut splats = Splats::with_capacity(splats_here, u32::from(sh_degree));
    let mut sh = vec![0.0; splats.sh_stride()];
    for SplatPacks { shapes, changes, .. } in packs_here() {
        unpacker.shapes(&shapes, changes.as_ref(), |splat| {
            sh[..3].copy_from_slice(&splat.color);
            splats.push(splat.mean, splat.quat, splat.log_scale, splat.opacity_logit, &sh);
        })?;
    }
    if plan.packs_of(PackKind::Basis).all(|pack| is_here(&pack))
        && let Some(basis) = unpacker.basis()?
    {
        let stride = 3 * sh_coefficients(u32::from(sh_degree));
        let mut rows = splats.sh.chunks_exact_mut(stride);
        for packs in packs_here() {
            let count = count(&packs);
            let rows = rows.by_ref().take(count);
            match &packs.sh {
                Some(pack) if is_here(pack) => {
                    let planes = unpacker.unpack(pack, basis.layout)?;
                    for (i, row) in rows.enumerate() {
                        basis.unround(|k| basis.layout.read(planes, count, i, k), &mut row[3..]);
                    }
                }
                Some(_) => rows.for_each(|row| row[3..].copy_from_slice(basis.mean())),
                None => rows.for_each(drop),
            }
        }
    }
    let cameras_here = plan.packs_of(PackKind::Cameras).all(|pack| is_here(&pack));
    let cameras = if cameras_here { unpacker.cameras()? } else { Vec::new() };
    Ok(Model { splats, cameras: cameras.iter().map(camera).collect() })
}

/// Unpacks one pack after the other into the same memory.
struct Unpacker<'a> {
    plan: BodyPlan<'a>,
    body: &'a [u8],
    unpacked: Vec<u8>,
    /// Changes of what is unpacked.
    changes: Vec<u8>,
}

impl<'a> Unpacker<'a> {
    fn new(plan: BodyPlan<'a>, body: &'a [u8]) -> Self {
        Self { plan, body, unpacked: Vec::new(), changes: Vec::new() }
    }

    /// What a pack unpacks to.
    fn unpack(&mut self, pack: &Pack, layout: ShLayout) -> Result<&[u8], BodyError> {
        unpack_into(&mut self.unpacked, &self.plan, self.body, pack, layout)?;
        Ok(&self.unpacked)
    }

    fn only(&mut self, kind: PackKind) -> Result<Option<&[u8]>, BodyError> {
        let Some(pack) = self.plan.packs_of(kind).next() else { return Ok(None) };
        self.unpack(&pack, ShLayout::NONE).map(Some)
    }

    fn cameras(&mut self) -> Result<Vec<CameraRecord>, BodyFault> {
        let Some(bytes) = self.only(PackKind::Cameras)? else { return Ok(Vec::new()) };
        let cameras: Vec<CameraRecord> = bytes.as_chunks().0.iter().map(CameraRecord::decode).collect();
        match cameras.iter().position(|camera| !camera.is_sane()) {
            Some(index) => Err(BodyFault::Camera { index }),
            None => Ok(cameras),
        }
    }

    fn basis(&mut self) -> Result<Option<Basis>, BodyError> {
        let sh_degree = self.plan.head().sh_degree;
        self.only(PackKind::Basis)?.map(|bytes| Basis::decode(sh_degree, bytes)).transpose()
    }

    /// Visits the splats of a pack as its `changes` make them, if they are here.
    fn shapes(
        &mut self,
        pack: &Pack,
        changes: Option<&Pack>,
        mut visit: impl FnMut(&Form),
    ) -> Result<(), BodyFault> {
        let bounds = self.plan.head().bounds;
        if let Some(changes) = changes {
            unpack_into(&mut self.changes, &self.plan, self.body, changes, ShLayout::NONE)?;
        }
        unpack_into(&mut self.unpacked, &self.plan, self.body, pack, ShLayout::NONE)?;
        let unpacked = self.unpacked.split_first_chunk::<SHAPE_FRAME_BYTES>();
        let (frame, planes) = unpacked.ok_or(BodyError::BadPack)?;
        let frame = ShapeFrame::decode(frame)?;
        // Rounding takes a mean a step out of the bounds at most, and 32 bits a little more.
        let reach = 1.5 * f32::from(frame.step_exponent).exp2();
        let sane = |index: usize, shape: &Shape| {
            let mut form = unround(&frame, shape);
            let inside = bounds.clamp(form.mean);
            if (0..3).any(|k| (inside[k] - form.mean[k]).abs() > reach) {
                return Err(BodyFault::OutOfBounds { index });
            }
            form.mean = inside;
            Ok(form)
        };
        let mut changes = changes.map(|_| read_changes(&self.changes));
        for (index, shape) in read_shapes(planes).enumerate() {
            let base = sane(index, &shape)?;
            match changes.as_mut().and_then(Iterator::next) {
                Some(change) => visit(&sane(index, &shape.changed(&change))?),
                None => visit(&base),
            }
        }
        Ok(())
    }
}

/// Unpacks a pack into memory that is used again. The sizes in the plan bound what this takes.
fn unpack_into(
    unpacked: &mut Vec<u8>,
    plan: &BodyPlan,
    body: &[u8],
    pack: &Pack,
    layout: ShLayout,
) -> Result<(), BodyError> {
    let bytes = body.get(pack.range.clone()).ok_or(BodyError::Truncated)?;
    unpacked.resize(plan.unpacked_bytes(&pack.entry, layout), 0);
    unpack(&pack.entry, bytes, unpacked)
}
