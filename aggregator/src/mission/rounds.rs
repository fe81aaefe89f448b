//! The rounds of a mission. In each, all agents train and their models are merged; in all but the first, they begin from the
//! global model of the round before, which also knows what the other agents photographed.
//!
//! Rendered Boruszyn, 160 px, four agents, 1,880 steps each: 33.61 dB in one round, 34.10 in two, and 33.89 for one model of
//! all pictures.
//!
//! What it knows nothing about: agents and aggregators.

use std::path::PathBuf;

use super::order::MissionOrder;
use super::plan::round_folder;

/// Epochs of the merges of all rounds but the last. On the same scene, two rounds of 1,250 and 630 steps end with 33.90,
/// 33.91 and 33.94 dB if the first has 0, 1 and 5 epochs.
const EPOCHS_MAX: u32 = 1;

/// A round.
pub(super) struct Round {
    /// What to do: as the mission's order, but with the steps of this round and, unless it is the last one, a folder of its
    /// own.
    pub(super) order: MissionOrder,
    /// Folder of the round before; `None` for the first.
    pub(super) before: Option<PathBuf>,
}

/// The rounds of a mission, in order, and the last one. Each has its share of the steps, at least one.
pub(super) fn rounds(order: &MissionOrder) -> (Vec<Round>, Round) {
    let count = order.settings.rounds.max(1);
    let out = |round: u32| match round == count {
        true => order.out.clone(),
        false => round_folder(&order.out, round),
    };
    let steps_until =
        |round: u32| (u64::from(order.settings.steps) * u64::from(round) / u64::from(count)) as u32;
    let round = |round: u32| {
        let mut its = MissionOrder { out: out(round), ..order.clone() };
        its.settings.steps = (steps_until(round) - steps_until(round - 1)).max(1);
        if round < count {
            its.settings.merge.epochs = its.settings.merge.epochs.min(EPOCHS_MAX);
        }
        Round { order: its, before: (round > 1).then(|| out(round - 1)) }
    };
    ((1..count).map(round).collect(), round(count))
}
