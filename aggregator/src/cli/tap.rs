//! `record` and `replay`: what was said on a broker, to a file and back.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_link::mqtt::tap::{self, ReplaySettings};
use cosurf_link::recording::Recording;
use cosurf_link::{BrokerAddress, Faults, Tls};
use cosurf_scene::TlsFiles;

/// Where a broker is, and how to come in.
#[derive(Args)]
struct BrokerArgs {
    /// The broker, for example mqtt://10.0.0.2:1883, or mqtts:// with the three files
    #[arg(long, value_name = "URL")]
    broker: BrokerAddress,
    /// Certificates of the authorities to trust
    #[arg(long, value_name = "FILE", requires_all = ["cert", "key"])]
    ca: Option<PathBuf>,
    /// Our certificate
    #[arg(long, value_name = "FILE", requires = "ca")]
    cert: Option<PathBuf>,
    /// Our private key
    #[arg(long, value_name = "FILE", requires = "ca")]
    key: Option<PathBuf>,
}

impl BrokerArgs {
    fn tls(&self) -> Result<Option<Tls>> {
        let files = match (&self.ca, &self.cert, &self.key) {
            (Some(ca), Some(cert), Some(key)) => {
                Some(TlsFiles { ca: ca.clone(), cert: cert.clone(), key: key.clone() })
            }
            _ => None,
        };
        Ok(Tls::for_broker(&self.broker, files.as_ref())?)
    }
}

/// Record all that is said on a broker to a file, until stopped with Ctrl-C.
///
/// The file holds time, topic, QoS, retain flag and payload of every message. Cut off at any moment, it is
/// readable up to its last whole message.
#[derive(Args)]
pub(crate) struct RecordArgs {
    /// Where to
    file: PathBuf,
    #[command(flatten)]
    broker: BrokerArgs,
    /// Record what is published under topics like this
    #[arg(long, value_name = "FILTER", default_value = "gs/v1/#")]
    filter: String,
    /// Print the outcome as a line of JSON
    #[arg(long)]
    json: bool,
}

/// Publish a recording again, with faults if wished.
#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// The recording
    file: PathBuf,
    #[command(flatten)]
    broker: BrokerArgs,
    /// So many times as fast as it was [default: as fast as the broker takes it]
    #[arg(long, value_name = "TIMES", value_parser = parse_speed)]
    speed: Option<f64>,
    /// Lose this share of the messages
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    loss: f64,
    /// Double this share of the messages
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    duplication: f64,
    /// Change a bit in this share of the messages
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    corruption: f64,
    /// Delay each message by up to this many milliseconds of the recording, so that they overtake each other
    #[arg(long, value_name = "MS", default_value_t = 0)]
    delay_ms: u32,
    /// Seed of the faults
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Print the outcome as a line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn record(args: &RecordArgs) -> Result<()> {
    let (tls, stop) = (args.broker.tls()?, stop_on_interrupt()?);
    let file = File::create(&args.file).with_context(|| args.file.display().to_string())?;
    let out = BufWriter::new(file);
    let count = tap::record(&args.broker.broker, tls.as_ref(), &args.filter, out, &stop)?;
    print("recorded", count, args.json)
}

pub(crate) fn replay(args: &ReplayArgs) -> Result<()> {
    let (tls, stop) = (args.broker.tls()?, stop_on_interrupt()?);
    let in_file = || args.file.display().to_string();
    let file = File::open(&args.file).with_context(in_file)?;
    let recording = Recording::open(BufReader::new(file)).with_context(in_file)?;
    let faults = Faults {
        loss: args.loss,
        duplication: args.duplication,
        corruption: args.corruption,
        delay_max: Duration::from_millis(u64::from(args.delay_ms)),
        ..Faults::NONE
    };
    let settings = ReplaySettings { speed: args.speed, faults, seed: args.seed };
    let count = tap::replay(&args.broker.broker, tls.as_ref(), recording, &settings, &stop)?;
    print("replayed", count, args.json)
}

fn stop_on_interrupt() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    ctrlc::set_handler(move || flag.store(true, Ordering::SeqCst)).context("Ctrl-C cannot be caught")?;
    Ok(stop)
}

fn print(what: &str, count: u64, json: bool) -> Result<()> {
    let mut stdout = io::stdout().lock();
    match json {
        true => writeln!(stdout, "{}", serde_json::json!({"event": what, "messages": count}))?,
        false => writeln!(stdout, "{what} {count} messages")?,
    }
    Ok(())
}

fn parse_speed(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(speed) if (1e-3..=1e6).contains(&speed) => Ok(speed),
        _ => Err("give a number from 0.001 to 1000000".into()),
    }
}

fn parse_share(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(share) if (0.0..=1.0).contains(&share) => Ok(share),
        _ => Err("give a number from 0 to 1".into()),
    }
}
