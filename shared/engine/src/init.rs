//! The first splats: one for each point of the sparse cloud.

use cosurf_scene::splats::{SH_C0, sh_coefficients};
use cosurf_scene::{SparsePoint, Splats};

use crate::nearest::Tree;

/// Opacity of a new splat. 3DGS begins with 0.1; at 600 steps on real drone pictures 0.3 gains 0.3 dB.
const OPACITY: f32 = 0.3;

/// Neighbours whose RMS distance gives the first scale (3DGS).
const NEIGHBOURS: usize = 3;

/// Round splats at the points, as large as the RMS distance to the three nearest neighbours, of the
/// points' colours. Scales stay between `extent` × 1e-6 and `extent` × 0.5, so that neither duplicates nor
/// far outliers start as splats that cannot learn. If there are more than `capacity` points, an even
/// selection of them is taken.
pub fn splats_from_points(points: &[SparsePoint], extent: f64, capacity: usize, sh_degree: u32) -> Splats {
    let chosen: Vec<&SparsePoint> = if points.len() <= capacity {
        points.iter().collect()
    } else {
        (0..capacity).map(|i| &points[i * points.len() / capacity]).collect()
    };
    let mut splats = Splats::with_capacity(chosen.len(), sh_degree);
    let positions: Vec<[f64; 3]> = chosen.iter().map(|point| point.position.to_array()).collect();
    let distances = neighbour_distances(&positions);
    let mut sh = vec![0.0; 3 * sh_coefficients(sh_degree)];
    for (point, distance) in chosen.iter().zip(distances) {
        for (value, byte) in sh.iter_mut().zip(point.rgb) {
            *value = (f32::from(byte) / 255.0 - 0.5) / SH_C0;
        }
        let scale = distance.clamp(extent * 1e-6, extent * 0.5).max(f64::from(f32::MIN_POSITIVE)).ln() as f32;
        let logit = (OPACITY / (1.0 - OPACITY)).ln();
        let mean = point.position.to_array().map(|v| v as f32);
        splats.push(mean, [1.0, 0.0, 0.0, 0.0], [scale; 3], logit, &sh);
    }
    splats
}

/// RMS distance to the nearest neighbours; infinite for a single point.
fn neighbour_distances(positions: &[[f64; 3]]) -> Vec<f64> {
    if positions.len() < 2 {
        return vec![f64::INFINITY; positions.len()];
    }
    let tree = Tree::new(positions);
    positions
        .iter()
        .map(|position| {
            // The nearest is the point itself, at distance 0.
            let found = tree.nearest_squared::<{ NEIGHBOURS + 1 }>(position);
            let others = found.iter().skip(1).filter(|d| d.is_finite());
            (others.clone().sum::<f64>() / others.count().max(1) as f64).sqrt()
        })
        .collect()
}
