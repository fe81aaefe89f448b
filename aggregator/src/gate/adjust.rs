//! Adjusts the frames of all models together, so that points which several models show lie at the same place.
//!
//! The unknowns are one similarity for each model. Each pair of points that two models show gives a residual: the
//! distance between the two points, in pixels of the picture in which the pair was found. Along the line of sight,
//! distances count less if the models' depths are less exact than their pictures. The sum of a robust function
//! of all residuals is minimised by Gauss-Newton (iteratively reweighted least squares), so that wrong pairs, and links
//! that contradict the others, do not bend the rest.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::glimpse::median;
use super::matching::Pair;
use super::similarity::{Similarity, solve};

/// Number of unknowns of a model: translation, rotation and logarithm of the scale.
const UNKNOWNS: usize = 7;
/// Scales of the robust function (Geman and McClure), px, from the first iterations to the last. A wide scale first
/// keeps the adjustment from ending in a minimum near its start.
const SCALES_PX: [f64; 3] = [4.0, 2.0, SCALE_MIN_PX];
/// The last and smallest of the scales.
const SCALE_MIN_PX: f64 = 1.0;
/// Largest number of iterations with each scale.
const ITERATIONS: usize = 20;
/// Iterations end once no model's points move by more than this, px.
const STEP_MIN_PX: f64 = 1e-4;
/// Neighbouring patches see the same errors of a model's surface, so pairs count as less independent than they look:
/// the variance that their spread suggests is multiplied by this.
const CORRELATION: f64 = 10.0;

/// Depths err in one direction over whole regions, above all where the ground is flat. So residuals along the line of
/// sight count less than their spread suggests, by this factor. With a [`State::depth_share`] of 1, undisturbed models
/// of Caliterra appear to be 0.22 px off, and moving them loses 0.16 dB; with 0.1 it is 0.06 px, and nothing is lost.
const DEPTH_TRUST: f64 = 0.4;
/// Number of times that the share of depth is estimated anew.
const DEPTH_ESTIMATES: usize = 2;

/// Points that two models show.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Link {
    /// Indices of two models. [`Pair::trusted`] is in the frame of the first, [`Pair::other`] in that of the second.
    pub(super) models: [usize; 2],
    /// The pairs of points.
    pub(super) pairs: Vec<Pair>,
}

/// The frame of a model in the common world.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame {
    /// Moves the model into the common world.
    pub(super) by: Similarity,
    /// Standard deviation of the model's points in the common world, root mean square, px; 0 for a fixed model.
    pub(super) deviation_px: f64,
}

/// Adjusts the frames of the models with `Some(start)`. Models that are fixed stay where they start. Every other model
/// must be linked to a fixed one, directly or by way of others.
pub(super) fn adjust(links: &[Link], starts: &[Option<Similarity>], is_fixed: &[bool]) -> Vec<Option<Frame>> {
    let free: Vec<usize> = (0..starts.len()).filter(|i| starts[*i].is_some() && !is_fixed[*i]).collect();
    let mut state = State { links, frames: starts.to_vec(), free, depth_share: 1.0 };
    SCALES_PX.into_iter().for_each(|scale_px| state.converge(scale_px));
    for _ in 0..DEPTH_ESTIMATES {
        state.depth_share = state.estimated_depth_share();
        state.converge(SCALE_MIN_PX);
    }
    state.result()
}

/// Root mean square of the distances by which two similarities differ at the points of `model` in `links`, px.
pub(super) fn difference_px(links: &[Link], model: usize, a: &Similarity, b: &Similarity) -> f64 {
    let distances =
        points_of(links, model).map(|(p, pixel)| a.apply(p).distance(b.apply(p)) / (pixel * b.scale));
    root_mean_square(distances)
}

/// Root mean square of the distances by which a similarity moves the points of `model` in `links`, units of the world.
pub(super) fn distance_m(links: &[Link], model: usize, by: &Similarity) -> f64 {
    root_mean_square(points_of(links, model).map(|(p, _)| by.apply(p).distance(p)))
}

fn root_mean_square(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), value| (sum + value * value, count + 1));
    (sum / count.max(1) as f64).sqrt()
}

/// The points of `model` in `links`, in the model's own frame, with the width of a pixel there.
fn points_of(links: &[Link], model: usize) -> impl Iterator<Item = (DVec3, f64)> {
    links.iter().flat_map(move |link| {
        let side = link.models.iter().position(|other| *other == model);
        let pairs = if side.is_some() { &link.pairs[..] } else { &[] };
        pairs.iter().map(move |pair| match side {
            Some(0) => (pair.trusted, pair.trusted_pixel_m),
            _ => (pair.other, pair.other_pixel_m),
        })
    })
}

struct State<'a> {
    links: &'a [Link],
    frames: Vec<Option<Similarity>>,
    /// Indices of the models whose frames are adjusted.
    free: Vec<usize>,
    /// Factor on residuals along the line of sight, 0..=1.
    depth_share: f64,
}

/// The point about which the unknowns of a model rotate and scale, and the distance at which they move points as far
/// as the unknown translation does.
#[derive(Clone, Copy)]
struct Center {
    at: DVec3,
    radius: f64,
}

/// The normal equations `matrix · step = -gradient`.
struct Normal {
    matrix: Vec<Vec<f64>>,
    gradient: Vec<f64>,
    /// Sum of the squared residuals times their weights, px², and sum of the weights.
    squares: f64,
    weights: f64,
}

impl State<'_> {
    fn converge(&mut self, scale_px: f64) {
        for _ in 0..ITERATIONS {
            if self.improve(scale_px) <= STEP_MIN_PX {
                break;
            }
        }
    }

    /// A value for `depth_share`: the median residual of all pairs across the line of sight, divided by the median
    /// along it, times [`DEPTH_TRUST`].
    fn estimated_depth_share(&self) -> f64 {
        let (mut across, mut along) = (Vec::new(), Vec::new());
        for Link { models, pairs } in self.links {
            let [Some(one), Some(other)] = models.map(|model| self.frames[model]) else { continue };
            for pair in pairs {
                let pixel = pair.trusted_pixel_m * one.scale;
                let residual = (one.apply(pair.trusted) - other.apply(pair.other)) / pixel;
                let sight = one.rotation * pair.trusted_sight;
                along.push(residual.dot(sight).abs());
                across.push(counted(residual, sight, 0.0).length());
            }
        }
        let [across, along] = [&mut across, &mut along].map(|values| median(values));
        (DEPTH_TRUST * across / along.max(f64::MIN_POSITIVE)).min(1.0)
    }

    /// One iteration. Returns the largest distance that a model's points moved by, px.
    fn improve(&mut self, scale_px: f64) -> f64 {
        let centers = self.centers();
        let normal = self.normal(&centers, scale_px);
        let steps = solve(normal.matrix, normal.gradient.iter().map(|value| vec![-value]).collect());
        let mut largest = 0.0f64;
        for (k, &model) in self.free.iter().enumerate() {
            let step: Vec<f64> = (0..UNKNOWNS).map(|u| steps[UNKNOWNS * k + u][0]).collect();
            let Some(before) = self.frames[model] else { continue };
            if step.iter().any(|value| !value.is_finite()) {
                continue;
            }
            let after = moved(&before, &step, centers[k]);
            largest = largest.max(difference_px(self.links, model, &after, &before));
            self.frames[model] = Some(after);
        }
        largest
    }

    fn centers(&self) -> Vec<Center> {
        let center = |&model: &usize| {
            let by = self.frames[model].unwrap_or(Similarity::IDENTITY);
            let points: Vec<DVec3> = points_of(self.links, model).map(|(p, _)| by.apply(p)).collect();
            let count = points.len().max(1) as f64;
            let at = points.iter().sum::<DVec3>() / count;
            let spread = points.iter().map(|p| p.distance_squared(at)).sum::<f64>() / count;
            Center { at, radius: spread.sqrt().max(f64::MIN_POSITIVE) }
        };
        self.free.iter().map(center).collect()
    }

    fn normal(&self, centers: &[Center], scale_px: f64) -> Normal {
        let size = UNKNOWNS * self.free.len();
        let mut normal = Normal {
            matrix: vec![vec![0.0; size]; size],
            gradient: vec![0.0; size],
            squares: 0.0,
            weights: 0.0,
        };
        for Link { models, pairs } in self.links {
            let [Some(one), Some(other)] = models.map(|model| self.frames[model]) else { continue };
            let unknowns = models.map(|model| self.free.iter().position(|free| *free == model));
            for pair in pairs {
                let points = [one.apply(pair.trusted), other.apply(pair.other)];
                let pixel = pair.trusted_pixel_m * one.scale;
                let sight = one.rotation * pair.trusted_sight;
                let residual = counted(points[0] - points[1], sight, self.depth_share) / pixel;
                let squared = residual.length_squared();
                let weight = (1.0 + squared / (scale_px * scale_px)).powi(-2);
                normal.squares += weight * squared;
                normal.weights += weight;
                let sides = [0, 1].map(|side| {
                    let k = unknowns[side]?;
                    let sign = if side == 0 { 1.0 } else { -1.0 };
                    let by_unknown = |column| counted(column, sight, self.depth_share) * (sign / pixel);
                    Some((UNKNOWNS * k, columns(points[side], centers[k]).map(by_unknown)))
                });
                normal.add(&sides, residual, weight);
            }
        }
        for (i, row) in normal.matrix.iter_mut().enumerate() {
            row[i] += 1e-9 * row[i].max(1e-9);
        }
        normal
    }

    fn result(&self) -> Vec<Option<Frame>> {
        let centers = self.centers();
        let normal = self.normal(&centers, SCALE_MIN_PX);
        let size = normal.gradient.len();
        let unit: Vec<Vec<f64>> =
            (0..size).map(|i| (0..size).map(|j| if i == j { 1.0 } else { 0.0 }).collect()).collect();
        let inverse = solve(normal.matrix, unit);
        // Each pair has two residuals across the line of sight, and one along it that may count less.
        let residuals = (2.0 + self.depth_share) * normal.weights;
        let variance = CORRELATION * normal.squares / residuals.max(f64::MIN_POSITIVE);
        let deviation = |model: usize| {
            let Some(k) = self.free.iter().position(|free| *free == model) else { return 0.0 };
            let by = self.frames[model].unwrap_or(Similarity::IDENTITY);
            let (mut sum, mut count) = (0.0, 0usize);
            for (p, pixel) in points_of(self.links, model) {
                let columns = columns(by.apply(p), centers[k]);
                let mut trace = 0.0;
                for (i, a) in columns.iter().enumerate() {
                    for (j, b) in columns.iter().enumerate() {
                        trace += inverse[UNKNOWNS * k + i][UNKNOWNS * k + j] * a.dot(*b);
                    }
                }
                sum += trace / (pixel * by.scale).powi(2);
                count += 1;
            }
            (variance * sum / count.max(1) as f64).sqrt()
        };
        let frame = |(model, by): (usize, &Option<Similarity>)| {
            Some(Frame { by: (*by)?, deviation_px: deviation(model) })
        };
        self.frames.iter().enumerate().map(frame).collect()
    }
}

impl Normal {
    /// Adds a residual. `sides` has, for each of the two models that are adjusted, the index of its first unknown and
    /// the derivatives of the residual.
    fn add(&mut self, sides: &[Option<(usize, [DVec3; UNKNOWNS])>; 2], residual: DVec3, weight: f64) {
        for (first, columns) in sides.iter().flatten() {
            for (i, column) in columns.iter().enumerate() {
                self.gradient[first + i] += weight * column.dot(residual);
                for (other, others) in sides.iter().flatten() {
                    for (j, derivative) in others.iter().enumerate() {
                        self.matrix[first + i][other + j] += weight * column.dot(*derivative);
                    }
                }
            }
        }
    }
}

/// The difference between two points that are seen along `sight`, with `depth_share` times its component along it.
fn counted(difference: DVec3, sight: DVec3, depth_share: f64) -> DVec3 {
    difference - (1.0 - depth_share) * difference.dot(sight) * sight
}

/// Derivatives of a point's position by the unknowns of its model.
fn columns(point: DVec3, center: Center) -> [DVec3; UNKNOWNS] {
    let arm = (point - center.at) / center.radius;
    [DVec3::X, DVec3::Y, DVec3::Z, DVec3::X.cross(arm), DVec3::Y.cross(arm), DVec3::Z.cross(arm), arm]
}

/// The similarity after a step of its unknowns.
fn moved(by: &Similarity, step: &[f64], center: Center) -> Similarity {
    let translation = DVec3::new(step[0], step[1], step[2]);
    let turn = DQuat::from_scaled_axis(DVec3::new(step[3], step[4], step[5]) / center.radius);
    let scale = libm::exp((step[6] / center.radius).clamp(-0.5, 0.5));
    Similarity {
        scale: scale * by.scale,
        rotation: (turn * by.rotation).normalize(),
        translation: center.at + scale * (turn * (by.translation - center.at)) + translation,
    }
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used)]
    pub(in crate::gate) use super::super::consensus::Dice;
    use super::*;

    impl Dice {
        /// A number between -1 and 1.
        pub(crate) fn number(&mut self) -> f64 {
            (self.bits() >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        }

        pub(crate) fn vector(&mut self) -> DVec3 {
            DVec3::new(self.number(), self.number(), self.number())
        }

        /// A similarity that moves points by a few metres.
        pub(crate) fn similarity(&mut self) -> Similarity {
            Similarity {
                scale: 1.0 + 0.02 * self.number(),
                rotation: DQuat::from_scaled_axis(0.02 * self.vector()),
                translation: 2.0 * self.vector(),
            }
        }
    }

    pub(crate) const PIXEL_M: f64 = 0.25;

    /// Pairs of points on the ground between two models, found with errors of a fraction of a pixel. `world_from` has
    /// the frame of each model. One pair in eight is wrong.
    pub(crate) fn link(dice: &mut Dice, models: [usize; 2], world_from: &[Similarity], count: usize) -> Link {
        let [one, other] = models.map(|model| world_from[model].inverse());
        let pairs = (0..count).map(|i| {
            let ground = DVec3::new(60.0, 60.0, 5.0) * dice.vector();
            let error = if i % 8 == 0 { 20.0 } else { 0.3 * PIXEL_M };
            let sight = dice.vector().normalize();
            Pair {
                trusted: one.apply(ground),
                other: other.apply(ground + error * dice.vector()),
                trusted_pixel_m: PIXEL_M * one.scale,
                other_pixel_m: PIXEL_M * other.scale,
                trusted_sight: one.rotation * sight,
                other_sight: other.rotation * sight,
            }
        });
        Link { models, pairs: pairs.collect() }
    }

    /// Largest distance between where two similarities move the corners of a square of 120 m.
    pub(crate) fn apart_m(a: &Similarity, b: &Similarity) -> f64 {
        let corners = [[-60.0, -60.0], [-60.0, 60.0], [60.0, -60.0], [60.0, 60.0]];
        let apart =
            |[x, y]: [f64; 2]| a.apply(DVec3::new(x, y, 0.0)).distance(b.apply(DVec3::new(x, y, 0.0)));
        corners.into_iter().map(apart).fold(0.0, f64::max)
    }

    #[test]
    fn frames_are_found_although_one_pair_in_eight_and_one_whole_link_are_wrong() {
        let mut dice = Dice(7);
        let mut right: Vec<Similarity> = (0..5).map(|_| dice.similarity()).collect();
        right[0] = Similarity::IDENTITY;
        let mut links: Vec<Link> = [[0, 1], [1, 2], [2, 3], [3, 4], [0, 4], [1, 3]]
            .map(|models| link(&mut dice, models, &right, 300))
            .into();
        let mut wrong = right.clone();
        wrong[2] = Similarity { translation: 6.0 * DVec3::X, ..wrong[2] };
        links.push(link(&mut dice, [0, 2], &wrong, 200));
        let starts: Vec<_> = right
            .iter()
            .map(|by| Some(Similarity { translation: by.translation + 0.5 * DVec3::Y, ..*by }))
            .collect();
        let is_fixed = [true, false, false, false, false];
        let starts = [vec![Some(right[0])], starts[1..].to_vec()].concat();
        let found = adjust(&links, &starts, &is_fixed);
        for (i, frame) in found.iter().enumerate() {
            let Frame { by, deviation_px } = frame.unwrap();
            let apart_m = apart_m(&by, &right[i]);
            assert!(apart_m < 0.2 * PIXEL_M, "model {i} is {apart_m} m off");
            assert_eq!(deviation_px == 0.0, i == 0, "model {i}: {deviation_px} px");
            assert!(deviation_px < 0.3, "model {i}: {deviation_px} px");
        }
    }

    #[test]
    fn depths_that_are_wrong_over_a_whole_region_hardly_move_a_model() {
        let mut dice = Dice(5);
        let pair = |_| {
            let ground = DVec3::new(60.0, 60.0, 1.0) * dice.vector();
            let sight = (DVec3::new(0.6, 0.6, 0.0) * dice.vector() - DVec3::Z).normalize();
            // The east of the second model lies too deep.
            let too_deep = if ground.x > 0.0 { PIXEL_M } else { 0.0 };
            Pair {
                trusted: ground,
                other: ground + too_deep * sight + 0.1 * PIXEL_M * dice.vector(),
                trusted_pixel_m: PIXEL_M,
                other_pixel_m: PIXEL_M,
                trusted_sight: sight,
                other_sight: sight,
            }
        };
        let links = [Link { models: [0, 1], pairs: (0..1000).map(pair).collect() }];
        let found = adjust(&links, &[Some(Similarity::IDENTITY); 2], &[true, false]);
        let off_px = difference_px(&links, 1, &found[1].unwrap().by, &Similarity::IDENTITY);
        assert!(off_px < 0.2, "{off_px} px");
    }

    #[test]
    fn fewer_points_leave_a_larger_deviation() {
        let deviation_px = |count: usize| {
            let mut dice = Dice(3);
            let frames = [Similarity::IDENTITY, dice.similarity()];
            let links = [link(&mut dice, [0, 1], &frames, count)];
            adjust(&links, &frames.map(Some), &[true, false])[1].unwrap().deviation_px
        };
        let (few, many) = (deviation_px(30), deviation_px(3000));
        assert!(few > 5.0 * many, "{few} px and {many} px");
    }
}
