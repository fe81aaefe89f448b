//! Divides the splats of a model by place, so that only the cameras that may see a cell are asked about its splats.

use std::collections::BTreeMap;

use cosurf_scene::Splats;

/// Number of cells into which a model is divided along its longest side.
const CELLS_ACROSS: f64 = 32.0;

/// Divides the splats by place. Only the cameras that may see a cell are asked about its splats.
pub(super) fn cells(splats: &Splats) -> Vec<Vec<u32>> {
    let side = longest_side(splats) / CELLS_ACROSS;
    let mut cells: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
    for (i, mean) in splats.means.iter().enumerate() {
        cells.entry(mean.map(|x| (f64::from(x) / side).floor() as i64)).or_default().push(i as u32);
    }
    cells.into_values().collect()
}

/// Length of the model along the world axis along which it is longest, world units; 1 if all splats lie in one place. A
/// tenth of the splats, those farthest out along the axis, are left out: a few splats may lie far away.
pub fn longest_side(splats: &Splats) -> f64 {
    let across = |axis: usize| {
        let mut at: Vec<f32> = splats.means.iter().map(|mean| mean[axis]).collect();
        at.sort_unstable_by(f32::total_cmp);
        let twentieths = |n: usize| at.get(at.len() * n / 20).copied().unwrap_or_default();
        f64::from(twentieths(19) - twentieths(1))
    };
    let longest = (0..3).map(across).fold(0.0, f64::max);
    if longest > 0.0 { longest } else { 1.0 }
}
