//! The serial line over simulated radios: no message is lost, duplicated or changed, and the goodput is high.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use cosurf_link::serial::ArqEvent;
use cosurf_tests::radio::{Air, goodput, joined, pattern, radio, storm};

#[test]
fn goodput_of_the_simulated_radio() {
    for (loss, least) in [(0.0, 0.90), (0.05, 0.85), (0.20, 0.70)] {
        let all: Vec<(f64, u64)> = (0..20).map(|seed| goodput(seed, loss, 1 << 20)).collect();
        let worst = all.iter().map(|run| run.0).fold(1.0, f64::min);
        let mean = all.iter().map(|run| run.0).sum::<f64>() / all.len() as f64;
        let collisions: u64 = all.iter().map(|run| run.1).sum();
        println!("loss {loss}: goodput {mean:.3}, worst seed {worst:.3}, {collisions} frames collided");
        assert!(worst >= least, "{worst}");
    }
}

#[test]
fn thousands_of_storms_both_ways() {
    for seed in 0..3000u64 {
        let mut air = Air::new(seed, storm(seed.wrapping_mul(0x9E37_79B9) >> 3));
        let sent = [pattern(300 + seed as usize % 9000), pattern(seed as usize % 3000)];
        for end in 0..2 {
            for (i, part) in sent[end].chunks(700).enumerate() {
                air.ends[end].queue([&(i as u32).to_le_bytes()[..], part].concat());
            }
        }
        while (0..2).any(|end| joined(&air.received[1 - end]).len() < sent[end].len()) {
            air.step();
            assert!(air.now < Duration::from_secs(3600), "seed {seed} never ends");
        }
        for end in 0..2 {
            assert!(joined(&air.received[1 - end]) == sent[end], "seed {seed}, end {end}");
            assert_eq!(air.events[end], [ArqEvent::Linked], "seed {seed}: no session was begun for nothing");
        }
    }
}

#[test]
fn an_outage_of_ten_minutes_loses_nothing_and_adds_little_delay() {
    let mut air = Air::new(3, radio(0.05));
    let sent = pattern(200_000);
    while air.events[0].is_empty() {
        air.step();
    }
    let outage = Duration::from_secs(600);
    air.cut_until = air.now + outage;
    let time = air.send_all(&sent, 16_000);
    assert!(joined(&air.received[1]) == sent);
    let alone = Duration::from_secs_f64(200_000.0 / 5760.0 / 0.85);
    assert!(time < outage + alone + Duration::from_secs(17), "{time:?}");
    assert_eq!(air.events[0], [ArqEvent::Linked, ArqEvent::Lost, ArqEvent::Linked], "reported to the owner");
}

#[test]
fn a_restart_of_either_side_is_reported_and_old_frames_are_ignored() {
    for end in 0..2 {
        let mut air = Air::new(9, radio(0.1));
        for i in 0..20u32 {
            air.ends[0].queue([&i.to_le_bytes()[..], &[0xAA; 1000]].concat());
        }
        while air.received[1].len() < 5 {
            air.step();
        }
        air.restart(end, 7777);
        air.events.iter_mut().for_each(Vec::clear);
        while air.events.iter().any(Vec::is_empty) {
            air.step();
            assert!(air.now < Duration::from_secs(100), "never linked again");
        }
        air.received[1].clear();
        air.send_all(&pattern(5000), 500);
        assert_eq!(joined(&air.received[1]), pattern(5000), "end {end}");
    }
}

#[test]
fn a_message_in_flight_is_not_queued_twice() {
    let mut air = Air::new(1, radio(0.0));
    for _ in 0..50 {
        air.ends[0].queue(vec![7; 2000]);
    }
    while air.received[1].is_empty() {
        air.step();
    }
    (0..1000).for_each(|_| air.step());
    assert_eq!(air.received[1].len(), 1);
    air.ends[0].queue(vec![7; 2000]);
    while air.received[1].len() < 2 {
        air.step();
    }
}
