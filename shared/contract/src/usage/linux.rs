//! Memory and time as Linux reports them, in files of `/proc` and `/sys`.

use std::fs;

use super::group;

pub(super) fn peak_bytes() -> u64 {
    status_kib("VmHWM:") * 1024
}

pub(super) fn resident_bytes() -> u64 {
    status_kib("VmRSS:") * 1024
}

/// `MemAvailable`, or less in a group of processes with a limit.
pub(super) fn available_bytes() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let of_computer = kib_after(&text, "MemAvailable:")? * 1024;
    Some(of_computer.min(group::free_bytes().unwrap_or(u64::MAX)))
}

pub(super) fn limit_bytes() -> Option<u64> {
    group::limit_bytes()
}

pub(super) fn cpu_seconds() -> f64 {
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
