//! Carriageways: asphalt with patches, cracks, manhole covers and painted markings; and the kerbstones beside them.

use glam::{Vec2, Vec3};

use super::appearance::{Appearance, Spot};
use super::noise::{fractal, grain, step, visible};
use super::plan::{Plan, Street};
use super::random::{floor_i32, fraction, unit2};

/// Colour of worn road paint.
const PAINT: Vec3 = Vec3::new(0.58, 0.57, 0.53);
/// Depth of a zebra crossing along the street, and its distance from the crossing street's kerb, metres.
const ZEBRA_M: (f32, f32) = (3.0, 3.6);

/// A position on a street, relative to that street.
struct Lane {
    street: Street,
    index: usize,
    /// Signed distance from the centre line, metres.
    across_m: f32,
    /// Coordinate along the street, plan metres.
    along_m: f32,
    /// The nearest crossing street: its index and the distance to its kerb line, metres.
    crossing: (usize, f32),
}

/// The street's appearance at a spot whose texture position is the plan position.
pub(super) fn carriageway(spot: &Spot, plan: &Plan) -> Appearance {
    let (p, f) = (spot.uv, spot.footprint_m);
    let lanes = [plan.street_at(0, p.x), plan.street_at(1, p.y)];
    let lane = match lanes {
        [Some(i), None] => Some(lane(plan, 0, i, p)),
        [None, Some(j)] => Some(lane(plan, 1, j, p)),
        _ => None,
    };
    let town = plan.in_town(p);
    let mut albedo = asphalt(p, f, lanes[0].unwrap_or(0) as u32 * 31 + lanes[1].unwrap_or(0) as u32);
    if let Some(lane) = lane {
        albedo *= worn(&lane, f);
        if let Some(strength) = painted(&lane, plan, town) {
            let wear = step(-0.75, 0.1, fractal(p, 0.8, 4, f, 5) + 0.25);
            albedo += (PAINT - albedo) * (strength * wear);
        }
    }
    Appearance::glossy(albedo, 0.012)
}

fn lane(plan: &Plan, axis: usize, index: usize, p: Vec2) -> Lane {
    let street = plan.streets[axis][index];
    let (across, along) = if axis == 0 { (p.x, p.y) } else { (p.y, p.x) };
    let others = &plan.streets[1 - axis];
    let next = others.partition_point(|s| s.at < along);
    let crossing = [next.checked_sub(1), (next < others.len()).then_some(next)]
        .into_iter()
        .flatten()
        .map(|i| (i, (others[i].at - along).abs() - others[i].half_width_m))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap_or((0, f32::INFINITY));
    Lane { street, index, across_m: across - street.at, along_m: along, crossing }
}

/// Colour of asphalt with chippings, repairs, stains and cracks.
pub(super) fn asphalt(p: Vec2, f: f32, seed: u32) -> Vec3 {
    let chippings = grain(p, 0.12, f, seed ^ 1) * 0.16 + grain(p, 0.5, f, seed ^ 2) * 0.08;
    let age = fractal(p, 11.0, 5, f, seed ^ 3);
    let cell = Vec2::new(p.x / 4.7, p.y / 6.3);
    let id = (floor_i32(cell.x), floor_i32(cell.y));
    let repaired = unit2(id.0, id.1, seed ^ 4) < 0.14;
    let size = Vec2::new(0.25 + 0.6 * unit2(id.0, id.1, 41), 0.2 + 0.5 * unit2(id.0, id.1, 42));
    let inside = fraction(cell.x) < size.x && fraction(cell.y) < size.y;
    let repair = if repaired && inside { -0.32 } else { 0.0 };
    let vein = fractal(p, 3.4, 4, f, seed ^ 6).abs();
    let crack = if vein < 0.012 { -0.4 * visible(0.35, f) } else { 0.0 };
    let oil = -0.35 * step(0.45, 0.8, grain(p, 2.3, f, seed ^ 9));
    let tone = 1.0 + chippings + 0.24 * age + repair + crack + oil;
    Vec3::new(0.128, 0.126, 0.124) * tone.max(0.25)
}

/// Colour of kerbstones 0.9 m long with joints.
pub(super) fn kerbstone(along_m: f32, footprint_m: f32) -> Vec3 {
    let stone = along_m / 0.9;
    let joint = if fraction(stone) < 0.05 { 0.5 * visible(0.2, footprint_m) } else { 0.0 };
    Vec3::new(0.36, 0.35, 0.33) * ((0.85 + 0.3 * unit2(floor_i32(stone), 3, 9)) * (1.0 - joint))
}

/// Brightness factor of wear: darker in wheel tracks, gutters and manhole covers.
fn worn(lane: &Lane, f: f32) -> f32 {
    let half = lane.street.half_width_m;
    let from_kerb = half - lane.across_m.abs();
    let gutter = if from_kerb < 0.35 { 0.72 } else { 1.0 };
    let lane_middle = 0.5 * (half - 1.9);
    let track = ((lane.across_m.abs() - lane_middle).abs() - 0.75).abs();
    let tracks = 1.0 - 0.13 * (1.0 - step(0.1, 0.5, track));
    let cell = floor_i32(lane.along_m / 21.0);
    let cover = Vec2::new(
        fraction(lane.along_m / 21.0) * 21.0 - 9.0,
        lane.across_m - 1.2 * (unit2(cell, lane.index as i32, 6) - 0.5),
    );
    let cover = if cover.length_squared() < 0.12 { 0.45 * visible(0.6, f) } else { 0.0 };
    gutter * tracks * (1.0 - cover)
}

/// Strength of the paint at the spot; `None` if there is none.
fn painted(lane: &Lane, plan: &Plan, town: bool) -> Option<f32> {
    let half = lane.street.half_width_m;
    let (across, along) = (lane.across_m, lane.along_m);
    let to_crossing = lane.crossing.1;
    if town {
        let beyond = to_crossing - ZEBRA_M.1;
        let crosses = plan.hash(lane.index * 7 + usize::from(lane.street.main), lane.crossing.0) % 100 < 62;
        if crosses && (0.0..ZEBRA_M.0).contains(&beyond) {
            return (fraction(across / 1.0) < 0.52 && across.abs() < half - 0.35).then_some(0.95);
        }
        let stop_line = (ZEBRA_M.0 + 0.6..ZEBRA_M.0 + 1.0).contains(&beyond) && across > 0.1;
        if crosses && stop_line {
            return (across < half - 2.0).then_some(0.9);
        }
    }
    if to_crossing < ZEBRA_M.1 + ZEBRA_M.0 {
        return None;
    }
    let dashed = fraction(along / 6.0) < 0.5;
    let near_crossing = to_crossing < 16.0;
    if lane.street.main {
        let center = across.abs() < 0.09 && (dashed || near_crossing);
        let edge = (across.abs() - (half - 2.2)).abs() < 0.07;
        let bays = town && across.abs() > half - 2.2 && fraction(along / 5.6) < 0.022;
        return (center || edge || bays).then_some(0.9);
    }
    let bays = town && lane.index & 1 == 0 && across > half - 2.1;
    let bay_line = bays && (fraction(along / 5.4) < 0.024 || across < half - 1.98);
    let center = !town && across.abs() < 0.07 && dashed && lane.index.is_multiple_of(3);
    (bay_line || center).then_some(0.8)
}
