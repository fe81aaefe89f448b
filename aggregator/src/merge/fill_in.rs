//! Adds models that have arrived only in part to a merged model: coarse ground is better than none.
//!
//! The part of a model that has arrived holds the most important splats, because these are sent first
//! ([`cosurf_link::part_to_model`]). These splats are added only where fewer than two cameras of the merged model look,
//! so that a coarse part cannot spoil better ground. Such a part is not used as a teacher in distillation, because it
//! would teach blur. Once its upload is complete, the model is merged like any other.

use cosurf_link::Model;
use cosurf_scene::{Frustum, Splats};
use glam::DVec3;

use super::concat::concatenate;

/// A splat of a part is added if fewer cameras of the merged model than this see it. Ground that only a single camera
/// saw may be missing from that camera's model.
const OWNER_CAMERAS_MIN: usize = 2;

/// Adds to `model` the splats of `part` that fewer than two cameras of `model` see, and all cameras of `part`.
pub fn fill_in(model: Model, part: &Model) -> Model {
    let Model { splats, cameras } = part;
    let frusta: Vec<Frustum> = model.cameras.iter().map(Frustum::new).collect();
    let is_left_over = |i: &usize| {
        let mean = DVec3::from_array(splats.means[*i].map(f64::from));
        frusta.iter().filter(|frustum| frustum.contains(mean)).take(OWNER_CAMERAS_MIN).count()
            < OWNER_CAMERAS_MIN
    };
    let mut kept = Splats::with_capacity(splats.len(), splats.sh_degree);
    (0..splats.len()).filter(is_left_over).for_each(|i| kept.push_from(splats, i));
    concatenate(&[model, Model { splats: kept, cameras: cameras.clone() }])
}
