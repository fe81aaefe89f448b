//! Default values that depend on the computer: the number of threads, the memory limit and the name of the device.

use std::thread::available_parallelism;

use anyhow::{Context, Result};
use cosurf_contract::config::AGGREGATOR_NAME;
use cosurf_wire::DeviceId;
use cosurf_wire::id::MAX_ID_BYTES;

/// Number of CPU cores that this process may use; 1 if it is unknown.
pub(super) fn cores() -> usize {
    available_parallelism().map_or(1, usize::from)
}

/// The memory limit in bytes if the user gives none: two thirds of the free memory, at most 8 GiB. If the free memory
/// is unknown, 2 GiB.
pub(super) fn default_memory() -> u64 {
    cosurf_contract::usage::available_bytes().map_or(2 << 30, |free| free / 3 * 2).min(8 << 30)
}

/// The device that is named after this computer.
pub(super) fn device() -> Result<DeviceId> {
    let host = host_name().unwrap_or_default();
    device_of(&host).with_context(|| {
        format!("the name of this computer, {host:?}, does not name a drone: write device = \"drone-1\"")
    })
}

#[cfg(unix)]
fn host_name() -> Option<String> {
    rustix::system::uname().nodename().to_str().ok().map(str::to_owned)
}

#[cfg(not(unix))]
fn host_name() -> Option<String> {
    std::env::var("COMPUTERNAME").ok()
}

/// The name of a computer without its domain, with a hyphen in place of each character that no device id has. `None` for
/// names that tell nothing, such as `localhost`, and for that of the aggregator.
fn device_of(host: &str) -> Option<DeviceId> {
    let label = host.split('.').next().unwrap_or_default();
    let allowed = |c: char| if c.is_ascii_alphanumeric() || c == '_' { c } else { '-' };
    let name: String = label.chars().map(allowed).take(MAX_ID_BYTES).collect();
    let is_taken = ["localhost", "(none)", AGGREGATOR_NAME].contains(&label);
    let tells = !is_taken && name.contains(|c: char| c != '-');
    tells.then(|| DeviceId::new(&name).ok()).flatten()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_computer_names_its_device_unless_its_name_tells_nothing() {
        let long = "x".repeat(80);
        for (host, device) in [
            ("drone-7", Some("drone-7")),
            ("drone_7.field.example.org", Some("drone_7")),
            ("Böing 7", Some("B-ing-7")),
            (&long, Some(&long[..64])),
            ("localhost", None),
            ("localhost.localdomain", None),
            ("(none)", None),
            ("global", None),
            ("aggregator.field.example.org", None),
            ("無人機", None),
            ("", None),
        ] {
            let found = device_of(host).map(|device| device.to_string());
            assert_eq!(found.as_deref(), device, "{host}");
        }
    }
}
