//! Uses models that have arrived only in part when models are merged: coarse ground is better than none.
//!
//! The part of a model that has arrived holds its most important splats ([`cosurf_link::part_to_model`]). They are
//! added to the merged model where no whole model has ground, so errors of a part cannot spoil ground of whole models.
//! A part is no teacher, because it would teach blur. Once the upload completes, the model is merged as a whole.

use cosurf_link::Model;
use cosurf_scene::{Frustum, Splats};
use glam::DVec3;

use super::concat::concatenate;

/// Ground that fewer cameras of the merged model see is filled in: a model may not show what a single camera saw.
const OWNER_CAMERAS_MIN: usize = 2;

/// Adds the splats of `part` to `model` where hardly any of the model's cameras looks.
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
