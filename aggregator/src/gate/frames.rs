//! Finds the frames of all models: where each model must be moved so that the ground that models share lies at the same
//! place in all of them.
//!
//! Every two models that share ground are linked ([`super::links`]). Models in unrelated frames are first brought near
//! each other ([`super::register`]). Then the frames of all linked models are adjusted together ([`super::adjust`]).
//! The links tell how the models lie to each other, but not where all of them lie in the world. So the adjusted models
//! are laid on the model that leaves most of the others where they were, among those whose place on the earth is known if
//! there are any. A model that then needs a move smaller than
//! [`STAY_PX`] stays exactly where it was: such small moves are errors of the measurement, and models in one frame keep
//! their bytes.

use std::collections::BTreeSet;

use cosurf_scene::SceneError;
use serde::{Deserialize, Serialize};
use tracing::debug_span;

use super::adjust::{Frame, Link, adjust, difference_px, distance_m};
use super::extent::{Extent, held_bytes};
use super::features::Feature;
use super::glimpse::median;
use super::link_file::LinkFile;
use super::links::{Held, Scouted, links};
use super::register::register;
use super::similarity::Similarity;
use super::workspace::Workspace;
use crate::merge::shifts::Shifts;
use crate::merge::{Locals, MergeError};

/// A model stays where it is if its ground would move by at most this, root mean square, px of the compared pictures.
/// The moves found for models of undisturbed missions are at most half as large.
const STAY_PX: f64 = 0.12;
/// A model also stays if its ground would move by at most this many standard deviations of the measured move.
const STAY_DEVIATIONS: f64 = 3.0;

/// Limit on the number of pairs of models that are tried to link two groups in unrelated frames.
const REGISTRATIONS_MAX: usize = 16;

/// How each model is moved, and how well every two models then fit.
pub(super) struct Placement {
    /// How each model is moved to where it fits; `None` if it stays.
    pub(super) moves: Vec<Option<Move>>,
    /// One entry for every two models that are linked.
    pub(super) fits: Vec<Fit>,
}

impl Placement {
    /// All of `count` models stay, and none were compared.
    pub(super) fn unmoved(count: usize) -> Self {
        Self { moves: vec![None; count], fits: Vec::new() }
    }
}

/// How a model is moved to where it fits the others.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Move {
    /// From the model's own frame to that of the others.
    pub by: Similarity,
    /// How far the ground that the model shares with others moves: root mean square, world units.
    pub distance_m: f64,
}

/// How well two models show the same ground at the same place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Indices of the models, ascending.
    pub models: [usize; 2],
    /// Number of points of the ground that were found in both models.
    pub points: usize,
    /// Median distance between a point in one model and the same point in the other, before any model was moved, px of
    /// the compared pictures. Their long side is 320 px, or less if the models' own pictures are smaller.
    pub before_px: f64,
    /// The same after the models were moved.
    pub after_px: f64,
}

/// A similarity between two linked models.
struct Edge {
    models: [usize; 2],
    /// From the frame of the second model to that of the first.
    first_from_second: Similarity,
    /// Number of pairs.
    pairs: usize,
}

/// Finds the frames of all models. If their frames are `vouched` for, models whose ground lies apart are left where they
/// are; otherwise they may lie in unrelated frames. `extents` has that of each model. `is_given_up` is called between
/// models; if it returns true, the result is an error.
pub(super) fn find_frames(
    locals: &dyn Locals,
    extents: &[Option<Extent>],
    vouched: bool,
    workspace: Workspace,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Placement, MergeError> {
    let count = locals.count();
    if count < 2 {
        return Ok(Placement::unmoved(count));
    }
    let shifts = workspace.shifts(2 * held_bytes(extents));
    let models = &Scouted::of(locals, workspace.shifts(held_bytes(extents)), workspace.scratch, is_given_up)?;
    let meet = |[i, j]: [usize; 2], frames: &[Similarity]| match [&extents[i], &extents[j]] {
        [Some(one), Some(other)] => one.meets(&frames[i], other, &frames[j]),
        _ => false,
    };
    let pairs = || (0..count).flat_map(|i| (i + 1..count).map(move |j| [i, j]));
    let identity = vec![Similarity::IDENTITY; count];
    let near: BTreeSet<[usize; 2]> = pairs().filter(|models| meet(*models, &identity)).collect();
    let (mut edges, mut links) = (Vec::new(), LinkFile::new(workspace.scratch)?);
    measure(models, &near, &identity, shifts, is_given_up, &mut edges, &mut links)?;
    let is_placed: Vec<bool> = (0..count).map(|i| locals.is_placed(i)).collect();
    // A model without a place is in a frame of its own, even where the frames of the others are known.
    let is_known = |models: [usize; 2]| vouched && models.iter().all(|i| is_placed[*i]);
    let may_register = |models: [usize; 2]| !is_known(models) || near.contains(&models);
    register_groups(models, &may_register, &mut edges, &mut links, workspace.threads, is_given_up)?;
    let mut frames = lay(&edges, &links, &is_placed)?;
    // Pairs of models that move are measured again, now with pictures from the same places. Models that were far apart
    // before may share ground now.
    let is_moved = |models: &&[usize; 2]| models.iter().any(|i| frames[*i].is_some());
    let guesses: Vec<Similarity> = frames.iter().map(|by| by.unwrap_or(Similarity::IDENTITY)).collect();
    let moved =
        pairs().filter(|models| is_moved(&models) && meet(*models, &guesses)).collect::<BTreeSet<_>>();
    if !moved.is_empty() {
        edges.retain(|edge| !moved.contains(&edge.models));
        links.retain(|models| !moved.contains(&models));
        measure(models, &moved, &guesses, shifts, is_given_up, &mut edges, &mut links)?;
        frames = lay(&edges, &links, &is_placed)?;
    }
    let mut fits = Vec::with_capacity(edges.len());
    for edge in &edges {
        fits.push(fit(edge.models, &links.read(|models| models == edge.models)?, &frames));
    }
    let mut moves = vec![None; count];
    for (i, by) in frames.into_iter().enumerate() {
        let Some(by) = by else { continue };
        let its = links.read(|models| models.contains(&i))?;
        moves[i] = Some(Move { by, distance_m: distance_m(&its, i, &by) });
    }
    Ok(Placement { moves, fits })
}

/// How well two linked models fit, before and after they are moved to their frames. `links` are those between them.
fn fit(models: [usize; 2], links: &[Link], frames: &[Option<Similarity>]) -> Fit {
    let mut points = 0;
    let (mut before, mut after) = (Vec::new(), Vec::new());
    for link in links {
        let [one, other] = link.models.map(|model| frames[model].unwrap_or(Similarity::IDENTITY));
        points += link.pairs.len();
        for pair in &link.pairs {
            before.push(pair.trusted.distance(pair.other) / pair.trusted_pixel_m);
            let pixel_m = pair.trusted_pixel_m * one.scale;
            after.push(one.apply(pair.trusted).distance(other.apply(pair.other)) / pixel_m);
        }
    }
    Fit { models, points, before_px: median(&mut before), after_px: median(&mut after) }
}

/// Links the pairs of models, and notes what it finds. `guesses` has the frame of each model as far as it is known.
fn measure(
    models: &Scouted,
    pairs: &BTreeSet<[usize; 2]>,
    guesses: &[Similarity],
    shifts: Shifts,
    is_given_up: &dyn Fn() -> bool,
    edges: &mut Vec<Edge>,
    links: &mut LinkFile,
) -> Result<(), MergeError> {
    let pairs: Vec<[usize; 2]> = pairs.iter().copied().collect();
    // The first model is kept for the next pair.
    let compare = |held: &mut Option<Held>, pair: usize| {
        let [first, second] = pairs[pair];
        let _span = debug_span!("link", one = first, other = second).entered();
        let one = match held.take().filter(|one| one.index() == first) {
            Some(one) => one,
            None => models.hold(first, shifts.threads)?,
        };
        let one = held.insert(one);
        let mut other = models.hold(second, shifts.threads)?;
        let guess = guesses[first].inverse().after(&guesses[second]);
        Ok(link(one, &mut other, &guess))
    };
    shifts.run(pairs.len(), is_given_up, compare, |_, linked| {
        let Some((edge, found)) = linked else { return Ok(()) };
        edges.push(edge);
        Ok(links.extend(found)?)
    })
}

/// Links two models; `guess` is the similarity from the second to the first as far as it is known.
fn link(one: &mut Held, other: &mut Held, guess: &Similarity) -> Option<(Edge, [Link; 2])> {
    let (first_from_second, links) = links(one, other, guess)?;
    let pairs = links.iter().map(|link| link.pairs.len()).sum();
    Some((Edge { models: [one.index(), other.index()], first_from_second, pairs }, links))
}

/// Links groups of models that are not linked to each other, if they share ground but lie in unrelated frames.
fn register_groups(
    models: &Scouted,
    may_register: &dyn Fn([usize; 2]) -> bool,
    edges: &mut Vec<Edge>,
    links: &mut LinkFile,
    threads: usize,
    is_given_up: &dyn Fn() -> bool,
) -> Result<(), MergeError> {
    let count = models.count();
    let mut features: Vec<Option<Vec<Feature>>> = vec![None; count];
    let mut tried = BTreeSet::new();
    let grouped = |edges: &[Edge]| groups(edges.iter().map(|edge| edge.models), count);
    let mut groups = grouped(edges);
    while let Some([first, second]) = next_to_register(&groups, &tried, may_register) {
        if is_given_up() {
            return Err(MergeError::GivenUp);
        }
        let _span = debug_span!("register", one = first, other = second).entered();
        tried.insert([first, second]);
        let [mut one, mut other] = [models.hold(first, threads)?, models.hold(second, threads)?];
        for held in [&mut one, &mut other] {
            features[held.index()].get_or_insert_with(|| held.features());
        }
        let of = |model: usize| features[model].as_deref().unwrap_or_default();
        let Some(guess) = register(of(first), of(second)) else { continue };
        if let Some((edge, new_links)) = link(&mut one, &mut other, &guess) {
            edges.push(edge);
            links.extend(new_links)?;
            groups = grouped(edges);
        }
    }
    Ok(())
}

/// The next two models of different groups to register, of those that may be. Models of larger groups come first, and at most
/// [`REGISTRATIONS_MAX`] pairs of the same two groups are tried.
fn next_to_register(
    groups: &[usize],
    tried: &BTreeSet<[usize; 2]>,
    may_register: &dyn Fn([usize; 2]) -> bool,
) -> Option<[usize; 2]> {
    let count = groups.len();
    let pairs = (0..count).flat_map(|i| (i + 1..count).map(move |j| [i, j]));
    let tried_between = |[a, b]: [usize; 2]| {
        let is_same = |[c, d]: &&[usize; 2]| {
            let [c, d] = [groups[*c], groups[*d]];
            [c.min(d), c.max(d)] == [a.min(b), a.max(b)]
        };
        tried.iter().filter(is_same).count()
    };
    let size = |model: usize| groups.iter().filter(|group| **group == groups[model]).count();
    let is_open = |[a, b]: &[usize; 2]| {
        let between = [groups[*a], groups[*b]];
        between[0] != between[1]
            && may_register([*a, *b])
            && !tried.contains(&[*a, *b])
            && tried_between(between) < REGISTRATIONS_MAX
    };
    pairs.filter(is_open).min_by_key(|[a, b]| (std::cmp::Reverse(size(*a).max(size(*b))), *a, *b))
}

/// For each model, the lowest index of the models that it is linked to, directly or by way of others.
pub(super) fn groups(linked: impl Iterator<Item = [usize; 2]>, count: usize) -> Vec<usize> {
    let mut groups: Vec<usize> = (0..count).collect();
    for [one, other] in linked {
        let [one, other] = [groups[one], groups[other]];
        let (low, high) = (one.min(other), one.max(other));
        groups.iter_mut().filter(|group| **group == high).for_each(|group| *group = low);
    }
    groups
}

/// How each model must be moved; `None` for models that stay or have no link. `is_placed` tells of each model whether its
/// place on the earth is known.
fn lay(edges: &[Edge], links: &LinkFile, is_placed: &[bool]) -> Result<Vec<Option<Similarity>>, SceneError> {
    let count = is_placed.len();
    let mut moves = vec![None; count];
    let mut is_done = vec![false; count];
    for root in 0..count {
        if is_done[root] {
            continue;
        }
        let starts = spread(edges, root, count);
        starts.iter().enumerate().filter(|(_, start)| start.is_some()).for_each(|(i, _)| is_done[i] = true);
        let only_root: Vec<bool> = (0..count).map(|i| i == root).collect();
        let links = links.read(|models| models.iter().all(|i| starts[*i].is_some()))?;
        let adjusted = adjust(&links, &starts, &only_root);
        lay_group(&links, &adjusted, is_placed, &mut moves);
    }
    Ok(moves)
}

/// The frames of all models that are linked to `root`, in the frame of `root`, by way of the links with most pairs.
fn spread(edges: &[Edge], root: usize, count: usize) -> Vec<Option<Similarity>> {
    let mut frames = vec![None; count];
    frames[root] = Some(Similarity::IDENTITY);
    loop {
        let next = edges.iter().filter_map(|edge| {
            let [first, second] = edge.models;
            match [frames[first], frames[second]] {
                [Some(by), None] => Some((edge.pairs, second, by.after(&edge.first_from_second))),
                [None, Some(by)] => Some((edge.pairs, first, by.after(&edge.first_from_second.inverse()))),
                _ => None,
            }
        });
        // Of several links with most pairs, the first in the order of models counts.
        let Some((_, model, by)) = next.reduce(|a, b| if b.0 > a.0 { b } else { a }) else { return frames };
        frames[model] = Some(by);
    }
}

/// Lays a group of adjusted models on the model that leaves most models where they were, if possible on one whose place is
/// known, and notes the moves of the others.
fn lay_group(
    links: &[Link],
    adjusted: &[Option<Frame>],
    is_placed: &[bool],
    moves: &mut [Option<Similarity>],
) {
    let group: Vec<(usize, Frame)> =
        adjusted.iter().enumerate().filter_map(|(i, frame)| Some((i, (*frame)?))).collect();
    let stays_on = |anchor: &Frame| -> Vec<usize> {
        let back = anchor.by.inverse();
        let stays = |(i, frame): &&(usize, Frame)| {
            let limit_px =
                STAY_PX.max(STAY_DEVIATIONS * libm::hypot(frame.deviation_px, anchor.deviation_px));
            difference_px(links, *i, &back.after(&frame.by), &Similarity::IDENTITY) <= limit_px
        };
        group.iter().filter(stays).map(|(i, _)| *i).collect()
    };
    let pairs_of = |i: usize| -> usize {
        links.iter().filter(|link| link.models.contains(&i)).map(|link| link.pairs.len()).sum()
    };
    let rank = |(i, frame): &(usize, Frame)| {
        let staying = stays_on(frame);
        ((is_placed[*i], staying.len(), pairs_of(*i)), staying, frame.by)
    };
    let best = group.iter().map(rank).reduce(|a, b| if b.0 > a.0 { b } else { a });
    let Some((_, staying, anchor)) = best.filter(|(_, staying, _)| staying.len() < group.len()) else {
        return;
    };
    let back = anchor.inverse();
    let mut starts = vec![None; adjusted.len()];
    let mut is_fixed = vec![false; adjusted.len()];
    for (i, frame) in &group {
        is_fixed[*i] = staying.contains(i);
        starts[*i] = Some(if is_fixed[*i] { Similarity::IDENTITY } else { back.after(&frame.by) });
    }
    for (i, frame) in adjust(links, &starts, &is_fixed).into_iter().enumerate() {
        if let Some(frame) = frame.filter(|_| !is_fixed[i]) {
            moves[i] = Some(frame.by);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::adjust::tests::{Dice, PIXEL_M, apart_m, link};
    use super::*;

    fn laid(edges: &[Edge], links: Vec<Link>, count: usize) -> Vec<Option<Similarity>> {
        laid_on(edges, links, &vec![true; count])
    }

    fn laid_on(edges: &[Edge], links: Vec<Link>, is_placed: &[bool]) -> Vec<Option<Similarity>> {
        let folder = tempfile::tempdir().unwrap();
        let mut file = LinkFile::new(folder.path()).unwrap();
        file.extend(links).unwrap();
        lay(edges, &file, is_placed).unwrap()
    }

    /// Links between every two models whose frames are `world_from`, as they would be measured.
    fn measured(dice: &mut Dice, world_from: &[Similarity]) -> (Vec<Edge>, Vec<Link>) {
        let (mut edges, mut links) = (Vec::new(), Vec::new());
        for one in 0..world_from.len() {
            for other in one + 1..world_from.len() {
                let pairs = 400 - 10 * one;
                let first_from_second = world_from[one].inverse().after(&world_from[other]);
                edges.push(Edge { models: [one, other], first_from_second, pairs });
                links.push(link(dice, [one, other], world_from, pairs));
            }
        }
        (edges, links)
    }

    #[test]
    fn models_in_one_frame_stay_and_the_one_that_is_off_moves() {
        for wrong in 0..4 {
            let mut dice = Dice(wrong as u64);
            let mut frames = vec![Similarity::IDENTITY; 4];
            let (edges, links) = measured(&mut dice, &frames);
            assert_eq!(laid(&edges, links, 4), vec![None; 4]);
            frames[wrong] = dice.similarity();
            let (edges, links) = measured(&mut dice, &frames);
            let moves = laid(&edges, links, 4);
            for (i, by) in moves.iter().enumerate() {
                assert_eq!(by.is_some(), i == wrong, "model {i} of {wrong}");
            }
            let apart_m = apart_m(&moves[wrong].unwrap(), &frames[wrong]);
            assert!(apart_m < 0.2 * PIXEL_M, "{apart_m} m off");
        }
    }

    #[test]
    fn if_every_model_is_off_all_are_laid_on_the_one_with_most_points() {
        let mut dice = Dice(5);
        let frames: Vec<Similarity> = (0..4).map(|_| dice.similarity()).collect();
        let (edges, links) = measured(&mut dice, &frames);
        let moves = laid(&edges, links, 4);
        assert_eq!(moves[0], None);
        for i in 1..4 {
            let right = frames[0].inverse().after(&frames[i]);
            let apart_m = apart_m(&moves[i].unwrap(), &right);
            assert!(apart_m < 0.2 * PIXEL_M, "model {i} is {apart_m} m off");
        }
    }

    #[test]
    fn models_without_a_place_are_laid_on_the_one_that_has_one() {
        let mut dice = Dice(6);
        // The first three lie in one frame, which is not that of the site.
        let off = dice.similarity();
        let frames = [off, off, off, Similarity::IDENTITY];
        let (edges, links) = measured(&mut dice, &frames);
        let moves = laid_on(&edges, links, &[false, false, false, true]);
        assert_eq!(moves[3], None);
        for by in &moves[..3] {
            let apart_m = apart_m(&by.unwrap(), &off);
            assert!(apart_m < 0.2 * PIXEL_M, "{apart_m} m off");
        }
    }

    #[test]
    fn groups_without_a_link_are_laid_apart() {
        let mut dice = Dice(9);
        let frames: Vec<Similarity> = (0..4).map(|_| dice.similarity()).collect();
        let (edges, links) = measured(&mut dice, &frames);
        let is_inside = |models: &[usize; 2]| (models[0] < 2) == (models[1] < 2);
        let edges: Vec<Edge> = edges.into_iter().filter(|edge| is_inside(&edge.models)).collect();
        let links: Vec<Link> = links.into_iter().filter(|link| is_inside(&link.models)).collect();
        let stays: Vec<bool> = laid(&edges, links, 5).iter().map(Option::is_none).collect();
        assert_eq!(stays, [true, false, true, false, true], "the last model has no link");
    }
}
