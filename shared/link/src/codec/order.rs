//! The order of splats in a body: in layers by importance, or in regions with a base first. Neighbours are
//! kept together.

use cosurf_scene::{Base, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::PACK_SPLATS_MAX;

/// Cumulative share of the splats in each layer. Shapes are about three quarters of a body, so the first
/// layer ends after about a fifth of the body.
const LAYER_ENDS: [f64; 3] = [0.25, 0.5, 1.0];
/// Bits per axis of a Morton code.
const MORTON_BITS: u32 = 21;

/// Estimates the importance of each splat without rendering the model: opacity times the lengths of its two
/// longest axes. The sum of a splat's blend weights over the training views is a far better measure, but it
/// needs the training views.
pub fn plain_importance(splats: &Splats) -> Vec<f32> {
    (0..splats.len())
        .map(|i| {
            let opacity = 1.0 / (1.0 + libm::expf(-splats.opacity_logits[i]));
            let [a, b, c] = splats.log_scales[i];
            opacity * libm::expf(a + b + c - a.min(b).min(c))
        })
        .collect()
}

/// Splits the splats into layers of falling importance, and returns the indices of each layer's splats in the
/// order of the Morton curve. Of two equally important splats, the one with the lower index counts as more
/// important.
pub(super) fn split_layers(means: &[[f32; 3]], importance: &[f32], bounds: &Bounds) -> Vec<Vec<u32>> {
    assert_eq!(means.len(), importance.len(), "number of importances");
    let mut ranked: Vec<u32> = (0..means.len() as u32).collect();
    ranked.sort_by(|&a, &b| importance[b as usize].total_cmp(&importance[a as usize]));
    let curve = Curve::new(bounds);
    let mut start = 0;
    let cut = |share: f64| {
        let end = (share * means.len() as f64).round() as usize;
        let mut layer = ranked[start..end].to_vec();
        start = end;
        layer.sort_by_cached_key(|&i| (curve.code(means[i as usize]), i));
        layer
    };
    LAYER_ENDS.map(cut).into()
}

/// A section of the Morton curve, with the splats whose means are in it.
pub(super) struct Region {
    /// The base splats of this section, as indices of [`Base::ids`].
    pub(super) base: Vec<usize>,
    /// The other splats of this section, as indices of the model's splats.
    pub(super) rest: Vec<u32>,
}

/// Splits a model along the Morton curve into one region for each pack of its base.
pub(super) fn split_regions(means: &[[f32; 3]], base: &Base, bounds: &Bounds) -> Vec<Region> {
    let curve = Curve::new(bounds);
    let code = |id: u32| (curve.code(means[id as usize]), id);
    let mut places: Vec<usize> = (0..base.ids.len()).collect();
    places.sort_by_cached_key(|&place| code(base.ids[place]));
    let mut rest: Vec<u32> =
        (0..means.len() as u32).filter(|id| base.ids.binary_search(id).is_err()).collect();
    rest.sort_by_cached_key(|&id| code(id));
    let cuts: Vec<&[usize]> = even_chunks(&places, PACK_SPLATS_MAX).collect();
    let mut rest = &rest[..];
    let mut region = |(k, places): (usize, &&[usize])| {
        let end = match cuts.get(k + 1) {
            Some(next) => rest.partition_point(|&id| code(id) < code(base.ids[next[0]])),
            None => rest.len(),
        };
        let (here, beyond) = rest.split_at(end);
        rest = beyond;
        Region { base: places.to_vec(), rest: here.to_vec() }
    };
    cuts.iter().enumerate().map(&mut region).collect()
}

/// Splits a slice into chunks of nearly equal size, at most `max` each.
pub(super) fn even_chunks<T>(all: &[T], max: usize) -> impl Iterator<Item = &[T]> {
    let chunks = all.len().div_ceil(max).max(1);
    all.chunks(all.len().div_ceil(chunks).max(1))
}

/// A Morton curve through a box. It orders points so that neighbours on the curve are close in space.
struct Curve {
    min: [f32; 3],
    cells_per_unit: f64,
}

impl Curve {
    fn new(bounds: &Bounds) -> Self {
        let extent = (0..3).map(|k| f64::from(bounds.max[k]) - f64::from(bounds.min[k])).fold(0.0, f64::max);
        let cells = f64::from((1u32 << MORTON_BITS) - 1);
        Self { min: bounds.min, cells_per_unit: if extent > 0.0 { cells / extent } else { 0.0 } }
    }

    fn code(&self, mean: [f32; 3]) -> u64 {
        (0..3).fold(0, |code, k| {
            let cell = (f64::from(mean[k]) - f64::from(self.min[k])) * self.cells_per_unit;
            code | spread(cell as u64) << k
        })
    }
}

/// Moves bit `b` of `bits` to bit `3 b`, for the lowest [`MORTON_BITS`] bits.
fn spread(bits: u64) -> u64 {
    (0..MORTON_BITS).fold(0, |out, b| out | (bits >> b & 1) << (3 * b))
}
