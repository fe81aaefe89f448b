//! Finds the poses with COLMAP, and puts them in their place.
//!
//! COLMAP draws at random where it begins. Now and then, about once in a hundred small flights, it begins with two
//! photographs that it misunderstands, and all others follow. The lens that it finds, GPS or control points show that: then it
//! begins once more, with other draws.

use std::path::Path;

use cosurf_contract::{AgentEvent, IngestStage};

use super::error::IngestError;
use super::lens::Lens;
use super::placing::{Placed, Places, up_of};
use super::recipe::Recipe;
use super::reconstruction::Reconstruction;
use super::settling::settle;
use super::stages::Stages;

/// Fewest photographs with a pose.
const POSED_MIN: usize = 3;
/// Seeds of COLMAP's draws, in their order.
const SEEDS: [u32; 2] = [0, 1];
/// Share of a contradiction from which COLMAP begins once more. GPS of drones is off by 3 m, so right poses only reach it
/// where a flight is about 10 m wide, which takes no time to repeat. The worst GPS seen so far was off by 17 m in a flight of
/// 150 m: a share of 0.3.
const AGAIN_FROM: f64 = 0.5;
/// Share of a contradiction from which places tell nothing: they are farther from the poses than from each other.
const NO_PLACE_FROM: f64 = 1.0;

/// Poses in their place.
pub(super) struct Found {
    pub(super) its: Reconstruction,
    pub(super) placed: Placed,
    /// Reconstructions of photographs that share too little with these.
    pub(super) others: Vec<Reconstruction>,
    /// What is wrong with a lens as COLMAP found it.
    lens_fault: Option<String>,
}

impl Found {
    /// Why the poses are likely to be wrong.
    fn doubt(&self) -> Option<String> {
        let its = &self.placed.contradiction;
        self.lens_fault.clone().or_else(|| (its.share > AGAIN_FROM).then(|| its.to_string()))
    }

    /// The poses with less of it are likelier.
    fn doubts(&self) -> (bool, f64) {
        (self.lens_fault.is_some(), self.placed.contradiction.share)
    }
}

/// Finds the poses of so many photographs: those of the draws that the measured places contradict least.
pub(super) fn find(
    recipe: &Recipe,
    stages: &mut Stages,
    places: Option<&Places>,
    photographs: usize,
) -> Result<Found, IngestError> {
    let log = stages.log(IngestStage::Poses);
    let [first, again] = SEEDS;
    let mut found = attempt(recipe, stages, &log, places, photographs, first)?;
    if let Some(reason) = found.doubt() {
        let reason = format!("{reason}; COLMAP looks for others");
        stages.tell(AgentEvent::LeftOut { name: "the first poses".into(), reason });
        found = match attempt(recipe, stages, &log, places, photographs, again) {
            Ok(other) if other.doubts() < found.doubts() => other,
            Ok(_) | Err(IngestError::NoPoses { .. }) => found,
            Err(error) => return Err(error),
        };
    }
    if found.placed.contradiction.share > NO_PLACE_FROM {
        let reason = format!("{}; these places or the poses are wrong", found.placed.contradiction);
        found.placed.left_out.push(("the place on the earth".into(), reason));
        found.placed.georeference = None;
    }
    Ok(found)
}

fn attempt(
    recipe: &Recipe,
    stages: &mut Stages,
    log: &Path,
    places: Option<&Places>,
    photographs: usize,
    seed: u32,
) -> Result<Found, IngestError> {
    stages.run(&recipe.poses(seed)?).map_err(|error| error.or_no_poses(photographs, log))?;
    let mut others = recipe.reconstructions(log)?;
    let mut its = others.swap_remove(best_of(&others, places));
    if its.posed.len() < POSED_MIN {
        return Err(IngestError::NoPoses { posed: its.posed.len(), photographs, log: log.to_owned() });
    }
    // The adjustment knows that pixels are square, so it hides such a fault.
    let lens_fault = its.lenses.iter().find_map(Lens::fault);
    let placed = settle(&mut its, places, &mut |event| stages.tell(event))?;
    Ok(Found { its, placed, others, lens_fault })
}

/// Index of the reconstruction that most GPS agrees with, or else with most photographs.
fn best_of(found: &[Reconstruction], places: Option<&Places>) -> usize {
    let worth = |i: &usize| {
        let its = &found[*i];
        let placed = places.zip(up_of(its)).and_then(|(places, up)| places.place(its, &up).ok());
        (placed.map_or(0, |placed| placed.agreeing), its.posed.len())
    };
    (0..found.len()).max_by_key(worth).unwrap_or(0)
}
