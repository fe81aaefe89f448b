//! Memory and time as Windows reports them.

use winsafe::{FILETIME, GlobalMemoryStatusEx, HPROCESS};

/// Units of a `FILETIME`, 100 ns, per second.
const TICKS_PER_S: f64 = 1e7;

pub(super) fn peak_bytes() -> u64 {
    HPROCESS::GetCurrentProcess().GetProcessMemoryInfo().map_or(0, |memory| memory.PeakWorkingSetSize as u64)
}

pub(super) fn resident_bytes() -> u64 {
    HPROCESS::GetCurrentProcess().GetProcessMemoryInfo().map_or(0, |memory| memory.WorkingSetSize as u64)
}

pub(super) fn available_bytes() -> Option<u64> {
    GlobalMemoryStatusEx().ok().map(|memory| memory.ullAvailPhys)
}

/// Windows limits jobs, not groups; a job's limit is not read.
pub(super) fn limit_bytes() -> Option<u64> {
    None
}

pub(super) fn cpu_seconds() -> f64 {
    let seconds = |time: FILETIME| {
        (u64::from(time.dwHighDateTime) << 32 | u64::from(time.dwLowDateTime)) as f64 / TICKS_PER_S
    };
    let times = HPROCESS::GetCurrentProcess().GetProcessTimes();
    times.map_or(0.0, |(_, _, kernel, user)| seconds(kernel) + seconds(user))
}
