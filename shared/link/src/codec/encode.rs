//! A model to a body.

use std::io;
use std::mem::take;

use cosurf_scene::{Base, Camera, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::{BodyHead, CAMERA_BYTES, POSITION_MAX, PackKind};

use super::harmonics::{Harmonics, harmonics};
use super::layers::{by_base, by_importance};
use super::order::plain_importance;
use super::packs::Packs;
use crate::body::{BodyFault, camera_record};

/// What goes first.
#[derive(Clone, Copy, Debug)]
pub enum First<'a> {
    /// The splats that matter most; a number for each, in any unit.
    Important(&'a [f32]),
    /// A base that stands in for the whole.
    Base(&'a Base),
}

/// Packs splats and cameras into a body. The box around the means is told with it.
///
/// # Panics
/// Where there are not as many importances as splats, or the base is not one of these splats.
pub fn model_to_body(splats: &Splats, cameras: &[Camera], first: First) -> Result<Vec<u8>, BodyFault> {
    check(splats, cameras)?;
    if let First::Base(base) = first
        && let Some(bad) = base.splats.find_bad_value()
    {
        return Err(BodyFault::Splat { index: base.ids[bad.splat] as usize, field: bad.field });
    }
    let bounds = bounds_of(&splats.means);
    let packs = packed(splats, cameras, first, &bounds).map_err(|_| BodyFault::Unpackable)?;
    let head = BodyHead {
        splats: splats.len() as u32,
        cameras: cameras.len() as u32,
        sh_degree: splats.sh_degree as u8,
        packs: u16::try_from(packs.len()).map_err(|_| BodyFault::TooMany)?,
        bounds,
    };
    Ok(packs.into_body(&head))
}

fn packed(splats: &Splats, cameras: &[Camera], first: First, bounds: &Bounds) -> io::Result<Packs> {
    let mut packs = Packs::default();
    add_cameras(&mut packs, cameras)?;
    let shapes = match first {
        First::Base(base) if !base.ids.is_empty() => by_base(splats, base, bounds)?,
        First::Base(_) => by_importance(splats, &plain_importance(splats), bounds)?,
        First::Important(importance) => by_importance(splats, importance, bounds)?,
    };
    let Harmonics { basis, packs: mut sh } =
        harmonics(splats, &shapes.groups, packs.body_bytes() + shapes.bytes())?;
    packs.append(basis);
    packs.append(shapes.first);
    for (part, groups) in shapes.parts {
        packs.append(part);
        for group in groups {
            sh.get_mut(group).map(take).into_iter().for_each(|its| packs.append(its));
        }
    }
    Ok(packs)
}

fn add_cameras(packs: &mut Packs, cameras: &[Camera]) -> io::Result<()> {
    if cameras.is_empty() {
        return Ok(());
    }
    let mut bytes = vec![0; cameras.len() * CAMERA_BYTES];
    for (camera, out) in cameras.iter().zip(bytes.as_chunks_mut().0) {
        camera_record(camera).encode(out);
    }
    packs.add(PackKind::Cameras, 0, 0, &[], &bytes)
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
