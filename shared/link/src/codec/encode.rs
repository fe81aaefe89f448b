//! Encodes a model as a body.

use std::io;
use std::mem::take;

use cosurf_scene::{Base, Camera, LocalFrame, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::{BodyHead, CAMERA_BYTES, ORIGIN_MAX, POSITION_MAX, PackKind, encode_origin};
use glam::DVec3;

use super::harmonics::{Harmonics, pack_harmonics};
use super::layers::{pack_by_base, pack_by_importance};
use super::order::plain_importance;
use super::packs::Packs;
use crate::body::{BodyFault, camera_record};

/// Which splats a body contains in its first layer.
#[derive(Clone, Copy, Debug)]
pub enum FirstLayer<'a> {
    /// The most important splats. The slice has the importance of each splat, in any unit.
    ByImportance(&'a [f32]),
    /// A base, which stands in for the whole model until the rest arrives. If the base is empty, the first
    /// layer has the most important splats, as estimated by [`plain_importance`].
    Base(&'a Base),
}

/// Encodes the splats and cameras of a frame as a body. The body has the frame's origin and the world's unit; its cameras
/// are in the world.
///
/// # Panics
/// If the number of importances differs from the number of splats, or the indices of the base do not belong
/// to these splats.
pub fn model_to_body(
    splats: &Splats,
    cameras: &[Camera],
    frame: &LocalFrame,
    first: FirstLayer,
) -> Result<Vec<u8>, BodyFault> {
    let files = frame.of_files();
    if *frame != files {
        // A scene of another size than usual: rare, so its copy costs nobody much.
        let moved = |splats: &Splats| {
            let mut splats = splats.clone();
            frame.move_splats(&mut splats, &files);
            splats
        };
        let base = match first {
            FirstLayer::Base(base) => Some(Base { splats: moved(&base.splats), ..base.clone() }),
            FirstLayer::ByImportance(_) => None,
        };
        let first = base.as_ref().map_or(first, FirstLayer::Base);
        let moved_camera = |camera| files.local_camera(&frame.world_camera(camera));
        let cameras: Vec<Camera> = cameras.iter().map(moved_camera).collect();
        return model_to_body(&moved(splats), &cameras, &files, first);
    }
    let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.world_camera(camera)).collect();
    check(splats, &cameras)?;
    if frame.origin().abs().max_element() > ORIGIN_MAX {
        return Err(BodyFault::Origin);
    }
    if let FirstLayer::Base(base) = first
        && let Some(bad) = base.splats.find_bad_value()
    {
        return Err(BodyFault::Splat { index: base.ids[bad.splat] as usize, field: bad.field });
    }
    let bounds = bounds_of(&splats.means);
    let packs =
        pack_model(splats, &cameras, frame.origin(), first, &bounds).map_err(|_| BodyFault::Unpackable)?;
    let head = BodyHead {
        splats: splats.len() as u32,
        cameras: cameras.len() as u32,
        sh_degree: splats.sh_degree as u8,
        packs: u16::try_from(packs.len()).map_err(|_| BodyFault::TooMany)?,
        bounds,
    };
    Ok(packs.into_body(&head))
}

fn pack_model(
    splats: &Splats,
    cameras: &[Camera],
    origin: DVec3,
    first: FirstLayer,
    bounds: &Bounds,
) -> io::Result<Packs> {
    let mut packs = Packs::default();
    if origin != DVec3::ZERO {
        packs.add(PackKind::Origin, 0, 0, &[], &encode_origin(origin.to_array()))?;
    }
    add_cameras(&mut packs, cameras)?;
    let shapes = match first {
        FirstLayer::Base(base) if !base.ids.is_empty() => pack_by_base(splats, base, bounds)?,
        FirstLayer::Base(_) => pack_by_importance(splats, &plain_importance(splats), bounds)?,
        FirstLayer::ByImportance(importance) => pack_by_importance(splats, importance, bounds)?,
    };
    let Harmonics { basis, packs: mut sh } =
        pack_harmonics(splats, &shapes.groups, packs.body_bytes() + shapes.bytes())?;
    packs.append(basis);
    packs.append(shapes.first);
    for (part, groups) in shapes.parts {
        packs.append(part);
        for group in groups {
            sh.get_mut(group).map(take).into_iter().for_each(|own| packs.append(own));
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
    let is_too_far = |mean: &[f32; 3]| mean.iter().any(|v| v.abs() > POSITION_MAX);
    if let Some(index) = splats.means.iter().position(is_too_far) {
        return Err(BodyFault::Splat { index, field: "mean" });
    }
    match cameras.iter().position(|camera| !camera_record(camera).is_sane()) {
        Some(index) => Err(BodyFault::Camera { index }),
        None => Ok(()),
    }
}

/// The bounding box of `means`, or a box of size zero at the origin if there are none.
fn bounds_of(means: &[[f32; 3]]) -> Bounds {
    let Some(&first) = means.first() else {
        return Bounds { min: [0.0; 3], max: [0.0; 3] };
    };
    let fold = |pick: fn(f32, f32) -> f32| {
        means.iter().fold(first, |corner, mean| std::array::from_fn(|k| pick(corner[k], mean[k])))
    };
    Bounds { min: fold(f32::min), max: fold(f32::max) }
}
