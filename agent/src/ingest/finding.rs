//! Finds the poses with COLMAP, and puts them in their place.
//!
//! COLMAP draws at random where it begins. Now and then, about once in a hundred small flights, it begins with two
//! photographs that it misunderstands, and all others follow. A lens with oblong pixels, GPS or control points reveal that: then it
//! begins once more, with other draws.

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
/// Largest share of a contradiction. GPS of drones is off by 3 m, so right poses only reach it where a flight is about 10 m wide,
/// whose scale GPS does not tell. The worst GPS seen so far was off by 17 m in a flight of 150 m: a share of 0.3.
const SHARE_MAX: f64 = 0.5;

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
        let its = &self.placed.doubt;
        self.lens_fault.clone().or_else(|| (its.share > SHARE_MAX).then(|| its.to_string()))
    }

    /// The poses with less of it are likelier.
    fn doubts(&self) -> (bool, f64) {
        (self.lens_fault.is_some(), self.placed.doubt.share)
    }

    /// Notes what is still wrong after the last look. Places that contradict all poses do not count.
    fn conclude(mut self) -> Self {
        if let Some(fault) = &self.lens_fault {
            let reason = format!("{fault}, so the pictures were stretched, or the poses are wrong");
            self.placed.left_out.push(("square pixels".into(), reason));
        }
        if self.placed.contradiction.share > SHARE_MAX {
            let reason = format!("{}; these places or the poses are wrong", self.placed.contradiction);
            self.placed.left_out.push(("the place on the earth".into(), reason));
            self.placed.georeference = None;
        }
        self
    }
}

/// Finds the poses of so many photographs: those of the draws that the measured places contradict least.
pub(super) fn find(
    recipe: &Recipe,
    stages: &mut Stages,
    places: Option<&Places>,
    photographs: usize,
) -> Result<Found, IngestError> {
    let [first, again] = SEEDS;
    let found = attempt(recipe, stages, places, photographs, first)?;
    let Some(reason) = found.doubt() else { return Ok(found) };
    let tell = |stages: &mut Stages, name: &str, reason: String| {
        stages.tell(AgentEvent::LeftOut { name: name.to_owned(), reason });
    };
    tell(stages, "the first poses", format!("{reason}; COLMAP looks for others"));
    let why = match attempt(recipe, stages, places, photographs, again) {
        Ok(other) if other.doubts() < found.doubts() => return Ok(other.conclude()),
        Ok(_) => "they are no better".to_owned(),
        Err(error @ (IngestError::NoPoses { .. } | IngestError::Failed { .. })) => error.to_string(),
        Err(error) => return Err(error),
    };
    tell(stages, "the second poses", format!("{why}; the first ones stay"));
    Ok(found.conclude())
}

fn attempt(
    recipe: &Recipe,
    stages: &mut Stages,
    places: Option<&Places>,
    photographs: usize,
    seed: u32,
) -> Result<Found, IngestError> {
    let log = &stages.log(IngestStage::Poses);
    stages.run(&recipe.poses(seed)?).map_err(|error| error.or_no_poses(photographs, log))?;
    let found = recipe.reconstructions(log);
    if found.is_err() {
        stages.forget(IngestStage::Poses)?; // COLMAP ended well, but wrote nothing: the next run tries again
    }
    let mut others = found?;
    let mut its = others.swap_remove(best_of(&others, places));
    if its.posed.len() < POSED_MIN {
        return Err(IngestError::NoPoses { posed: its.posed.len(), photographs, log: log.clone() });
    }
    // As COLMAP found it: the adjustment holds pixels to be square to 5 %.
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
