//! Models of which only a part has arrived when models are merged: better a coarse piece of ground than none.
//!
//! What has arrived of a model is its most important splats ([`cosurf_link::part_to_model`]). They are put beside what
//! the whole models were merged to, where nobody else has been, and teach nobody, for they would teach a blur. Ground
//! that whole models show is left to them, so what is wrong with a part cannot spoil it. When the rest arrives the
//! model takes its own place.

use cosurf_link::Model;
use cosurf_scene::{Frustum, Splats};
use glam::DVec3;

use super::concat::concatenate;

/// Cameras that must see ground for it to be left to what is there: what a single one sees it may not show.
const OWNER_CAMERAS_MIN: usize = 2;

/// Adds what a part shows to a model, where hardly any of the model's cameras looks.
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
