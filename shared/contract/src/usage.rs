//! Memory and CPU time of this process, as the operating system reports them: on Linux and Windows. Elsewhere nothing is
//! known.

#[cfg(target_os = "linux")]
mod group;
#[cfg(target_os = "linux")]
mod linux;
#[cfg(not(any(target_os = "linux", windows)))]
mod unknown;
#[cfg(windows)]
mod windows;

#[cfg(target_os = "linux")]
use linux as system;
#[cfg(not(any(target_os = "linux", windows)))]
use unknown as system;
#[cfg(windows)]
use windows as system;

use cosurf_engine::budget::PROCESS_BYTES;

/// Peak resident memory of this process so far, bytes; 0 if the system does not report it.
pub fn peak_bytes() -> u64 {
    system::peak_bytes()
}

/// Resident memory of this process, bytes; 0 if the system does not report it.
pub fn resident_bytes() -> u64 {
    system::resident_bytes()
}

/// Resident memory of this process beyond [`PROCESS_BYTES`], which every process takes, bytes.
pub fn held_bytes() -> u64 {
    resident_bytes().saturating_sub(PROCESS_BYTES)
}

/// Memory that this process can still allocate without swapping, bytes: of the computer, and of its control group (a
/// container or a unit of systemd) if that has less. `None` if the system does not report it.
pub fn available_bytes() -> Option<u64> {
    system::available_bytes()
}

/// Limit on the memory of the control group that this process belongs to, bytes; `None` if there is none.
pub fn limit_bytes() -> Option<u64> {
    system::limit_bytes()
}

/// CPU time of all threads of this process so far, seconds; 0 if the system does not report it.
pub fn cpu_seconds() -> f64 {
    system::cpu_seconds()
}
