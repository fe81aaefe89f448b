//! The clock: sessions are numbered by it, and certificates are valid between two times.

use std::process::{Command, Stdio};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::Finding;

/// The start of 2024, seconds since 1970. A clock before it was not set since the computer started.
const SET_SINCE_S: u64 = 1_704_067_200;

/// Checks that the clock is set and synchronised.
pub fn check() -> Finding {
    found(SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default(), is_synchronised())
}

fn found(since_1970: Duration, is_synchronised: Option<bool>) -> Finding {
    match is_synchronised {
        _ if since_1970.as_secs() < SET_SINCE_S => {
            let remedy =
                "set it, for example by `timedatectl set-ntp true`, or by a GPS receiver through chrony";
            Finding::mend("clock", "it shows a time before 2024", remedy)
        }
        Some(true) => Finding::ok("clock", "synchronised"),
        Some(false) => {
            let remedy = "start systemd-timesyncd or chrony, or set the clock before each flight";
            Finding::note("clock", "not synchronised with a time server", remedy)
        }
        None => Finding::ok("clock", "set; whether it is synchronised is not known here"),
    }
}

/// What the kernel knows of the clock, as `timedatectl` tells it; `None` without this program.
fn is_synchronised() -> Option<bool> {
    let mut command = Command::new("timedatectl");
    command.args(["show", "--property=NTPSynchronized", "--value"]).stdin(Stdio::null());
    let output = command.output().ok()?;
    match output.stdout.trim_ascii() {
        b"yes" => Some(true),
        b"no" => Some(false),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_was_never_set_must_be_mended() {
        let (lost, set) = (Duration::from_secs(3600), Duration::from_secs(SET_SINCE_S));
        assert!(found(lost, Some(true)).is_fault() && found(lost, None).is_fault());
        assert!([Some(true), Some(false), None].iter().all(|known| !found(set, *known).is_fault()));
        assert!(found(set, Some(false)).to_string().starts_with("note"));
    }
}
