//! Decodes a body, complete or incomplete.

use std::ops::Range;

use cosurf_scene::splats::sh_coefficients;
use cosurf_scene::{Camera, LocalFrame, Splats};
use cosurf_wire::body::{
    BodyError, BodyPlan, CameraRecord, HEAD_BYTES, LOG_SCALE_MAX, Pack, PackKind, SHAPE_FRAME_BYTES,
    ShLayout, Shape, ShapeFrame, SplatPacks, decode_origin, plan_bytes, read_changes, read_shapes,
};
use cosurf_wire::{ModelHeader, ModelKind};
use glam::DVec3;

use super::basis::Basis;
use super::pack::unpack;
use super::shapes::{FloatShape, dequantise};
use crate::body::{BodyFault, Model, camera};
use crate::manifest::Manifest;

/// If one in k splats has arrived, the axes of these splats are multiplied by k to this power. A power of one
/// half would keep the covered area. The splats that arrive first are the most important ones and larger than
/// average, so this smaller power gave the best PSNR.
const GROWTH_EXPONENT: f32 = 0.25;

/// Checks a complete body against its header: all sizes, all packs, and that every mean is within the bounds
/// up to quantisation. Does not check the hash. Unpacks at most two packs at a time, which limits the memory.
pub fn check_body(header: &ModelHeader, body: &[u8]) -> Result<(), BodyFault> {
    if header.kind == ModelKind::Manifest {
        return Manifest::decode(body).map(|_| ());
    }
    let plan = BodyPlan::of_whole(body)?;
    check_header(&plan, header)?;
    let mut unpacker = Unpacker::new(plan, body);
    unpacker.origin()?;
    unpacker.cameras()?;
    for SplatPacks { shapes, changes, .. } in plan.splat_packs() {
        unpacker.visit_shapes(&shapes, changes.as_ref(), |_| ())?;
    }
    if let Some(basis) = unpacker.basis()? {
        for pack in plan.packs_of(PackKind::Sh) {
            unpacker.unpack(&pack, basis.layout)?;
        }
    }
    Ok(())
}

/// Checks that the counts, the degree and the bounds in the body's head agree with the header.
fn check_header(plan: &BodyPlan<'_>, header: &ModelHeader) -> Result<(), BodyFault> {
    let own = plan.head();
    let announced = (header.splats, header.cameras, header.sh_degree, header.bounds);
    let agrees = (own.splats, own.cameras, own.sh_degree, own.bounds) == announced;
    if agrees { Ok(()) } else { Err(BodyFault::NotAsAnnounced) }
}

/// The frame of a complete body's splats: the body's origin and the world's unit.
pub fn body_frame(body: &[u8]) -> Result<LocalFrame, BodyFault> {
    Ok(Unpacker::new(BodyPlan::of_whole(body)?, body).origin()?)
}

/// The frame of the splats of a body of `size` bytes, and its cameras, in the world. `beginning` is as much of the body as
/// was read; `None` if that is too little. Checks nothing else of the body.
pub(crate) fn body_cameras(
    beginning: &[u8],
    size: u64,
) -> Result<Option<(LocalFrame, Vec<Camera>)>, BodyFault> {
    let is_here = |range: Range<usize>| range.end <= beginning.len();
    let Some(plan) = received_plan(beginning, size, is_here)? else { return Ok(None) };
    let mut packs = plan.packs_of(PackKind::Origin).chain(plan.packs_of(PackKind::Cameras));
    if !packs.all(|pack| is_here(pack.range)) {
        return Ok(None);
    }
    let mut unpacker = Unpacker::new(plan, beginning);
    let frame = unpacker.origin()?;
    Ok(Some((frame, unpacker.cameras()?.iter().map(camera).collect())))
}

/// The frame in which the scene of a complete body is near the origin and of an ordinary size: that of its cameras, or, if
/// it has none, that of its splats.
pub fn scene_frame(body: &[u8]) -> Result<LocalFrame, BodyFault> {
    let mut unpacker = Unpacker::new(BodyPlan::of_whole(body)?, body);
    let cameras: Vec<Camera> = unpacker.cameras()?.iter().map(camera).collect();
    match cameras[..] {
        [] => Ok(unpacker.origin()?),
        _ => Ok(LocalFrame::of(cameras.iter())),
    }
}

/// Decodes a complete body into a frame. Makes the same checks as [`check_body`], except that it has no header to compare
/// with.
pub fn body_to_model(body: &[u8], frame: &LocalFrame) -> Result<Model, BodyFault> {
    let plan = BodyPlan::of_whole(body)?;
    let (its, model) = decode_model(plan, body, |_| true)?;
    Ok(moved(model, &its, frame))
}

/// Moves a model, whose cameras are in the world, from the frame `its` of its body into another one.
fn moved(model: Model, its: &LocalFrame, frame: &LocalFrame) -> Model {
    let Model { mut splats, mut cameras } = model;
    its.move_splats(&mut splats, frame);
    cameras.iter_mut().for_each(|camera| *camera = frame.local_camera(camera));
    Model { splats, cameras }
}

/// Decodes the packs of a body that have arrived into a frame; `None` if no splats have arrived, or not their origin.
/// `body` has its full size, and `is_here` tells whether a byte range of it has arrived. More packs give more splats and
/// view-dependent colour.
///
/// If the body has a base, the base splats stand in for missing ones. Otherwise, the splats that have arrived
/// are enlarged.
pub fn part_to_model(
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
    frame: &LocalFrame,
) -> Result<Option<Model>, BodyFault> {
    let Some(plan) = received_plan(body, body.len() as u64, &is_here)? else { return Ok(None) };
    let part = decode_part(plan, body, is_here)?;
    Ok(part.map(|(its, model)| moved(model, &its, frame)))
}

/// Like [`part_to_model`], but decodes into the body's own frame, which is returned, and also checks that the body's head
/// agrees with the header. `body` may lack its end.
pub(crate) fn checked_part_to_model(
    header: &ModelHeader,
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<(LocalFrame, Model)>, BodyFault> {
    let Some(plan) = received_plan(body, header.body_bytes, &is_here)? else { return Ok(None) };
    check_header(&plan, header)?;
    let part = decode_part(plan, body, is_here)?;
    Ok(part.map(|(its, model)| (its, moved(model, &its, &its))))
}

/// Reads the plan (head and table) of an incomplete body of `size` bytes; `None` if the head or the table has not arrived.
fn received_plan(
    body: &[u8],
    size: u64,
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<BodyPlan<'_>>, BodyError> {
    let Some(head) = body.first_chunk().filter(|_| is_here(0..HEAD_BYTES)) else { return Ok(None) };
    let plan_bytes = plan_bytes(head);
    if plan_bytes as u64 > size {
        return Err(BodyError::Truncated);
    }
    if !is_here(0..plan_bytes) {
        return Ok(None);
    }
    let plan = BodyPlan::new(body)?;
    let expected = plan.body_bytes();
    if expected != size {
        return Err(BodyError::WrongSize { expected, found: size });
    }
    Ok(Some(plan))
}

/// As [`decode_model`], of the packs that have arrived. Enlarges the splats if there is no base. `None` if no splats have
/// arrived, or not their origin.
fn decode_part(
    plan: BodyPlan<'_>,
    body: &[u8],
    is_here: impl Fn(Range<usize>) -> bool,
) -> Result<Option<(LocalFrame, Model)>, BodyFault> {
    if plan.packs_of(PackKind::Origin).any(|pack| !is_here(pack.range)) {
        return Ok(None);
    }
    let total = plan.head().splats as usize;
    let (frame, mut model) = decode_model(plan, body, |pack| is_here(pack.range.clone()))?;
    if !plan.has_base() {
        enlarge(&mut model.splats, total);
    }
    Ok((!model.splats.is_empty()).then_some((frame, model)))
}

/// Enlarges the splats that have arrived so that they stand in for all `total` splats of the model.
fn enlarge(splats: &mut Splats, total: usize) {
    let growth = GROWTH_EXPONENT * libm::logf(total as f32 / splats.len().max(1) as f32);
    for log_scale in &mut splats.log_scales {
        *log_scale = log_scale.map(|v| (v + growth).min(LOG_SCALE_MAX));
    }
}

/// Decodes packs into the body's own frame, which is returned. The cameras are in the world.
fn decode_model(
    plan: BodyPlan<'_>,
    body: &[u8],
    is_here: impl Fn(&Pack) -> bool,
) -> Result<(LocalFrame, Model), BodyFault> {
    let mut unpacker = Unpacker::new(plan, body);
    let frame = unpacker.origin()?;
    let sh_degree = plan.head().sh_degree;
    let packs_here = || {
        let here = plan
            .splat_packs()
            .filter(|packs| is_here(&packs.shapes) && packs.required_changes.as_ref().is_none_or(&is_here));
        // Spherical harmonics belong to the final form of a base splat, so they are not used before its
        // changes arrive.
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
        unpacker.visit_shapes(&shapes, changes.as_ref(), |splat| {
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
                        basis.dequantise(|k| basis.layout.read(planes, count, i, k), &mut row[3..]);
                    }
                }
                Some(_) => rows.for_each(|row| row[3..].copy_from_slice(basis.mean())),
                None => rows.for_each(drop),
            }
        }
    }
    let cameras_here = plan.packs_of(PackKind::Cameras).all(|pack| is_here(&pack));
    let cameras = if cameras_here { unpacker.cameras()? } else { Vec::new() };
    Ok((frame, Model { splats, cameras: cameras.iter().map(camera).collect() }))
}

/// Unpacks one pack after another into the same buffers.
struct Unpacker<'a> {
    plan: BodyPlan<'a>,
    body: &'a [u8],
    unpacked: Vec<u8>,
    /// The unpacked changes to the shapes that are in `unpacked`.
    changes: Vec<u8>,
}

impl<'a> Unpacker<'a> {
    fn new(plan: BodyPlan<'a>, body: &'a [u8]) -> Self {
        Self { plan, body, unpacked: Vec::new(), changes: Vec::new() }
    }

    /// Unpacks a pack. `layout` matters only for packs of spherical harmonics.
    fn unpack(&mut self, pack: &Pack, layout: ShLayout) -> Result<&[u8], BodyError> {
        unpack_into(&mut self.unpacked, &self.plan, self.body, pack, layout)?;
        Ok(&self.unpacked)
    }

    /// Unpacks the only pack of a kind; `None` if the body has none.
    fn unpack_only(&mut self, kind: PackKind) -> Result<Option<&[u8]>, BodyError> {
        let Some(pack) = self.plan.packs_of(kind).next() else { return Ok(None) };
        self.unpack(&pack, ShLayout::NONE).map(Some)
    }

    /// The frame of the splats.
    fn origin(&mut self) -> Result<LocalFrame, BodyError> {
        let Some(bytes) = self.unpack_only(PackKind::Origin)? else { return Ok(LocalFrame::WORLD) };
        let bytes = bytes.first_chunk().ok_or(BodyError::BadPack)?;
        Ok(LocalFrame::at(DVec3::from_array(decode_origin(bytes)?)))
    }

    fn cameras(&mut self) -> Result<Vec<CameraRecord>, BodyFault> {
        let Some(bytes) = self.unpack_only(PackKind::Cameras)? else { return Ok(Vec::new()) };
        let cameras: Vec<CameraRecord> = bytes.as_chunks().0.iter().map(CameraRecord::decode).collect();
        match cameras.iter().position(|camera| !camera.is_sane()) {
            Some(index) => Err(BodyFault::Camera { index }),
            None => Ok(cameras),
        }
    }

    fn basis(&mut self) -> Result<Option<Basis>, BodyError> {
        let sh_degree = self.plan.head().sh_degree;
        self.unpack_only(PackKind::Basis)?.map(|bytes| Basis::decode(sh_degree, bytes)).transpose()
    }

    /// Calls `visit` with each splat of a shapes pack, after applying `changes` if given. A splat outside the
    /// bounds is an error.
    fn visit_shapes(
        &mut self,
        pack: &Pack,
        changes: Option<&Pack>,
        mut visit: impl FnMut(&FloatShape),
    ) -> Result<(), BodyFault> {
        let bounds = self.plan.head().bounds;
        if let Some(changes) = changes {
            unpack_into(&mut self.changes, &self.plan, self.body, changes, ShLayout::NONE)?;
        }
        unpack_into(&mut self.unpacked, &self.plan, self.body, pack, ShLayout::NONE)?;
        let unpacked = self.unpacked.split_first_chunk::<SHAPE_FRAME_BYTES>();
        let (frame, planes) = unpacked.ok_or(BodyError::BadPack)?;
        let frame = ShapeFrame::decode(frame)?;
        // Quantisation moves a mean at most one step out of the bounds. Rounding to `f32` moves it a little
        // further.
        let tolerance = 1.5 * libm::exp2f(f32::from(frame.step_exponent));
        let checked = |index: usize, shape: &Shape| {
            let mut splat = dequantise(&frame, shape);
            let inside = bounds.clamp(splat.mean);
            if (0..3).any(|k| (inside[k] - splat.mean[k]).abs() > tolerance) {
                return Err(BodyFault::OutOfBounds { index });
            }
            splat.mean = inside;
            Ok(splat)
        };
        let mut changes = changes.map(|_| read_changes(&self.changes));
        for (index, shape) in read_shapes(planes).enumerate() {
            let unchanged = checked(index, &shape)?;
            match changes.as_mut().and_then(Iterator::next) {
                Some(change) => visit(&checked(index, &shape.changed(&change))?),
                None => visit(&unchanged),
            }
        }
        Ok(())
    }
}

/// Unpacks a pack into a buffer that is reused. The plan has checked the sizes, which limits the buffer.
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
