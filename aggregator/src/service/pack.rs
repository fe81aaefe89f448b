//! Encodes global models, the splats first that are most important to the cameras.
//!
//! The importance is judged by so many pictures of such a size that neither many cameras nor large ones, which any listed
//! device may claim, take much time or memory.

use cosurf_engine::Renderer;
use cosurf_link::{FirstLayer, Model, model_to_body, plain_importance};
use cosurf_scene::{Camera, LocalFrame, evenly_spaced};
use tracing::debug_span;

use crate::merge::MergeError;

/// Largest number of cameras whose pictures count. Of more, evenly spaced ones are taken.
const VIEWS_MAX: usize = 1024;
/// Longest side of their pictures, px. Larger pictures are made smaller.
const SIDE_MAX_PX: u32 = 1024;

/// Encodes a global model, which is in `frame`, as a body, unless `is_stopped`.
pub(crate) fn packed(
    model: &Model,
    frame: &LocalFrame,
    threads: usize,
    is_stopped: &dyn Fn() -> bool,
) -> Result<Vec<u8>, MergeError> {
    let _span = debug_span!("pack", splats = model.splats.len()).entered();
    let importance = importance(model, threads, is_stopped)?;
    let first = FirstLayer::ByImportance(&importance);
    Ok(model_to_body(&model.splats, &model.cameras, frame, first)?)
}

/// The importance of each splat to the model's cameras; without cameras, [`plain_importance`].
pub(super) fn importance(
    model: &Model,
    threads: usize,
    is_stopped: &dyn Fn() -> bool,
) -> Result<Vec<f32>, MergeError> {
    let views = evenly_spaced(&model.cameras, VIEWS_MAX);
    let views: Vec<Camera> = views.iter().map(|camera| camera.fitted(SIDE_MAX_PX)).collect();
    match views[..] {
        [] => Ok(plain_importance(&model.splats)),
        _ => {
            let mut renderer = Renderer::new(&model.splats, threads);
            renderer.importance_unless(&views, is_stopped).ok_or(MergeError::GivenUp)
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::part_to_model;

    use super::*;
    use crate::merge::concatenate;
    use crate::testing::{above, ground};

    #[test]
    fn the_most_important_splats_go_first() {
        let seen = Model { splats: ground(-2.0, 2.0), cameras: vec![above(0.0)] };
        let mut unseen = Model { splats: ground(60.0, 64.0), cameras: Vec::new() };
        unseen.splats.log_scales.iter_mut().flatten().for_each(|log_scale| *log_scale += 1.0);
        let body = packed(&concatenate(&[unseen, seen]), &LocalFrame::WORLD, 1, &|| false).unwrap();
        let part =
            part_to_model(&body, |range| range.end <= body.len() / 2, &LocalFrame::WORLD).unwrap().unwrap();
        assert!(!part.splats.is_empty());
        assert!(
            part.splats.means.iter().all(|mean| mean[0] < 30.0),
            "larger splats that no camera sees went first"
        );
    }

    /// At their full size, these pictures would take 6 GB. Only some of the cameras count, and the work can be stopped.
    #[test]
    fn huge_pictures_and_many_cameras_are_judged_in_bounded_time_and_memory() {
        let huge = above(0.0).resized([16_384; 2]);
        let model = Model { splats: ground(-2.0, 2.0), cameras: vec![huge; 20_000] };
        let asked = std::cell::Cell::new(0);
        let is_stopped = || {
            asked.set(asked.get() + 1);
            asked.get() > 3
        };
        assert!(matches!(packed(&model, &LocalFrame::WORLD, 1, &is_stopped), Err(MergeError::GivenUp)));
        assert_eq!(asked.get(), 4, "it is asked before each camera");
        assert_eq!(evenly_spaced(&model.cameras, VIEWS_MAX).len(), VIEWS_MAX);
        let few = Model { cameras: vec![huge; 2], ..model };
        let [large, small] = [few.clone(), Model { cameras: vec![above(0.0).resized([1024; 2]); 2], ..few }]
            .map(|model| importance(&model, 1, &|| false).unwrap());
        assert_eq!(large, small);
    }
}
