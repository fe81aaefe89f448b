//! Warm start: training starts from an earlier model of the ground in the pictures, for example from the last flight's
//! global model, instead of from the sparse cloud.

use std::path::Path;

use cosurf_link::plain_importance;
use cosurf_scene::{Camera, SceneError, Splats, Watchers, ply};
use glam::DVec3;

/// Reads a PLY and keeps the splats whose centres at least one of `cameras` sees, in the order of the file. If more
/// than `splats_max` remain, keeps the most important ones, by opacity times area. The result has spherical harmonics
/// up to `sh_degree`: higher degrees of the file are dropped, and degrees that the file lacks are zero.
pub fn read_visible_splats(
    model: &Path,
    cameras: &[Camera],
    splats_max: usize,
    sh_degree: u32,
) -> Result<Splats, SceneError> {
    let model = ply::read(model)?;
    Ok(visible_splats(&model, cameras, splats_max, sh_degree))
}

fn visible_splats(model: &Splats, cameras: &[Camera], splats_max: usize, sh_degree: u32) -> Splats {
    let mut watchers = Watchers::new(cameras);
    let is_seen = |i: &usize| {
        let mean = DVec3::from_array(model.means[*i].map(f64::from));
        watchers.any(mean, |_| true)
    };
    let importance = plain_importance(model);
    let mut seen: Vec<usize> = (0..model.len()).filter(is_seen).collect();
    seen.sort_by(|a, b| importance[*b].total_cmp(&importance[*a]));
    seen.truncate(splats_max);
    seen.sort_unstable();
    let mut kept = Splats::with_capacity(seen.len(), sh_degree);
    let mut sh = vec![0.0; kept.sh_stride()];
    let shared = kept.sh_stride().min(model.sh_stride());
    for i in seen {
        sh[..shared].copy_from_slice(&model.sh_of(i)[..shared]);
        kept.push(model.means[i], model.quats[i], model.log_scales[i], model.opacity_logits[i], &sh);
    }
    kept
}

#[cfg(test)]
mod tests {
    use cosurf_scene::Pose;
    use glam::DVec2;

    use super::*;

    #[test]
    fn visible_splats_are_kept_the_most_important_first() {
        let camera = Camera {
            cam_from_world: Pose::look_at(DVec3::Z * 10.0, DVec3::ZERO, DVec3::Y),
            focal_px: DVec2::splat(40.0),
            center_px: DVec2::new(24.0, 16.0),
            size_px: [48, 32],
        };
        let mut model = Splats::with_capacity(4, 1);
        for (x, opacity_logit) in [(0.0, 1.0), (50.0, 9.0), (1.0, 3.0), (2.0, 2.0)] {
            let sh: Vec<f32> = (0..12).map(|k| x + k as f32).collect();
            model.push([x, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.0; 3], opacity_logit, &sh);
        }
        let kept = visible_splats(&model, &[camera], 2, 3);
        assert_eq!(kept.means, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!((kept.sh_of(0)[11], kept.sh_of(0)[12], kept.sh_stride()), (12.0, 0.0, 48));
        assert_eq!(visible_splats(&model, &[camera], 9, 0).sh_of(2), [2.0, 3.0, 4.0]);
        assert!(visible_splats(&model, &[], 9, 0).is_empty());
    }
}
