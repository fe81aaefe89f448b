//! Faults of a line between two ends, drawn from a seed. The simulated broker, the simulated radio and the
//! replay of recordings inject these faults.

use std::num::NonZeroU32;
use std::time::Duration;

/// The faults of a line. Probabilities are 0 to 1. Faults are drawn independently for each packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// Probability that a packet is lost.
    pub loss: f64,
    /// Probability that a packet arrives twice.
    pub duplication: f64,
    /// Probability that one bit of a packet is flipped.
    pub corruption: f64,
    /// Probability that a packet loses its end.
    pub truncation: f64,
    /// Minimum delay of a packet.
    pub delay_min: Duration,
    /// Maximum delay of a packet. Delays are uniform between minimum and maximum, so packets may overtake
    /// each other.
    pub delay_max: Duration,
    /// Bandwidth of the line, bytes per second; `None` for unlimited.
    pub bytes_per_s: Option<NonZeroU32>,
    /// Outages of the line; `None` for no outages.
    pub outages: Option<Outages>,
}

/// The outages of a line. Each duration is drawn uniformly between 0.5 and 1.5 times its mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outages {
    /// Mean time between the end of an outage and the start of the next one.
    pub interval_mean: Duration,
    /// Mean duration of an outage.
    pub duration_mean: Duration,
}

impl Faults {
    /// No faults, no delay, unlimited bandwidth.
    pub const NONE: Self = Self {
        loss: 0.0,
        duplication: 0.0,
        corruption: 0.0,
        truncation: 0.0,
        delay_min: Duration::ZERO,
        delay_max: Duration::ZERO,
        bytes_per_s: None,
        outages: None,
    };
}

/// One direction of a line, on virtual time.
#[derive(Debug)]
pub struct Line {
    faults: Faults,
    dice: Dice,
    /// When the line will have finished sending the last packet.
    free_at: Duration,
}

/// A packet that arrives at the far end of a [`Line`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// Time of arrival.
    pub at: Duration,
    /// The packet's bytes, possibly damaged or truncated.
    pub bytes: Vec<u8>,
}

impl Line {
    /// Makes a line. The same seed gives the same faults. `faults.outages` is ignored: the caller simulates
    /// outages with an [`OutagePlan`].
    pub fn new(seed: u64, faults: Faults) -> Self {
        Self { faults, dice: Dice::new(seed), free_at: Duration::ZERO }
    }

    /// Time at which the line is free for the next packet.
    pub fn free_at(&self) -> Duration {
        self.free_at
    }

    /// Sends a packet at `now`. Returns its arrivals at the far end: none, one or two.
    pub fn carry(&mut self, now: Duration, packet: &[u8]) -> Vec<Arrival> {
        self.free_at = self.free_at.max(now) + self.passing_time(packet.len());
        let copies = 1 + usize::from(self.dice.chance(self.faults.duplication));
        (0..copies).filter_map(|_| self.carry_copy(packet)).collect()
    }

    fn carry_copy(&mut self, packet: &[u8]) -> Option<Arrival> {
        if self.dice.chance(self.faults.loss) {
            return None;
        }
        let mut bytes = packet.to_vec();
        if !bytes.is_empty() && self.dice.chance(self.faults.corruption) {
            let place = self.dice.below(bytes.len() as u64) as usize;
            bytes[place] ^= 1 << self.dice.below(8);
        }
        if !bytes.is_empty() && self.dice.chance(self.faults.truncation) {
            bytes.truncate(self.dice.below(bytes.len() as u64) as usize);
        }
        let spread = self.faults.delay_max.saturating_sub(self.faults.delay_min).as_micros() as u64;
        let delay = self.faults.delay_min + Duration::from_micros(self.dice.below(spread + 1));
        Some(Arrival { at: self.free_at + delay, bytes })
    }

    fn passing_time(&self, bytes: usize) -> Duration {
        self.faults
            .bytes_per_s
            .map_or(Duration::ZERO, |rate| Duration::from_secs_f64(bytes as f64 / f64::from(rate.get())))
    }
}

/// An endless seeded schedule of outages.
#[derive(Debug)]
pub struct OutagePlan {
    outages: Outages,
    dice: Dice,
    is_out: bool,
    changes_at: Duration,
}

impl OutagePlan {
    /// Makes a schedule that starts without an outage.
    pub fn new(seed: u64, outages: Outages) -> Self {
        let mut plan = Self { outages, dice: Dice::new(seed), is_out: true, changes_at: Duration::ZERO };
        plan.change();
        plan
    }

    /// Whether the line is in an outage now.
    pub fn is_out(&self) -> bool {
        self.is_out
    }

    /// Time at which the next outage starts, or the present outage ends.
    pub fn changes_at(&self) -> Duration {
        self.changes_at
    }

    /// Starts or ends an outage, and draws the time of the next change.
    pub fn change(&mut self) {
        self.is_out = !self.is_out;
        let mean = if self.is_out { self.outages.duration_mean } else { self.outages.interval_mean };
        // The time until the next change is at least one microsecond, so that time advances.
        let mean_us = (mean.as_micros() as u64).max(2);
        self.changes_at += Duration::from_micros(mean_us / 2 + self.dice.below(mean_us));
    }
}

/// A random number generator: SplitMix64 (Steele, Lea and Flood 2014).
#[derive(Clone, Debug)]
pub struct Dice(u64);

impl Dice {
    /// Seeds the generator.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// 64 uniformly random bits.
    pub fn next_bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A uniformly random number below `limit`. For limits below 2⁴⁴, its relative bias is below 2⁻²⁰.
    pub fn below(&mut self, limit: u64) -> u64 {
        self.next_bits() % limit
    }

    /// `true` with the given probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        ((self.next_bits() >> 11) as f64 / (1u64 << 53) as f64) < probability
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const PACKET: [u8; 100] = [7; 100];

    fn carried(faults: Faults) -> Vec<Vec<Arrival>> {
        let mut line = Line::new(1, faults);
        (0..2000).map(|_| line.carry(Duration::ZERO, &PACKET)).collect()
    }

    fn share(count: usize) -> f64 {
        count as f64 / 2000.0
    }

    #[test]
    fn each_fault_occurs_with_its_probability() {
        let lost = carried(Faults { loss: 0.2, ..Faults::NONE });
        assert!((share(lost.iter().filter(|arrivals| arrivals.is_empty()).count()) - 0.2).abs() < 0.03);
        let doubled = carried(Faults { duplication: 0.3, ..Faults::NONE });
        assert!((share(doubled.iter().filter(|arrivals| arrivals.len() == 2).count()) - 0.3).abs() < 0.04);
        let damaged = carried(Faults { corruption: 0.1, ..Faults::NONE });
        let changed = |arrivals: &&Vec<Arrival>| {
            let bits = arrivals[0].bytes.iter().zip(PACKET).map(|(a, b)| (a ^ b).count_ones());
            bits.sum::<u32>() == 1
        };
        assert!((share(damaged.iter().filter(changed).count()) - 0.1).abs() < 0.03);
        let cut = carried(Faults { truncation: 0.1, ..Faults::NONE });
        assert!(
            (share(cut.iter().filter(|arrivals| arrivals[0].bytes.len() < 100).count()) - 0.1).abs() < 0.03
        );
    }

    #[test]
    fn delays_reorder_packets_and_bandwidth_delays_them() {
        let (delay_min, delay_max) = (Duration::from_millis(10), Duration::from_millis(50));
        let late = carried(Faults { delay_min, delay_max, ..Faults::NONE });
        let times: Vec<Duration> = late.iter().map(|arrivals| arrivals[0].at).collect();
        assert!(times.iter().all(|at| (delay_min..=delay_max).contains(at)));
        assert!(times.windows(2).any(|pair| pair[1] < pair[0]), "no packet overtook another");
        let slow = carried(Faults { bytes_per_s: NonZeroU32::new(1000), ..Faults::NONE });
        assert_eq!(slow[1999][0].at, Duration::from_secs(200));
    }

    #[test]
    fn outages_have_the_requested_mean_durations() {
        let outages =
            Outages { interval_mean: Duration::from_secs(10), duration_mean: Duration::from_secs(2) };
        let mut plan = OutagePlan::new(5, outages);
        let (mut last, mut out) = (Duration::ZERO, Duration::ZERO);
        for _ in 0..1000 {
            let duration = plan.changes_at() - last;
            out += if plan.is_out() { duration } else { Duration::ZERO };
            last = plan.changes_at();
            plan.change();
        }
        assert!((out.as_secs_f64() / last.as_secs_f64() - 2.0 / 12.0).abs() < 0.02, "{out:?} of {last:?}");
    }
}
