//! What a child process takes, measured from outside.

use std::fs;
use std::path::PathBuf;
use std::process::Child;
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Interval at which a process is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Ticks of `/proc/PID/stat` in a second, on every Linux.
const TICKS: f64 = 100.0;

/// What a process took until its end.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usage {
    /// Peak resident memory, bytes.
    pub peak_bytes: u64,
    /// That of the process that it started itself and that took most, bytes; 0 if it started none.
    pub largest_child_bytes: u64,
    /// Processor time of all threads, seconds.
    pub cpu_s: f64,
    /// Time from the call to the end of the process, seconds.
    pub wall_s: f64,
    /// Whether it ended well.
    pub succeeded: bool,
}

/// Waits for the end of a process. Linux only. What it takes in the last 20 ms is not seen.
pub fn watch(child: &mut Child) -> Usage {
    let (begun, mut usage) = (Instant::now(), Usage::default());
    loop {
        usage.peak_bytes = usage.peak_bytes.max(peak_bytes(child.id()).unwrap_or(0));
        let of_children = children(child.id()).into_iter().filter_map(peak_bytes).max().unwrap_or(0);
        usage.largest_child_bytes = usage.largest_child_bytes.max(of_children);
        usage.cpu_s = usage.cpu_s.max(cpu_s(child.id()).unwrap_or(0.0));
        if let Some(status) = child.try_wait().unwrap() {
            return Usage { wall_s: begun.elapsed().as_secs_f64(), succeeded: status.success(), ..usage };
        }
        sleep(LOOK_EVERY);
    }
}

/// Peak resident memory (`VmHWM` of Linux) of a process, bytes; `None` if it has ended.
pub fn peak_bytes(process: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? << 10)
}

/// The processes that a process has started.
fn children(process: u32) -> Vec<u32> {
    let Ok(threads) = fs::read_dir(format!("/proc/{process}/task")) else { return Vec::new() };
    let of_thread = |path: PathBuf| fs::read_to_string(path.join("children")).unwrap_or_default();
    let lists = threads.flatten().map(|thread| of_thread(thread.path()));
    lists
        .flat_map(|list| list.split_whitespace().filter_map(|id| id.parse().ok()).collect::<Vec<_>>())
        .collect()
}

/// Processor time in the program and in the kernel for it, seconds.
fn cpu_s(process: u32) -> Option<f64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The name of the program, in brackets, may have spaces.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS)
}
