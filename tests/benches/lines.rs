//! Measures uploads and downloads over slow lines that break: the time and the bytes that they take beside those that the
//! model needs.
//!
//! `cargo bench -p cosurf-tests --bench lines -- --help`

use std::net::{Ipv4Addr, SocketAddr};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::Parser;
use cosurf_aggregator::broker::Broker;
use cosurf_link::{
    BrokerAddress, Identity, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Role, last_will,
};
use cosurf_tests::mosquitto::{Mosquitto, PLAIN};
use cosurf_tests::offers::{broker_address, offer};
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use cosurf_tests::slow_line::{LineSettings, SlowLine};
use cosurf_wire::{DeviceId, ModelKind, SiteId, TileId};

/// Measure transfers over slow lines that break. Prints a table, and writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    /// Time that the model takes on a line that does not break, seconds
    #[arg(long, value_name = "S", default_value_t = 36.0)]
    seconds: f64,
    /// Longest time that is waited for a transfer, as a multiple of that
    #[arg(long, value_name = "N", default_value_t = 12.0)]
    patience: f64,
    /// Measure only the rows whose names begin with this, for example `up, 2 kB/s`
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Passed by cargo to every bench
    #[arg(long, hide = true)]
    bench: bool,
}

/// Rates, kB/s.
const RATES: [f64; 5] = [2.0, 5.0, 10.0, 20.0, 50.0];
/// Times between cuts, seconds.
const CUTS_S: [u64; 4] = [10, 6, 3, 1];
/// Rate of lines that fail once, kB/s.
const FAILING_RATE: f64 = 10.0;
/// How long a line carries nothing although its connections stay open, and how long nothing can be reached, seconds.
const FAILURES: [Trouble; 2] = [Trouble::Silent(100), Trouble::Away(600)];
/// When such a line fails, seconds after the start.
const FAILS_AT_S: u64 = 20;
/// Bytes of one splat in a body, about.
const SPLAT_BYTES: f64 = 12.6;

/// What is wrong with a line besides its rate. Times are in seconds.
#[derive(Clone, Copy, Debug)]
enum Trouble {
    None,
    CutEach(u64),
    Silent(u64),
    Away(u64),
}

impl Trouble {
    fn name(self) -> String {
        match self {
            Self::None => "no cuts".into(),
            Self::CutEach(s) => format!("cut each {s} s"),
            Self::Silent(s) => format!("silent for {s} s"),
            Self::Away(s) => format!("away for {s} s"),
        }
    }

    /// The line with this trouble.
    fn of_line(self, bytes_per_s: f64) -> LineSettings {
        let slow = LineSettings::slow(bytes_per_s);
        let once = |s| Some([FAILS_AT_S, FAILS_AT_S + s].map(Duration::from_secs));
        match self {
            Self::None => slow,
            Self::CutEach(s) => LineSettings { cut_every: Some(Duration::from_secs(s)), ..slow },
            Self::Silent(s) => LineSettings { stall: once(s), ..slow },
            Self::Away(s) => LineSettings { away: once(s), ..slow },
        }
    }

    /// Time in which the line carries nothing, seconds.
    fn lost_s(self) -> f64 {
        match self {
            Self::None | Self::CutEach(_) => 0.0,
            Self::Silent(s) | Self::Away(s) => s as f64,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    Up,
    Down,
}

/// What came of one transfer.
struct Outcome {
    /// Time beside the least.
    time: Option<f64>,
    /// Bytes on the line beside those of the body.
    bytes: f64,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir()?;
    let mosquitto = Mosquitto::start(folder.path(), PLAIN, false).context("mosquitto is not installed")?;
    let own = Broker::start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
    let brokers = [("Mosquitto", mosquitto.address.clone()), ("built-in", broker_address(own.address()))];
    let cases: Vec<_> = RATES
        .iter()
        .flat_map(|rate| {
            let cuts = CUTS_S.iter().map(|s| Trouble::CutEach(*s));
            std::iter::once(Trouble::None).chain(cuts).map(move |trouble| (*rate, trouble))
        })
        .chain(FAILURES.map(|failure| (FAILING_RATE, failure)))
        .flat_map(|(rate, trouble)| [Way::Up, Way::Down].map(|way| (rate, trouble, way)))
        .filter(|(rate, trouble, way)| row_name(*rate, *trouble, *way).starts_with(&arguments.only))
        .collect();
    let columns: Vec<Column> = brokers
        .iter()
        .flat_map(|(name, _)| {
            let column = |what| Column::new(&format!("{what}, {name}"), "×", 2);
            let guarded = |what| column(what).guarded(Better::Lower, Tolerance::Relative(0.3));
            [guarded("time"), guarded("bytes")]
        })
        .collect();
    let mut measurement = Measurement::start("lines", &columns);
    // The transfers mostly wait, so all of them run at once.
    let outcomes: Vec<Vec<Outcome>> = thread::scope(|scope| {
        let running: Vec<Vec<_>> = cases
            .iter()
            .enumerate()
            .map(|(i, (rate, trouble, way))| {
                let fly = |(broker, address): (usize, &BrokerAddress)| {
                    let site = format!("site-{i}-{broker}");
                    let (address, arguments) = (address.clone(), &arguments);
                    scope.spawn(move || transfer(&site, &address, *rate, *trouble, *way, arguments))
                };
                brokers.iter().map(|(_, address)| address).enumerate().map(fly).collect()
            })
            .collect();
        running
            .into_iter()
            .map(|brokers| {
                brokers.into_iter().map(|thread| thread.join().expect("a transfer panicked")).collect()
            })
            .collect()
    });
    for ((rate, trouble, way), outcomes) in cases.iter().zip(&outcomes) {
        let cells: Vec<_> = outcomes.iter().flat_map(|outcome| [outcome.time, Some(outcome.bytes)]).collect();
        measurement.row(&row_name(*rate, *trouble, *way), &cells);
    }
    measurement.finish()?;
    Ok(())
}

fn row_name(rate: f64, trouble: Trouble, way: Way) -> String {
    let way = if way == Way::Up { "up" } else { "down" };
    format!("{way}, {rate} kB/s, {}", trouble.name())
}

fn transfer(
    site: &str,
    broker: &BrokerAddress,
    rate: f64,
    trouble: Trouble,
    way: Way,
    arguments: &Arguments,
) -> Outcome {
    let bytes_per_s = 1000.0 * rate;
    let splats = (bytes_per_s * arguments.seconds / SPLAT_BYTES) as usize;
    let kind = if way == Way::Up { ModelKind::Local } else { ModelKind::Global };
    let sender = if way == Way::Up { "drone" } else { "ground" };
    let whole = offer(sender, 1, kind, 1, splats, 65_536);
    let model =
        Offer::from_body(whole.header.device, whole.header.model, kind, 3, whole.body).expect("a valid body");
    let line = SlowLine::start(broker, trouble.of_line(bytes_per_s));
    let least = model.body.len() as f64 / bytes_per_s + trouble.lost_s();
    let patience = Duration::from_secs_f64(arguments.patience * least);
    let identity = |role, device: &str| Identity {
        site: SiteId::new(site).expect("a short name"),
        device: DeviceId::new(device).expect("a short name"),
        session: 1,
        role,
    };
    let (ground, drone) = (identity(Role::Aggregator, "ground"), identity(Role::Device, "drone"));
    let begun = Instant::now();
    let body = model.body.len() as f64;
    let is_done = match way {
        Way::Up => {
            run([(ground, broker), (drone, &line.address)], model, patience, |node, model| node.upload(model))
        }
        Way::Down => run([(drone, &line.address), (ground, broker)], model, patience, move |node, model| {
            node.broadcast(TileId::WHOLE, model, &[drone.device]);
        }),
    };
    let time = is_done.then(|| begun.elapsed().as_secs_f64() / least);
    Outcome { time, bytes: line.bytes()[usize::from(way == Way::Down)] as f64 / body }
}

/// Runs a receiver and a sender until the sender knows that its model is stored, at most for `patience`. Returns whether it
/// does.
fn run(
    [receiver, sender]: [(Identity, &BrokerAddress); 2],
    model: Offer,
    patience: Duration,
    send: impl FnOnce(&mut Node, Offer) + Send,
) -> bool {
    let start = Instant::now();
    let is_over = std::sync::atomic::AtomicBool::new(false);
    let step = |node: &mut Node, transport: &mut MqttTransport| {
        node.step(transport, || start.elapsed(), Duration::from_millis(50))
    };
    thread::scope(|scope| {
        scope.spawn(|| {
            let (mut node, mut transport) = connect(receiver);
            while !is_over.load(std::sync::atomic::Ordering::Relaxed) {
                if let Some(NodeEvent::Store { header, .. }) = step(&mut node, &mut transport) {
                    node.stored(header.into());
                }
            }
        });
        let (mut node, mut transport) = connect(sender);
        send(&mut node, model);
        let mut is_done = false;
        while !is_done && start.elapsed() < patience {
            is_done = matches!(step(&mut node, &mut transport), Some(NodeEvent::Uploaded(..)));
        }
        is_over.store(true, std::sync::atomic::Ordering::Relaxed);
        is_done
    })
}

fn connect((identity, broker): (Identity, &BrokerAddress)) -> (Node, MqttTransport) {
    let will = Some(last_will(&identity, None));
    let config = MqttConfig { broker: broker.clone(), identity, will, tls: None, login: None };
    (Node::new(identity, InboxLimits::default(), &[]), MqttTransport::start(config))
}
