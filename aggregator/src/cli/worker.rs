//! `worker`: distils tiles for merges on other computers.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::queue::Queue;
use cosurf_aggregator::store::Store;
use cosurf_aggregator::worker::{WorkerEvent, WorkerSettings, work};
use cosurf_engine::DeviceChoice;
use cosurf_scene::bytes::parse_bytes;

use super::host::cores;

/// Distil tiles for merges on other computers, until stopped with Ctrl-C. Any number of workers may share a queue; they
/// may be started and killed at any time.
#[derive(Args)]
pub(crate) struct WorkerArgs {
    /// NATS server with the queue, for example nats://10.0.0.1:4222
    #[arg(long, value_name = "URL")]
    queue: String,
    /// Where the tiles are kept, the same place as that of the merge: a folder, or an S3 bucket like s3://bucket/prefix.
    /// Keys, region and endpoint of a bucket are taken from the environment variables of Amazon's tools:
    /// AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, AWS_ENDPOINT_URL
    #[arg(long, value_name = "DIR|URL")]
    tiles: String,
    /// Limit on the memory, for example 500MiB. Tiles that need more are left to other workers
    #[arg(long, value_name = "BYTES", default_value = "4GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Number of CPU threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Device to compute on: auto, cpu, gpu or gpu:N. Tiles come only from merges on a device of the same class
    #[arg(long = "compute", alias = "device", value_name = "DEVICE", default_value_t)]
    device: DeviceChoice,
    /// Print events as lines of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &WorkerArgs) -> Result<()> {
    let store = Store::open(&args.tiles)?;
    let queue = Queue::open(&args.queue)?;
    let settings = WorkerSettings {
        device: args.device.open()?,
        threads: args.threads.map_or_else(cores, usize::from),
        memory_bytes: args.memory,
        scratch: std::env::temp_dir(),
    };
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed))?;
    let mut stdout = io::stdout().lock();
    let mut tell = |event: WorkerEvent| {
        let line =
            if args.json { serde_json::to_string(&event).unwrap_or_default() } else { event.to_string() };
        // Write errors are ignored: the worker works on without a reader.
        let _ = writeln!(stdout, "{line}").and_then(|()| stdout.flush());
    };
    work(&queue, &store, &settings, &|| stop.load(Ordering::Relaxed), &mut tell);
    Ok(())
}
