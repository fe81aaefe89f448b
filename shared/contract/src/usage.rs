//! Memory and CPU time of this process, as the operating system reports them (Linux).

use std::fs;

use cosurf_engine::budget::PROCESS_BYTES;

/// Peak resident memory of this process so far, bytes; 0 if the system does not report it.
pub fn peak_bytes() -> u64 {
    status_kib("VmHWM:") * 1024
}

/// Resident memory of this process, bytes; 0 if the system does not report it.
pub fn resident_bytes() -> u64 {
    status_kib("VmRSS:") * 1024
}

/// Resident memory of this process beyond [`PROCESS_BYTES`], which every process takes, bytes.
pub fn held_bytes() -> u64 {
    resident_bytes().saturating_sub(PROCESS_BYTES)
}

/// Memory of the computer that programs can still allocate without swapping (Linux: `MemAvailable`), bytes. `None` if
/// the system does not report it.
pub fn available_bytes() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    kib_after(&text, "MemAvailable:").map(|kib| kib * 1024)
}

/// CPU time of all threads of this process so far, seconds; 0 if the system does not report it.
pub fn cpu_seconds() -> f64 {
    let text = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    cpu_ticks(&text).map_or(0.0, |ticks| ticks as f64 / TICKS_PER_S)
}

/// Ticks per second of the times in `/proc` (`USER_HZ`). It is 100 on all architectures of Linux that this program
/// supports.
const TICKS_PER_S: f64 = 100.0;

/// User time plus system time, in ticks: fields 14 and 15 of a line of `/proc/<pid>/stat`. Field 3 is the first after
/// the last parenthesis. Field 2, the process name, may contain spaces and parentheses. `None` if the line is
/// malformed.
fn cpu_ticks(stat: &str) -> Option<u64> {
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field - 3)?.parse::<u64>().ok();
    Some(ticks(14)? + ticks(15)?)
}

fn status_kib(field: &str) -> u64 {
    fs::read_to_string("/proc/self/status").ok().and_then(|text| kib_after(&text, field)).unwrap_or(0)
}

fn kib_after(text: &str, field: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(field))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_time_is_read_past_odd_process_names() {
        let stat = "7 (a) b (c) R 1 7 7 0 -1 4194304 100 0 0 0 250 50 0 0 20 0 1 0 9";
        assert_eq!(cpu_ticks(stat), Some(300));
        assert_eq!((cpu_ticks("7 (a) R 1"), cpu_ticks("")), (None, None));
    }
}
