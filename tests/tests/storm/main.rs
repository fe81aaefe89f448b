//! A storm: all attacks of `shared/docs/OPERATING.md#keys`, and those on the built-in broker, at once and again and again,
//! while honest missions fly. The real programs take part: an aggregator with its own broker and 64 MiB for models, and
//! two agents for each mission, with signatures.
//!
//! The aggregator must stay within the memory that it tells at its start, and each mission must end with the bytes of the
//! undisturbed one. [`attacks`] has the attacks, [`mission`] the honest missions, [`ground`] the aggregator.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

mod act;
mod attacks;
mod field;
mod ground;
mod line;
mod mission;

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use cosurf_tests::datasets::write_city;
use cosurf_tests::dice::Dice;

use attacks::{ATTACKS, Attack, send_a_far_model};
use field::Field;
use ground::{Ground, make_keys, stay_on_cores};
use mission::{Fleet, Flight};

/// A storm and the missions in it.
struct Weather {
    lasts: Duration,
    /// Missions for which keys are made.
    missions_max: usize,
    /// Undisturbed missions, for comparison.
    calm: usize,
    steps: u32,
    pictures: u32,
    size_px: [u32; 2],
    /// Cores of the drones, and those of the aggregator and the attackers, in the notation of `taskset`.
    cores: [Option<&'static str>; 2],
    seed: u64,
}

/// What each attack has done, and how often it had to start anew.
type Deeds = Mutex<BTreeMap<&'static str, (u64, u64)>>;

/// Repeats an attack until the storm is over.
fn repeat(attack: &Attack, field: &Field, mut dice: Dice, deeds: &Deeds) {
    let (mut done, mut thrown_out) = (0, 0);
    while !field.is_over() {
        if let Ok(mut act) = (attack.begin)(field, &mut dice) {
            while !field.is_over()
                && let Ok(more) = act(&mut dice)
            {
                done += more;
                sleep(attack.pause);
            }
        }
        thrown_out += 1;
        sleep(attack.pause.min(Duration::from_millis(100)));
    }
    deeds.lock().unwrap().insert(attack.name, (done, thrown_out));
}

/// Ends the storm when dropped, so that a mission that fails ends the test.
struct Ends<'a>(&'a Field);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl Weather {
    /// Flies missions without and with a storm. Returns their times.
    fn compare(&self) -> [Vec<Duration>; 2] {
        if let Some(cores) = self.cores[1] {
            stay_on_cores(cores);
        }
        let folder = tempfile::tempdir().unwrap();
        let (data, keys) = (folder.path().join("data"), folder.path().join("keys"));
        write_city(&data, 60.0, self.pictures, self.size_px);
        make_keys(&keys, self.missions_max);
        let fleet = Fleet { data: &data, keys: &keys, steps: self.steps, cores: self.cores[0] };
        let ground = |name: &str| Ground::start(&folder.path().join(name), &keys, SETTINGS, self.cores[1]);

        let mut calm = ground("calm");
        let field = Field::new(calm.address, &keys, None);
        let undisturbed: Vec<Flight> =
            (0..self.calm).map(|number| fly_in_calm(&fleet, &calm, &field, number)).collect();
        let expected = &undisturbed[0].globals;
        assert!(undisturbed.iter().all(|flight| flight.globals == *expected), "calm missions differ");
        println!("peak without a storm: {} MiB of {}", calm.peak_bytes() >> 20, calm.bound_bytes >> 20);
        drop(calm);

        let mut ground = ground("storm");
        let field = Field::new(ground.address, &keys, None);
        let flights = self.fly_in_storm(&fleet, &mut ground, &field, &undisturbed[0]);
        // What the storm has left behind does no harm later.
        ground.restart();
        let after = fly_in_calm(&fleet, &ground, &field, field.mission() + 1);
        assert!(after.globals == *expected, "another global model after the storm");
        [undisturbed, flights].map(|flights| flights.iter().map(|flight| flight.time).collect())
    }

    /// Lets all attackers begin, and flies one mission after the other.
    fn fly_in_storm(
        &self,
        fleet: &Fleet<'_>,
        ground: &mut Ground,
        field: &Field,
        undisturbed: &Flight,
    ) -> Vec<Flight> {
        let deeds = Deeds::default();
        let (mut flights, begun) = (Vec::new(), Instant::now());
        thread::scope(|scope| {
            let _ends = Ends(field);
            for (place, attack) in ATTACKS.iter().enumerate() {
                let dice = Dice(self.seed << 8 | place as u64);
                let deeds = &deeds;
                scope.spawn(move || repeat(attack, field, dice, deeds));
            }
            sleep(Duration::from_secs(1));
            while flights.is_empty() || begun.elapsed() < self.lasts {
                let number = flights.len();
                field.begin_mission(number);
                let flight = fleet.fly(ground, number);
                assert!(flight.globals == undisturbed.globals, "mission {number}: another global model");
                println!(
                    "mission {number} in the storm: {:.1?}, peak {} MiB",
                    flight.time,
                    ground.peak_bytes() >> 20
                );
                if flight.time > undisturbed.time * 4 / 3 {
                    println!("a slow mission\n{}", flight.log);
                }
                flights.push(flight);
            }
        });
        // What the attackers send and take is printed, so that a storm that is none does not go unnoticed.
        let (peak, bound) = (ground.peak_bytes(), ground.bound_bytes);
        println!("peak in the storm: {} MiB of {}", peak >> 20, bound >> 20);
        for (name, (done, thrown_out)) in &*deeds.lock().unwrap() {
            println!("{done:>8} times, {thrown_out:>5} times thrown out: {name}");
            assert!(*done > self.lasts.as_secs() / 10, "too rare to show anything: {name}");
        }
        assert_log_is_sane(&ground.printed(), begun.elapsed());
        assert!(peak <= bound, "the aggregator takes {} MiB of {}", peak >> 20, bound >> 20);
        flights
    }
}

/// Flies a mission in which a third drone sends a model that shares no ground with the others.
fn fly_in_calm(fleet: &Fleet<'_>, ground: &Ground, field: &Field, number: usize) -> Flight {
    send_a_far_model(field, number as u64);
    let flight = fleet.fly(ground, number);
    println!("mission {number} in calm: {:.1?}", flight.time);
    flight
}

/// What strangers send neither fills the log nor begins lines in it.
fn assert_log_is_sane(log: &str, lasted: Duration) {
    assert!(!log.contains('\u{1b}') && !log.contains("revision 9\u{1b}"), "control characters in the log");
    let ignored = log.lines().filter(|line| line.starts_with("ignored")).count();
    println!("{ignored} lines about ignored messages");
    assert!(ignored < 1000 * (1 + lasted.as_secs() as usize / 60), "{ignored} lines about ignored messages");
}

/// Settings of the aggregator beside those that all have.
const SETTINGS: &str =
    "merge_memory_bytes = 67_108_864\nbroker_memory_bytes = 33_554_432\nclients_max = 256\n";

#[test]
fn missions_fly_through_a_storm() {
    let weather = Weather {
        lasts: Duration::from_secs(5),
        missions_max: 4,
        calm: 1,
        steps: 30,
        pictures: 8,
        size_px: [96, 72],
        cores: [None, None],
        seed: 24,
    };
    weather.compare();
}

/// The drones compute on a core of their own, as they would on their own computers. The attackers share the other core
/// with the aggregator. Run it with `cargo test --release -p cosurf-tests --test storm -- --ignored --nocapture`.
#[test]
#[ignore = "takes a quarter of an hour"]
fn missions_fly_through_ten_minutes_of_storm() {
    let seconds = std::env::var("STORM_S").map_or(600, |seconds| seconds.parse().unwrap());
    let weather = Weather {
        lasts: Duration::from_secs(seconds),
        missions_max: 100,
        calm: 3,
        steps: 600,
        pictures: 16,
        size_px: [160, 120],
        cores: [Some("0"), Some("1")],
        seed: 24,
    };
    let [calm, storm] = weather.compare();
    let (mean, slowest) = (calm.iter().sum::<Duration>() / calm.len() as u32, storm.iter().max().unwrap());
    println!("{} missions in the storm, the slowest {slowest:.1?}, undisturbed {mean:.1?}", storm.len());
    assert!(*slowest <= mean * 3 / 2, "{slowest:.1?} instead of {mean:.1?}: {storm:.1?}");
}
