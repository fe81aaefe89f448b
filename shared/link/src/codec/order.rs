//! In which order splats go: the most important first, neighbours together.

use cosurf_scene::{Base, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::PACK_SPLATS_MAX;

/// Shares of the splats that go with each layer and those before it. Shapes are about three quarters of a body,
/// so the first layer ends at a fifth of its bytes.
const LAYERS: [f64; 3] = [0.25, 0.5, 1.0];
/// Bits of a Morton code per axis.
const MORTON_BITS: u32 = 21;

/// How much each splat matters where nobody has rendered it: opacity times area. A sum of blend weights over
/// the training views tells far more.
pub fn plain_importance(splats: &Splats) -> Vec<f32> {
    (0..splats.len())
        .map(|i| {
            let opacity = 1.0 / (1.0 + (-splats.opacity_logits[i]).exp());
            let [a, b, c] = splats.log_scales[i];
            opacity * (a + b + c - a.min(b).min(c)).exp()
        })
        .collect()
}

/// Indices of the splats layer by layer, in each along the Morton curve. The same importance is decided by
/// index.
pub(super) fn layers(means: &[[f32; 3]], importance: &[f32], bounds: &Bounds) -> Vec<Vec<u32>> {
    assert_eq!(means.len(), importance.len(), "an importance for each splat");
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
    LAYERS.map(cut).into()
}

/// What lies next to each other along the curve: first some splats of the base, then the others there.
pub(super) struct Region {
    /// Places in the base.
    pub(super) base: Vec<usize>,
    /// Indices of splats.
    pub(super) rest: Vec<u32>,
}

/// Cuts a model where a pack of its base ends, along the Morton curve.
pub(super) fn regions(means: &[[f32; 3]], base: &Base, bounds: &Bounds) -> Vec<Region> {
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

/// Cuts into chunks of nearly the same size, none above `max`.
pub(super) fn even_chunks<T>(all: &[T], max: usize) -> impl Iterator<Item = &[T]> {
    let chunks = all.len().div_ceil(max).max(1);
    all.chunks(all.len().div_ceil(chunks).max(1))
}

/// A Morton curve through a box.
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

/// Moves bit `b` of the lowest 21 to bit `3 b`.
fn spread(bits: u64) -> u64 {
    (0..MORTON_BITS).fold(0, |out, b| out | (bits >> b & 1) << (3 * b))
}
