//! The attacks. Each is repeated until the storm is over. The numbers are those of the tests (`attack_03` and so on).

mod doors;
mod echo;
mod floods;
mod traitor;
mod words;

use std::io;
use std::time::Duration;

use cosurf_tests::dice::Dice;

use crate::act::Act;
use crate::field::Field;

pub(crate) use traitor::send_a_far_model;

/// An attack.
pub(crate) struct Attack {
    /// Numbers of the attacks, and what it does.
    pub(crate) name: &'static str,
    /// Pause between two acts.
    pub(crate) pause: Duration,
    pub(crate) begin: for<'a> fn(&'a Field, &mut Dice) -> io::Result<Act<'a>>,
}

const fn attack(
    name: &'static str,
    pause_ms: u64,
    begin: for<'a> fn(&'a Field, &mut Dice) -> io::Result<Act<'a>>,
) -> Attack {
    Attack { name, pause: Duration::from_millis(pause_ms), begin }
}

/// All attacks, with their pauses in milliseconds.
pub(crate) const ATTACKS: [Attack; 25] = [
    attack("01 07 18 models of a trusted drone: huge pictures, junk, giants", 300, traitor::models),
    attack("02 small retained messages", 20, floods::retained),
    attack("02 absent sessions", 200, floods::absent_sessions),
    attack("03 04 08 forged replies to uploads", 5, words::replies),
    attack("05 08 forged replies to the global model", 5, words::global_replies),
    attack("04 09 13 forged and swapped headers", 10, words::headers),
    attack("04 junk chunks for the drones' uploads", 3000, words::chunks_for_victims),
    attack("04 18 bad messages, other versions", 40, words::bad_messages),
    attack("06 reservations, unsigned", 25, words::reservations),
    attack("06 08 09 high numbers, tiny chunks, wants: signed", 100, traitor::signed_words),
    attack("06 memory for the models of four trusted drones", 50, traitor::hoards),
    attack("10 idle and dripping sockets", 50, doors::drips),
    attack("10 clients without keep-alive", 100, doors::idle_clients),
    attack("10 bytes that are no MQTT", 50, doors::junk),
    attack("11 flights of ghosts", 100, words::flights),
    attack("12 forged global models", 50, words::globals),
    attack("13 cleared retained messages", 100, words::clear_retained),
    attack("14 the drones' client ids", 4000, doors::take_over_drones),
    attack("14 the aggregator's client id", 200, doors::take_over_ground),
    attack("15 600 subscriptions", 2000, floods::subscriptions),
    attack("16 topics with line breaks and ESC", 100, words::topics),
    attack("17 a slow subscriber of everything", 500, floods::slow_subscriber),
    attack("a reader of everything", 50, echo::listen),
    attack("replayed messages", 10, echo::replay),
    attack("ended sessions", 50, words::states),
];
