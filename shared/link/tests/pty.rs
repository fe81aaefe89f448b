//! The serial line through the operating system, on the wall clock: two pseudo-terminals with simulated
//! faults between them.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::num::NonZeroU32;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_link::faults::Line;
use cosurf_link::{Faults, Outgoing, PublishError, SerialConfig, SerialTransport, Transport, TransportEvent};
use cosurf_tests::radio::{self, BYTES_PER_S, pattern, radio};
use cosurf_wire::{DeviceId, ModelId, SiteId, Topic};
use serialport::{SerialPort, TTYPort};

/// The threads that carry bytes between two terminals. They end when this value is dropped.
struct Ether {
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Drop for Ether {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| thread.join().unwrap());
    }
}

/// Two transports with a faulty line between them.
fn pair(seed: u64, faults: Faults) -> (SerialTransport, SerialTransport, Ether) {
    let is_over = Arc::new(AtomicBool::new(false));
    let ((a_line, a), (b_line, b)) = (terminal(), terminal());
    let threads = vec![
        carry(a_line.try_clone_native().unwrap(), b_line.try_clone_native().unwrap(), seed, faults, &is_over),
        carry(b_line, a_line, seed ^ 1, faults, &is_over),
    ];
    let rate = faults.bytes_per_s.unwrap();
    (transport(a, rate, 100), transport(b, rate, 200), Ether { is_over, threads })
}

fn terminal() -> (TTYPort, TTYPort) {
    let (mut line, mut end) = TTYPort::pair().unwrap();
    line.set_timeout(Duration::from_millis(2)).unwrap();
    end.set_timeout(Duration::from_millis(5)).unwrap();
    (line, end)
}

fn transport(port: TTYPort, bytes_per_s: NonZeroU32, session: u64) -> SerialTransport {
    let mut port = Some(port);
    SerialTransport::start(SerialConfig {
        name: "pty".to_owned(),
        bytes_per_s,
        session,
        message_bytes_max: 70_000,
        open: Box::new(move || {
            let port = port.take().ok_or(io::ErrorKind::NotFound)?;
            Ok(Box::new(port))
        }),
    })
}

/// Carries bytes in one direction: cuts them into frames, and applies the line's faults to each frame.
fn carry(
    mut from: TTYPort,
    mut to: TTYPort,
    seed: u64,
    faults: Faults,
    is_over: &Arc<AtomicBool>,
) -> JoinHandle<()> {
    let is_over = Arc::clone(is_over);
    std::thread::spawn(move || {
        let (begun, mut line, mut frame) = (Instant::now(), Line::new(seed, faults), Vec::new());
        let mut arriving: BTreeMap<(Duration, u64), Vec<u8>> = BTreeMap::new();
        let (mut frames, mut buffer) = (0, [0; 512]);
        while !is_over.load(Ordering::Relaxed) {
            while let Some(first) = arriving.first_entry()
                && first.key().0 <= begun.elapsed()
            {
                write_all(&mut to, &first.remove(), &is_over);
            }
            let read = from.read(&mut buffer).unwrap_or(0);
            for byte in &buffer[..read] {
                frame.push(*byte);
                if *byte == 0 {
                    for arrival in line.carry(begun.elapsed(), &frame) {
                        frames += 1;
                        arriving.insert((arrival.at, frames), arrival.bytes);
                    }
                    frame.clear();
                }
            }
        }
    })
}

/// Writes all bytes, however long the reader takes on a busy computer, or until `is_over`.
fn write_all(to: &mut TTYPort, mut bytes: &[u8], is_over: &AtomicBool) {
    while !bytes.is_empty() && !is_over.load(Ordering::Relaxed) {
        match to.write(bytes) {
            Ok(count) => bytes = &bytes[count..],
            Err(error) if error.kind() == io::ErrorKind::TimedOut => {}
            Err(error) => panic!("{error}"),
        }
    }
}

/// Sends `count` bytes in messages of 16,000 bytes. Returns the goodput as a share of the line's bandwidth.
fn goodput(seed: u64, faults: Faults, count: usize) -> f64 {
    let (mut a, mut b, _ether) = pair(seed, faults);
    for end in [&mut a, &mut b] {
        assert_eq!(end.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
    }
    let bytes = pattern(count);
    let (begun, mut received) = (Instant::now(), Vec::new());
    let mut parts = (0..).zip(bytes.chunks(16_000)).map(|(index, part)| message(index, part)).peekable();
    while received.len() < count {
        while let Some(next) = parts.peek() {
            match a.publish(next) {
                Ok(()) => parts.next(),
                Err(PublishError::Busy) => break,
                Err(error) => panic!("{error}"),
            };
        }
        if let Some(TransportEvent::Incoming { payload, .. }) = b.poll(Duration::from_millis(5)) {
            received.extend_from_slice(&payload);
        }
        assert!(begun.elapsed() < Duration::from_secs(600), "it does not arrive");
    }
    let seconds = begun.elapsed().as_secs_f64();
    assert!(received == bytes, "other bytes arrived");
    count as f64 / seconds / f64::from(faults.bytes_per_s.unwrap().get())
}

fn message(index: u32, payload: &[u8]) -> Outgoing {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let topic = Topic::LocalChunk { device, model: ModelId(1), index }.to_text(&site);
    Outgoing { topic, payload: payload.to_vec(), retain: false }
}

/// The goodput of the simulated radio, as a share of its bandwidth: the mean over ten seeds.
fn simulated(loss: f64, count: usize) -> f64 {
    (0..10).map(|seed| radio::goodput(seed, loss, count).0).sum::<f64>() / 10.0
}

/// The radio with ten times the bandwidth and a tenth of the delay. It has the same goodput, as a share of
/// its bandwidth, but the test takes less time.
fn fast_radio(loss: f64) -> Faults {
    let faults = radio(loss);
    let delay = faults.delay_max / 10;
    let bytes_per_s = NonZeroU32::new(10 * BYTES_PER_S.get());
    Faults { delay_min: delay, delay_max: delay, bytes_per_s, ..faults }
}

#[test]
fn a_terminal_agrees_with_the_simulation() {
    let threads = [0.0, 0.05, 0.20].map(|loss| {
        std::thread::spawn(move || (loss, goodput(1, fast_radio(loss), 1 << 18), simulated(loss, 1 << 18)))
    });
    for thread in threads {
        let (loss, real, simulated) = thread.join().unwrap();
        println!(
            "loss {loss}: goodput {real:.3} through terminals at ten times the speed, {simulated:.3} simulated"
        );
        assert!((real - simulated).abs() < 0.06, "{real} against {simulated}");
    }
}

/// The acceptance test at the radio's real speed. Run it with
/// `cargo test --release -p cosurf-link --test pty -- --ignored --nocapture`.
#[test]
#[ignore = "takes five minutes"]
fn goodput_through_terminals() {
    let threads = [(0.0, 0.90), (0.05, 0.85), (0.20, 0.70)].map(|(loss, least)| {
        std::thread::spawn(move || (loss, least, goodput(1, radio(loss), 1 << 20), simulated(loss, 1 << 20)))
    });
    for thread in threads {
        let (loss, least, real, simulated) = thread.join().unwrap();
        println!("loss {loss}: goodput {real:.3} through terminals, {simulated:.3} simulated");
        assert!(real >= least && (real - simulated).abs() < 0.03, "{real} against {simulated}");
    }
}
