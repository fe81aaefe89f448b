//! What a seed decides before a conversation begins.

use std::num::NonZeroU32;
use std::time::Duration;

use cosurf_link::{Faults, InboxLimits, Outages};
use cosurf_tests::dice::Dice;

/// How a site is protected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// Not at all: strangers write to any topic, and are believed.
    Open,
    /// The broker knows its clients: a hostile participant writes to the topics of its own name only.
    Fenced,
    /// All participants sign: strangers write to any topic.
    Signed,
}

/// What a seed decides before a conversation begins.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) mode: Mode,
    /// Number of honest drones at the lower site.
    pub(crate) drones: usize,
    /// Whether the lower aggregator sends its global model to an aggregator above.
    pub(crate) has_cloud: bool,
    /// Whether the global model is sent in tiles.
    pub(crate) has_tiles: bool,
    /// Whether the hostile participant has a listed key, where participants sign.
    pub(crate) has_insider: bool,
    pub(crate) faults: Faults,
    pub(crate) limits: InboxLimits,
    pub(crate) devices_max: usize,
    pub(crate) chunk_bytes: u32,
    /// Time that the attack lasts.
    pub(crate) attack: Duration,
    /// Longest pause between two hostile acts.
    pub(crate) pause: Duration,
    /// Number of kills, full disks and broker restarts.
    pub(crate) troubles: usize,
}

impl Plan {
    pub(crate) fn of(dice: &mut Dice) -> Self {
        let mode = [Mode::Signed, Mode::Signed, Mode::Fenced, Mode::Open][dice.below(4)];
        let has_cloud = dice.below(4) == 0;
        let has_tiles = !has_cloud && dice.below(16) == 0;
        let total_bytes_max = if has_tiles { 1 << 18 } else { 1 << (16 + dice.below(2)) };
        Self {
            mode,
            drones: 1 + dice.below(3),
            has_cloud,
            has_tiles,
            has_insider: mode == Mode::Fenced || (mode == Mode::Signed && dice.coin()),
            faults: faults(dice),
            limits: InboxLimits {
                body_bytes_max: total_bytes_max,
                total_bytes_max,
                models_max: 4 + dice.below(5),
                stored_max: 6 + dice.below(30),
            },
            devices_max: 5 + dice.below(6),
            chunk_bytes: [256, 300, 512, 2048][dice.below(4)],
            attack: Duration::from_millis(3000 + dice.below(20_000) as u64),
            pause: Duration::from_millis(200 + dice.below(1800) as u64),
            troubles: dice.below(8).saturating_sub(4),
        }
    }
}

/// Half of the networks have no faults. The others lose, duplicate, damage, truncate and delay messages.
fn faults(dice: &mut Dice) -> Faults {
    if dice.coin() {
        return Faults::NONE;
    }
    let delay_max = Duration::from_millis(dice.below(300) as u64);
    let outages = Outages { interval_mean: Duration::from_secs(20), duration_mean: Duration::from_secs(2) };
    Faults {
        loss: 0.1 * dice.unit(),
        duplication: 0.1 * dice.unit(),
        corruption: 0.02 * dice.unit(),
        truncation: 0.02 * dice.unit(),
        delay_min: delay_max / 4,
        delay_max,
        bytes_per_s: [None, NonZeroU32::new(20_000 << dice.below(5))][dice.below(2)],
        outages: (dice.below(4) == 0).then_some(outages),
    }
}
