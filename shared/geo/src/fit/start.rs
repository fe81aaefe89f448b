//! The first similarity: from the pair of places with which most others agree.

use glam::{DQuat, DVec2, DVec3};

use super::observation::{Sighting, median};
use crate::similarity::Similarity;

/// Number of pairs that are tried.
const PAIRS_MAX: usize = 3000;
/// Pairs closer than this share of the extent of all places tell too little about scale and heading.
const APART_SHARE: f64 = 0.2;
/// Seed of the draws.
const SEED: u64 = 7;

/// The similarity with `up` upwards whose median horizontal residual is smallest (least median of squares, Rousseeuw 1984).
/// Up to half of the places may be wrong by any distance. Heights decide only the height. `None` if all places are the same.
pub(super) fn start(places: &[Sighting], up: DVec3) -> Option<Similarity> {
    let level = DQuat::from_rotation_arc(up, DVec3::Z);
    let flat: Vec<(DVec2, DVec2)> =
        places.iter().map(|place| ((level * place.model).truncate(), place.enu_m.truncate())).collect();
    let middle = flat.iter().map(|(model, _)| *model).sum::<DVec2>() / flat.len().max(1) as f64;
    let extent = flat.iter().map(|(model, _)| model.distance(middle)).fold(0.0, f64::max);
    let candidates = pairs(flat.len()).into_iter().filter_map(|(a, b)| {
        let turn = Turn::of(flat[a], flat[b], APART_SHARE * extent)?;
        Some((score(&turn, &flat), turn))
    });
    let (_, turn) = candidates.min_by(|(a, _), (b, _)| a.total_cmp(b))?;
    let rotation = DQuat::from_rotation_z(turn.factor.to_angle()) * level;
    let scale = turn.factor.length();
    let heights = places.iter().filter(|place| place.has_height);
    let height_m = median(heights.map(|place| place.enu_m.z - scale * (rotation * place.model).z).collect());
    Some(Similarity { scale, rotation, translation: turn.shift.extend(height_m) })
}

/// A similarity of the plane: a complex factor and a shift.
struct Turn {
    factor: DVec2,
    shift: DVec2,
}

impl Turn {
    fn of(a: (DVec2, DVec2), b: (DVec2, DVec2), apart: f64) -> Option<Self> {
        let (model, enu) = (b.0 - a.0, b.1 - a.1);
        let length2 = model.length_squared();
        if !(length2 > 0.0 && length2 >= apart * apart && enu.length_squared() > 0.0) {
            return None;
        }
        let factor = DVec2::new(model.dot(enu), model.perp_dot(enu)) / length2;
        Some(Self { factor, shift: (a.1 + b.1) / 2.0 - factor.rotate((a.0 + b.0) / 2.0) })
    }
}

/// The residual that half of the places keep, without the two that decide the turn.
fn score(turn: &Turn, flat: &[(DVec2, DVec2)]) -> f64 {
    let mut residuals: Vec<f64> =
        flat.iter().map(|(model, enu)| (turn.factor.rotate(*model) + turn.shift).distance(*enu)).collect();
    let at = (flat.len() / 2 + 1).min(flat.len() - 1);
    *residuals.select_nth_unstable_by(at, f64::total_cmp).1
}

/// All pairs of `count` places, or as many as are tried.
fn pairs(count: usize) -> Vec<(usize, usize)> {
    if count * count.saturating_sub(1) / 2 <= PAIRS_MAX {
        return (0..count).flat_map(|a| (0..a).map(move |b| (b, a))).collect();
    }
    let mut dice = fastrand::Rng::with_seed(SEED);
    let draw = |_| (dice.usize(..count), dice.usize(..count));
    (0..PAIRS_MAX).map(draw).collect()
}
