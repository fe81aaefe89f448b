//! A model to a body.

use std::io;

use cosurf_scene::{Camera, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::{
    BodyHead, CAMERA_BYTES, HEAD_BYTES, PACK_ENTRY_BYTES, PACK_SPLATS_MAX, POSITION_MAX, PackEntry, PackKind,
    SHAPE_BYTES, SHAPE_FRAME_BYTES, Shape, write_shapes,
};

use super::basis::Basis;
use super::order::layers;
use super::pack::{entry, pack};
use super::shapes;
use crate::body::{BodyFault, camera_record};

/// Bytes of a splat, cameras included: the spherical harmonics get what the rest leaves.
const SPLAT_BYTES: f64 = 15.7;
/// Most bytes of a splat, where the spherical harmonics can give way.
const SPLAT_BYTES_MAX: f64 = 15.95;
/// Bytes that the spherical harmonics of a splat get at least, and at most.
const SH_BYTES: [f64; 2] = [2.0, 5.0];
/// Entropy of a coefficient's statistics beside the bytes that zstd makes of it.
const CODED: f64 = 0.97;

/// Packs splats and cameras into a body, the most important splats first; `importance` has a number for each
/// splat, in any unit. The box around the means is told with it.
///
/// # Panics
/// Where there are not as many importances as splats.
pub fn model_to_body(splats: &Splats, cameras: &[Camera], importance: &[f32]) -> Result<Vec<u8>, BodyFault> {
    check(splats, cameras)?;
    let bounds = bounds_of(&splats.means);
    let layers = layers(&splats.means, importance, &bounds);
    let groups = groups(&layers);
    let mut packs = Packs::default();
    let packed = packs
        .add_cameras(cameras)
        .and_then(|()| packs.add_shapes(splats, &groups))
        .and_then(|()| packs.add_sh(splats, &groups));
    packed.map_err(|_| BodyFault::Unpackable)?;
    let head = BodyHead {
        splats: splats.len() as u32,
        cameras: cameras.len() as u32,
        sh_degree: splats.sh_degree as u8,
        packs: u16::try_from(packs.entries.len()).map_err(|_| BodyFault::TooMany)?,
        bounds,
    };
    Ok(packs.into_body(&head))
}

fn check(splats: &Splats, cameras: &[Camera]) -> Result<(), BodyFault> {
    if u32::try_from(splats.len()).is_err() || u32::try_from(cameras.len()).is_err() {
        return Err(BodyFault::TooMany);
    }
    if let Some(bad) = splats.find_bad_value() {
        return Err(BodyFault::Splat { index: bad.splat, field: bad.field });
    }
    let is_far = |mean: &[f32; 3]| mean.iter().any(|v| v.abs() > POSITION_MAX);
    if let Some(index) = splats.means.iter().position(is_far) {
        return Err(BodyFault::Splat { index, field: "mean" });
    }
    match cameras.iter().position(|camera| !camera_record(camera).is_sane()) {
        Some(index) => Err(BodyFault::Camera { index }),
        None => Ok(()),
    }
}

/// The box around `means`; the origin where there are none.
fn bounds_of(means: &[[f32; 3]]) -> Bounds {
    let Some(&first) = means.first() else {
        return Bounds { min: [0.0; 3], max: [0.0; 3] };
    };
    let fold = |pick: fn(f32, f32) -> f32| {
        means.iter().fold(first, |corner, mean| std::array::from_fn(|k| pick(corner[k], mean[k])))
    };
    Bounds { min: fold(f32::min), max: fold(f32::max) }
}

/// Splats that share a pack.
struct Group<'a> {
    layer: u8,
    ids: &'a [u32],
}

/// Cuts each layer into packs of nearly the same size.
fn groups(layers: &[Vec<u32>]) -> Vec<Group<'_>> {
    let cut = |(layer, ids): (usize, &'_ Vec<u32>)| {
        let packs = ids.len().div_ceil(PACK_SPLATS_MAX).max(1);
        (layer, ids.len().div_ceil(packs).max(1))
    };
    layers
        .iter()
        .enumerate()
        .flat_map(|(layer, ids)| {
            let (layer, size) = cut((layer, ids));
            ids.chunks(size).map(move |ids| Group { layer: layer as u8, ids })
        })
        .collect()
}

/// Packs and their entries.
#[derive(Default)]
struct Packs {
    entries: Vec<PackEntry>,
    bytes: Vec<u8>,
}

impl Packs {
    fn add(
        &mut self,
        kind: PackKind,
        layer: u8,
        splats: usize,
        frame: &[u8],
        planes: &[u8],
    ) -> io::Result<()> {
        let plane_bytes = if splats > 0 { splats } else { planes.len() };
        let (form, bytes) = pack(frame, planes, plane_bytes)?;
        self.entries.push(entry(kind, layer, splats, form, &bytes));
        self.bytes.extend_from_slice(&bytes);
        Ok(())
    }

    fn add_cameras(&mut self, cameras: &[Camera]) -> io::Result<()> {
        if cameras.is_empty() {
            return Ok(());
        }
        let mut bytes = vec![0; cameras.len() * CAMERA_BYTES];
        for (camera, out) in cameras.iter().zip(bytes.as_chunks_mut().0) {
            camera_record(camera).encode(out);
        }
        self.add(PackKind::Cameras, 0, 0, &[], &bytes)
    }

    fn add_shapes(&mut self, splats: &Splats, groups: &[Group]) -> io::Result<()> {
        for Group { layer, ids } in groups {
            let frame = shapes::frame(splats, ids);
            let mut head = [0; SHAPE_FRAME_BYTES];
            frame.encode(&mut head);
            let rounded: Vec<Shape> =
                ids.iter().map(|&i| shapes::round(&frame, splats, i as usize)).collect();
            let mut planes = vec![0; ids.len() * SHAPE_BYTES];
            write_shapes(&rounded, &mut planes);
            self.add(PackKind::Shapes, *layer, ids.len(), &head, &planes)?;
        }
        Ok(())
    }

    fn add_sh(&mut self, splats: &Splats, groups: &[Group]) -> io::Result<()> {
        if splats.sh_degree == 0 || groups.is_empty() {
            return Ok(());
        }
        let spent = self.bytes.len() as f64 / splats.len() as f64;
        let bytes = (SPLAT_BYTES - spent).clamp(SH_BYTES[0], SH_BYTES[1]);
        let (entries_before, bytes_before) = (self.entries.len(), self.bytes.len());
        self.add_sh_of(splats, groups, bytes)?;
        // The basis, the table and what small packs cost beside their statistics is known only now.
        let over = self.body_bytes() as f64 / splats.len() as f64 - SPLAT_BYTES_MAX;
        if over > 0.0 && bytes > SH_BYTES[0] {
            self.entries.truncate(entries_before);
            self.bytes.truncate(bytes_before);
            self.add_sh_of(splats, groups, (bytes - over).max(SH_BYTES[0]))?;
        }
        Ok(())
    }

    /// Adds them in about so many bytes a splat.
    fn add_sh_of(&mut self, splats: &Splats, groups: &[Group], bytes: f64) -> io::Result<()> {
        let order: Vec<u32> = groups.iter().flat_map(|group| group.ids).copied().collect();
        let basis = Basis::learn(splats, &order, 8.0 * bytes * CODED);
        self.add(PackKind::Basis, 0, 0, &basis.encode(splats.sh_degree as u8), &[])?;
        for Group { layer, ids } in groups {
            let mut steps = Vec::with_capacity(ids.len() * usize::from(basis.layout.components));
            ids.iter().for_each(|&i| basis.round(&splats.sh_of(i as usize)[3..], &mut steps));
            let mut planes = vec![0; ids.len() * basis.layout.splat_bytes()];
            basis.layout.write(&steps, &mut planes);
            self.add(PackKind::Sh, *layer, ids.len(), &[], &planes)?;
        }
        Ok(())
    }

    fn body_bytes(&self) -> usize {
        HEAD_BYTES + self.entries.len() * PACK_ENTRY_BYTES + self.bytes.len()
    }

    fn into_body(self, head: &BodyHead) -> Vec<u8> {
        let mut body = vec![0; head.packs_at()];
        for (entry, out) in self.entries.iter().zip(body[HEAD_BYTES..].as_chunks_mut::<PACK_ENTRY_BYTES>().0)
        {
            entry.encode(out);
        }
        head.encode(&mut body);
        body.extend_from_slice(&self.bytes);
        body
    }
}
