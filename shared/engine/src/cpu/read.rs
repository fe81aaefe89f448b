//! Converts scores and gradients from the tables of the backend to the types of its interface.

use cosurf_scene::Splats;

use super::blocks::Blocks;
use crate::backend::Scores;
use crate::layout::harmonics::sh_gradients;
use crate::layout::rows::{GRADIENT_RGB, HITS, LOG_SCALE, MEAN, OBSERVED, OPACITY, QUAT, SQUARED_WEIGHT};
use crate::layout::view::ViewParams;
use crate::simd::GROUP;

/// Scores of all splats.
pub(super) fn scores(scores: &Blocks) -> Scores {
    let row = |row: usize| (0..scores.len()).map(|i| scores.value(i, row)).collect();
    Scores { squared_weights: row(SQUARED_WEIGHT), hits: row(HITS), observers: row(OBSERVED) }
}

/// Gradients of all splats, each in the place of its parameter; zero for splats that were not seen.
pub(super) fn gradients(
    params: &Blocks,
    gradients: &Blocks,
    visible: &[u16],
    view: &ViewParams,
    sh_degree: u32,
) -> Splats {
    let mut out = Splats::with_capacity(params.len(), sh_degree);
    for i in 0..params.len() {
        let seen = visible[i / GROUP] >> (i % GROUP) & 1 == 1;
        let get = |row: usize| if seen { gradients.value(i, row) } else { 0.0 };
        let mean = [0, 1, 2].map(|a| params.value(i, MEAN + a));
        let sh = sh_gradients(mean, [0, 1, 2].map(|k| get(GRADIENT_RGB + k)), view, sh_degree);
        out.push(
            [0, 1, 2].map(|k| get(MEAN + k)),
            [0, 1, 2, 3].map(|k| get(QUAT + k)),
            [0, 1, 2].map(|k| get(LOG_SCALE + k)),
            get(OPACITY),
            &sh,
        );
    }
    out
}
