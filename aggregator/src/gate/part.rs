//! Decides whether a part of a model that is still arriving may be added to a merged model.

use cosurf_link::Model;

use super::{Doubt, Frames, Place, Workspace, admit};
use crate::merge::{Locals, MergeError};

/// Index of the merged model.
const MERGED: usize = 0;
/// Index of the part.
const PART: usize = 1;

/// Compares a part with the merged model as [`admit`] compares models with each other. Returns where the part fits, or
/// why it is kept out. The merged model stays as it is, and so do the part's colours. `is_compressed` is true if the
/// part's model was pruned before upload.
pub(crate) fn admit_part(
    merged: &Model,
    part: &Model,
    is_compressed: bool,
    frames: Frames,
    workspace: Workspace,
    is_given_up: &dyn Fn() -> bool,
) -> Result<Result<Place, Doubt>, MergeError> {
    let both = Both { merged, part, is_compressed };
    let admitted = admit(&both, frames, workspace, is_given_up)?;
    // If one of the two must go, it is the part.
    let doubt = match &admitted.doubts[MERGED] {
        Some(_) => Some(Doubt::Contradicts(vec![MERGED])),
        None => admitted.doubts[PART].clone(),
    };
    if let Some(doubt) = doubt {
        return Ok(Err(doubt));
    }
    let place = admitted.places.iter().find(|place| place.local == PART);
    Ok(Ok(Place { tone: None, ..*place.expect("a model without a doubt has a place") }))
}

/// A merged model and a part.
struct Both<'a> {
    merged: &'a Model,
    part: &'a Model,
    is_compressed: bool,
}

impl Locals for Both<'_> {
    fn count(&self) -> usize {
        2
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        Ok(if index == PART { self.part.clone() } else { self.merged.clone() })
    }

    fn is_compressed(&self, index: usize) -> bool {
        index == PART && self.is_compressed
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec3;

    use super::super::Similarity;
    use super::super::links::tests::local;
    use super::super::tests::{MOVED, UNMOVED, elsewhere, flight, workspace};
    use super::*;

    fn joining(merged: &Model, part: &Model, frames: Frames) -> Result<Place, Doubt> {
        admit_part(merged, part, false, frames, workspace(&std::env::temp_dir()), &|| false).unwrap()
    }

    #[test]
    fn a_part_is_moved_to_where_it_fits() {
        let [merged, right] = [local(-3.0, 10), local(3.0, 10)];
        assert_eq!(joining(&merged, &right, MOVED).unwrap().by, None);
        let translation = DVec3::new(0.5, -0.3, 0.2);
        let off = Similarity { translation, ..Similarity::IDENTITY }.model(&right);
        let by = joining(&merged, &off, MOVED).unwrap().by.unwrap().by;
        let eye = right.cameras[0].cam_from_world.center();
        let apart_m = by.apply(eye + translation).distance(eye);
        assert!(apart_m < 0.03, "{apart_m} m off");
    }

    #[test]
    fn a_part_that_contradicts_the_merged_model_or_shares_nothing_with_it_is_kept_out() {
        let merged = flight(0.0);
        let raised = elsewhere(flight(4.0), 1.0, 0.0, DVec3::Z);
        assert_eq!(joining(&merged, &raised, UNMOVED), Err(Doubt::Contradicts(vec![0])));
        let mut many = raised.clone();
        many.cameras.extend_from_within(..);
        let more_cameras = joining(&merged, &many, UNMOVED);
        assert_eq!(more_cameras, Err(Doubt::Contradicts(vec![0])), "the part goes, not the merged model");
        assert_eq!(joining(&merged, &flight(60.0), UNMOVED), Err(Doubt::Unverified));
        let vouched = Frames { refine: false, vouched: true };
        assert!(joining(&merged, &flight(60.0), vouched).is_ok_and(|place| !place.is_verified));
        assert!(joining(&merged, &flight(4.0), UNMOVED).is_ok_and(|place| place.is_verified));
    }
}
