//! What the result of a tile may look like, whoever has written it into the store. A false result within these bounds is
//! not noticed.

use blake3::Hash;
use cosurf_scene::Splats;

use super::error::MergeError;
use super::learn::reach;
use super::task::Task;

/// What the result of a task may look like.
pub(super) struct Expected {
    pub(super) task: Hash,
    pub(super) sh_degree: u32,
    /// Number of splats of the tile. Distillation adds none.
    own: usize,
    /// The box that their means may have reached.
    low: [f64; 3],
    high: [f64; 3],
}

impl Expected {
    pub(super) fn of(task: &Task) -> Result<Self, MergeError> {
        let means = task.own_means()?;
        let reach = reach(task);
        let along = |axis: usize| means.iter().map(move |mean| f64::from(mean[axis]));
        Ok(Self {
            task: task.hash(),
            sh_degree: task.sh_degree(),
            own: means.len(),
            low: [0, 1, 2].map(|axis| along(axis).fold(f64::INFINITY, f64::min) - reach),
            high: [0, 1, 2].map(|axis| along(axis).fold(f64::NEG_INFINITY, f64::max) + reach),
        })
    }

    /// Largest number of splats.
    pub(super) fn splats_max(&self) -> usize {
        self.own
    }

    /// The error says what is wrong with these splats.
    pub(super) fn check(&self, splats: &Splats) -> Result<(), String> {
        if splats.len() > self.own {
            return Err(format!("it has {} splats, but the tile has {}", splats.len(), self.own));
        }
        if let Some(bad) = splats.find_bad_value() {
            return Err(format!("{} of splat {} is not finite or out of range", bad.field, bad.splat));
        }
        let is_inside = |mean: &[f32; 3]| {
            (0..3).all(|axis| (self.low[axis]..=self.high[axis]).contains(&f64::from(mean[axis])))
        };
        match splats.means.iter().position(|mean| !is_inside(mean)) {
            Some(splat) => Err(format!("splat {splat} lies outside of the tile")),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::super::results::{Found, find, keep};
    use super::*;
    use crate::store::Store;
    use crate::testing::ground;

    #[test]
    fn a_result_that_no_distillation_gives_is_bad_although_its_hash_fits() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::in_folder(folder.path()).unwrap();
        let own = ground(0.0, 3.0);
        let expected = Expected {
            task: blake3::hash(b"task"),
            sh_degree: own.sh_degree,
            own: own.len(),
            low: [-1.0, -20.0, -1.0],
            high: [4.0, 20.0, 1.0],
        };
        let found = |splats: &Splats| {
            keep(&store, &expected.task, splats).unwrap();
            find(&store, &expected).unwrap()
        };
        assert!(matches!(found(&own), Found::Sound(splats) if splats == own));
        let fewer = own.without(&[0, 2]);
        assert!(matches!(found(&fewer), Found::Sound(splats) if splats == fewer));
        let bad = |change: &dyn Fn(&mut Splats)| {
            let mut splats = own.clone();
            change(&mut splats);
            let found = found(&splats);
            let Found::Bad(reason) = found else { panic!("{found:?}") };
            reason
        };
        assert!(bad(&|its| its.means[0][1] = f32::NAN).contains("mean of splat 0"));
        assert!(bad(&|its| its.sh[0] = f32::INFINITY).contains("sh of splat 0"));
        assert!(bad(&|its| its.log_scales[3][0] = 50.0).contains("log_scale of splat 3"));
        assert!(bad(&|its| its.means[2][2] = -1.5).contains("splat 2 lies outside"));
        assert!(bad(&|its| its.push_from(&own, 0)).contains("bytes"), "more splats than the tile");
        let higher = Splats { sh_degree: 1, sh: vec![0.0; 12 * own.len() / 2], ..own.clone() };
        assert!(
            bad(&|its| *its = higher.without(&(own.len() as u32 / 2..own.len() as u32).collect::<Vec<_>>()))
                .contains("damaged")
        );
        let object = folder.path().join(expected.task.to_hex().as_str());
        for bytes in [Vec::new(), vec![7; 500]] {
            fs::write(&object, bytes).unwrap();
            assert!(matches!(find(&store, &expected).unwrap(), Found::Bad(_)));
        }
        fs::remove_file(&object).unwrap();
        assert!(matches!(find(&store, &expected).unwrap(), Found::Nothing));
    }
}
