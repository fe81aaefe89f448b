//! Fuzzes the packets of both versions of MQTT: valid packets that are changed at random, with the right length in half of
//! the cases. `FUZZ_EXECUTIONS` and `FUZZ_SEED` are those of `tests/tests/fuzz`.
#![allow(clippy::unwrap_used)]

use std::time::Instant;

use bytes::BytesMut;
use cosurf_tests::dice::Dice;
use cosurf_tests::mutate::mutated;

use super::{Version, packet_bytes, put_length, read, read_hello, version_of};

/// CONNECT with a will and a login, PUBLISH, PUBACK, SUBSCRIBE, UNSUBSCRIBE, PINGREQ and DISCONNECT without their first
/// length. In MQTT 5 most of them have properties.
fn samples(version: Version) -> Vec<Vec<u8>> {
    let (level, properties) = match version {
        Version::V3 => (4, &[][..]),
        Version::V5 => (5, &[0][..]),
    };
    let some = |bytes: &[u8]| if version == Version::V5 { bytes.to_vec() } else { Vec::new() };
    let text = |text: &str| [&[0, text.len() as u8][..], text.as_bytes()].concat();
    let connect = [
        &[0x10, 0, 4, b'M', b'Q', b'T', b'T', level, 0b1110_1110, 0, 60][..],
        &some(&[8, 0x11, 0, 0, 0, 9, 0x21, 0, 7]),
        &text("cosurf-agent-a-b"),
        &some(&[5, 0x18, 0, 0, 0, 3]),
        &text("gs/v1/a/b/state"),
        &text("will"),
        &text("user"),
        &text("word"),
    ];
    let publish = [&[0x33][..], &text("gs/v1/a/b/up/1/m"), &[0, 7], &some(&[5, 2, 0, 0, 0, 9]), &[1, 2, 3]];
    let subscribe = [&[0x82, 0, 8][..], &some(&[2, 0x0B, 1]), &text("gs/v1/a/+/state"), &[1]];
    let unsubscribe = [&[0xA2, 0, 9][..], properties, &text("gs/v1/a/+/state"), &text("#")];
    [
        connect.concat(),
        publish.concat(),
        subscribe.concat(),
        unsubscribe.concat(),
        [&[0x40, 0, 7][..], &some(&[0, 0])].concat(),
        vec![0xC0],
        [&[0xE0][..], &some(&[0, 5, 0x11, 0, 0, 0, 9])].concat(),
    ]
    .into_iter()
    .collect()
}

/// A packet with its length.
fn framed(packet: &[u8]) -> BytesMut {
    let mut out = BytesMut::from(&packet[..1]);
    put_length(&mut out, packet.len() - 1);
    out.extend_from_slice(&packet[1..]);
    out
}

fn hammer(name: &str, version: Version) {
    let number = |name: &str, usual| std::env::var(name).map_or(usual, |text| text.parse().unwrap());
    let (first, executions) = (number("FUZZ_SEED", 0u64), number("FUZZ_EXECUTIONS", 5_000u64));
    let samples = samples(version);
    for (i, sample) in samples.iter().enumerate() {
        assert!(read(&framed(sample), version).is_ok(), "{name}: sample {i} is valid and was refused");
    }
    let (begun, mut accepted) = (Instant::now(), 0u64);
    for seed in first..first + executions {
        let mut dice = Dice(seed);
        let bytes = mutated(&mut dice, &samples);
        if bytes.is_empty() {
            continue;
        }
        let packet = if dice.coin() { framed(&bytes) } else { BytesMut::from(&bytes[..]) };
        // As a connection does: one whole packet, or none.
        let Ok(Some(whole)) = packet_bytes(&packet, 1 << 17) else { continue };
        let Some(packet) = packet.get(..whole) else { continue };
        std::hint::black_box(version_of(packet).and_then(|version| read_hello(packet, version)));
        accepted += u64::from(read(packet, version).is_ok());
    }
    let rate = executions as f64 / begun.elapsed().as_secs_f64();
    println!(
        "{name:<18} {executions:>9} executions from seed {first}, {rate:>7.0}/s, {accepted:>9} accepted"
    );
}

#[test]
fn packets_of_mqtt_5_are_read_or_refused() {
    hammer("MQTT 5", Version::V5);
}

#[test]
fn packets_of_mqtt_3_are_read_or_refused() {
    hammer("MQTT 3.1.1", Version::V3);
}
