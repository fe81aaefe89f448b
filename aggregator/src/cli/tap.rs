//! `record` and `replay`: write a broker's messages to a file, and publish them again.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Error, Result, anyhow, bail};
use clap::Args;
use cosurf_contract::{counted, read_password};
use cosurf_link::mqtt::TlsError;
use cosurf_link::mqtt::traffic::{self, ConnectionNews, ReplaySettings, TrafficError};
use cosurf_link::recording::Recording;
use cosurf_link::{BrokerAddress, Faults, Login, Tls, TlsFiles};
use cosurf_scene::SceneError;
use cosurf_scene::bytes::format_bytes;

/// Options that name a broker and the files for TLS.
#[derive(Args)]
struct BrokerArgs {
    /// The broker, for example mqtt://10.0.0.2:1883; mqtts:// and wss:// need --ca. If the broker asks for a login, also
    /// --cert with --key, or --user
    #[arg(long, value_name = "URL")]
    broker: BrokerAddress,
    /// PEM file with the certificates of the trusted authorities
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// PEM file with the certificate of this client
    #[arg(long, value_name = "FILE", requires_all = ["ca", "key"])]
    cert: Option<PathBuf>,
    /// PEM file with the private key of this client
    #[arg(long, value_name = "FILE", requires_all = ["ca", "cert"])]
    key: Option<PathBuf>,
    /// Name of the user at the broker; its password is in the environment variable COSURF_PASSWORD
    #[arg(long, value_name = "NAME")]
    user: Option<String>,
}

impl BrokerArgs {
    fn tls(&self) -> Result<Option<Tls>> {
        let own = |ca: &PathBuf| TlsFiles { ca: ca.clone(), cert: self.cert.clone(), key: self.key.clone() };
        let files = self.ca.as_ref().map(own);
        match Tls::for_broker(&self.broker, files.as_ref()) {
            Err(TlsError::OneWithoutOther) => {
                bail!("--broker: mqtts:// and wss:// need --ca, mqtt:// and ws:// must not have it")
            }
            tls => Ok(tls?),
        }
    }

    fn login(&self) -> Result<Option<Login>> {
        let Some(user) = self.user.clone() else { return Ok(None) };
        let password = read_password(None)?.context("--user: set COSURF_PASSWORD to the password")?;
        Ok(Some(Login { user, password }))
    }
}

/// Record a broker's messages to a file, until stopped with Ctrl-C.
///
/// If the connection is lost, tries again until the broker is back. Only a broker that never answered is an error.
///
/// The file holds the time, topic, QoS, retain flag and payload of every message. Damage costs the messages that it hit, and
/// a cut the last one; the others can be replayed.
#[derive(Args)]
pub(crate) struct RecordArgs {
    /// File to write, which must not exist yet
    file: PathBuf,
    #[command(flatten)]
    broker: BrokerArgs,
    /// MQTT topic filter of the messages to record
    #[arg(long, value_name = "FILTER", default_value = "gs/v1/#")]
    filter: String,
    /// Print the number of messages as a line of JSON
    #[arg(long)]
    json: bool,
}

/// Publish a recording again, optionally with injected faults.
#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// Recording to publish
    file: PathBuf,
    #[command(flatten)]
    broker: BrokerArgs,
    /// Playback speed relative to the recording [default: as fast as the broker accepts]
    #[arg(long, value_name = "TIMES", value_parser = parse_speed)]
    speed: Option<f64>,
    /// Share of the messages that are lost, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    loss: f64,
    /// Share of the messages that are sent twice, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    duplication: f64,
    /// Share of the messages in which a bit is flipped, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    corruption: f64,
    /// Delay each message by a random time of up to this many milliseconds. Messages may change their order. --speed
    /// shortens or stretches the delays as it does all other times of the recording
    #[arg(long, value_name = "MS", default_value_t = 0)]
    delay_ms: u32,
    /// Seed of the injected faults
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Print the number of messages as a line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn record(args: &RecordArgs) -> Result<()> {
    let (tls, login, stop) = (args.broker.tls()?, args.broker.login()?, stop_on_interrupt()?);
    let file = File::create_new(&args.file).map_err(|cause| match cause.kind() {
        io::ErrorKind::AlreadyExists => {
            anyhow!("{}: exists already; name another file, or delete it", args.file.display())
        }
        _ => SceneError::io(&args.file, cause).into(),
    })?;
    let recorded = traffic::record(
        &args.broker.broker,
        tls.as_ref(),
        login.as_ref(),
        &args.filter,
        BufWriter::new(file),
        &stop,
        tell,
    );
    if matches!(recorded, Err(TrafficError::NoBroker { .. })) {
        // Nothing is in it, and it would refuse the corrected command. If it stays, that command names the remedy.
        let _ = fs::remove_file(&args.file);
    }
    let count = recorded.map_err(|error| explain(error, &args.file))?;
    print("recorded", count, args.json)
}

pub(crate) fn replay(args: &ReplayArgs) -> Result<()> {
    let (tls, stop) = (args.broker.tls()?, stop_on_interrupt()?);
    let file = File::open(&args.file).map_err(|cause| SceneError::io(&args.file, cause))?;
    let recording = Recording::open(BufReader::new(file)).with_context(|| args.file.display().to_string())?;
    let faults = Faults {
        loss: args.loss,
        duplication: args.duplication,
        corruption: args.corruption,
        delay_max: Duration::from_millis(u64::from(args.delay_ms)),
        ..Faults::NONE
    };
    let settings = ReplaySettings { speed: args.speed, faults, seed: args.seed };
    let (count, lost) = traffic::replay(
        &args.broker.broker,
        tls.as_ref(),
        args.broker.login()?.as_ref(),
        recording,
        &settings,
        &stop,
    )
    .map_err(|error| explain(error, &args.file))?;
    if lost.places > 0 {
        let (bytes, places) = (format_bytes(lost.bytes), counted(lost.places, "place"));
        writeln!(
            io::stderr(),
            "{}: {bytes} at {places} are damaged or cut off; the messages there are left out",
            args.file.display()
        )?;
    }
    print("replayed", count, args.json)
}

/// Tells of the connection on standard error.
fn tell(news: ConnectionNews) {
    match news {
        ConnectionNews::NotYet { reason } => eprintln!("{reason}; trying again"),
        ConnectionNews::Lost { reason } => {
            eprintln!("{reason}; the recording goes on once the broker is back");
        }
        ConnectionNews::Back => eprintln!("connected again; the messages of the time between are missing"),
    }
}

/// Adds the recording's file or the remedy to an error.
fn explain(error: TrafficError, file: &Path) -> Error {
    match error {
        TrafficError::Write(cause) => SceneError::io(file, cause).into(),
        TrafficError::Recording(cause) => Error::new(cause).context(file.display().to_string()),
        error => anyhow!("{error}: check --broker, and that the broker runs"),
    }
}

fn stop_on_interrupt() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    ctrlc::set_handler(move || flag.store(true, Ordering::SeqCst))
        .context("cannot install the Ctrl-C handler")?;
    Ok(stop)
}

fn print(what: &str, count: u64, json: bool) -> Result<()> {
    let mut stdout = io::stdout().lock();
    match json {
        true => writeln!(stdout, "{}", serde_json::json!({"event": what, "messages": count}))?,
        false => writeln!(stdout, "{what} {}", counted(count, "message"))?,
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
