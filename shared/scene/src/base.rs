//! A reduced model that stands in for the full model until the full model has arrived.

use crate::Splats;

/// Some of a model's splats, adjusted so that they approximate the whole model while the other splats
/// are missing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Base {
    /// Index of each splat in the full model, ascending.
    pub ids: Vec<u32>,
    /// The adjusted splats in the order of `ids`, with spherical harmonics of degree 0. Rotations are
    /// those of the full model.
    pub splats: Splats,
}

impl Base {
    /// Thins `model`, the full model of this base, at the model's indices `removed` (ascending, unique): of these
    /// splats, only those of the base are left, as they are in the base. Returns the thinned model and its base.
    pub fn thinned(&self, model: &Splats, removed: &[u32]) -> (Splats, Self) {
        let mut left = Splats::with_capacity(model.len(), model.sh_degree);
        let mut base =
            Self { ids: Vec::new(), splats: Splats::with_capacity(self.ids.len(), self.splats.sh_degree) };
        let mut one_color = vec![0.0; model.sh_stride()];
        let (mut removed, mut adjusted) = (removed.iter().peekable(), self.ids.iter().enumerate().peekable());
        for i in 0..model.len() {
            let is_removed = removed.next_if(|removed| **removed as usize == i).is_some();
            let Some((k, _)) = adjusted.next_if(|(_, id)| **id as usize == i) else {
                if !is_removed {
                    left.push_from(model, i);
                }
                continue;
            };
            base.ids.push(left.len() as u32);
            base.splats.push_from(&self.splats, k);
            if is_removed {
                let Splats { means, quats, log_scales, opacity_logits, .. } = &self.splats;
                one_color[..3].copy_from_slice(self.splats.sh_of(k));
                left.push(means[k], quats[k], log_scales[k], opacity_logits[k], &one_color);
            } else {
                left.push_from(model, i);
            }
        }
        (left, base)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_removed_splats_those_of_the_base_are_left_as_in_the_base() {
        let splats = |means: &[u8], sh_degree: u32| {
            let mut splats = Splats::with_capacity(means.len(), sh_degree);
            let sh = vec![0.5; splats.sh_stride()];
            means.iter().for_each(|x| splats.push([f32::from(*x); 3], [1.0; 4], [0.0; 3], 0.0, &sh));
            splats
        };
        let model = splats(&[0, 1, 2, 3, 4, 5], 1);
        let base = Base { ids: vec![1, 3, 4], splats: splats(&[11, 13, 14], 0) };
        let (left, of_left) = base.thinned(&model, &[0, 3, 5]);
        assert_eq!(left.means, [[1.0; 3], [2.0; 3], [13.0; 3], [4.0; 3]]);
        assert_eq!(left.sh_of(2)[..4], [0.5, 0.5, 0.5, 0.0], "one colour for all directions");
        assert_eq!(left.sh_of(3), model.sh_of(4));
        assert_eq!(of_left.ids, [0, 2, 3]);
        assert_eq!(of_left.splats, base.splats);
        assert_eq!(base.thinned(&model, &[]), (model, base));
    }
}
