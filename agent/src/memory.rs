//! How much memory the process takes, as the operating system counts it.

use std::fs;

/// Peak resident memory of this process so far; 0 where the system does not tell.
pub fn peak_bytes() -> u64 {
    status_kib("VmHWM:") * 1024
}

/// Memory that other programs leave free; `None` where the system does not tell.
pub fn available_bytes() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    kib_after(&text, "MemAvailable:").map(|kib| kib * 1024)
}

fn status_kib(field: &str) -> u64 {
    fs::read_to_string("/proc/self/status").ok().and_then(|text| kib_after(&text, field)).unwrap_or(0)
}

fn kib_after(text: &str, field: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(field))?;
    line.split_whitespace().next()?.parse().ok()
}
