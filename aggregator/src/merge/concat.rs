//! Joins local models by plain concatenation.

use cosurf_link::Model;
use cosurf_scene::Splats;

/// Joins all splats and all cameras, in the order of the models. The result has the highest degree of
/// spherical harmonics of all models; coefficients that a model lacks are 0.
pub(crate) fn concatenate(models: &[Model]) -> Model {
    let degree = models.iter().map(|model| model.splats.sh_degree).max().unwrap_or(0);
    let count = models.iter().map(|model| model.splats.len()).sum();
    let mut splats = Splats::with_capacity(count, degree);
    let mut sh = vec![0.0; splats.sh_stride()];
    for Model { splats: local, .. } in models {
        sh.fill(0.0);
        for i in 0..local.len() {
            sh[..local.sh_stride()].copy_from_slice(local.sh_of(i));
            splats.push(local.means[i], local.quats[i], local.log_scales[i], local.opacity_logits[i], &sh);
        }
    }
    let cameras = models.iter().flat_map(|model| model.cameras.iter().copied()).collect();
    Model { splats, cameras }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::model;

    #[test]
    fn splats_keep_their_order_and_lower_degrees_are_padded_with_zeros() {
        let joined = concatenate(&[model(2, 0, 5.0), model(3, 1, 7.0), model(0, 2, 9.0)]).splats;
        assert_eq!((joined.len(), joined.sh_degree), (5, 2));
        let first: Vec<f32> = joined.means.iter().map(|mean| mean[0]).collect();
        assert_eq!(first, [5.0, 5.0, 7.0, 7.0, 7.0]);
        assert_eq!(joined.sh_of(1)[..4], [5.0, 6.0, 7.0, 0.0]);
        assert_eq!(joined.sh_of(2)[10..14], [17.0, 18.0, 0.0, 0.0]);
    }

    #[test]
    fn joining_no_models_gives_no_splats() {
        assert!(concatenate(&[]).splats.is_empty());
    }
}
