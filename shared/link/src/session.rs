//! Session numbers that always increase, even if the clock goes back. A board without a battery starts in
//! 1970, and the first satellite fix may move its clock by years.

use std::fs;
use std::io::Write;
use std::path::Path;

use cosurf_scene::{SceneError, atomic};

/// Returns the number of a new session, and writes it to the file at `path` so that the next session gets a
/// greater one. The number is `clock_s` (seconds since 1970) or the last number plus one, whichever is
/// greater. An unreadable file counts as missing.
pub fn next_session(path: &Path, clock_s: u64) -> Result<u64, SceneError> {
    let last = fs::read_to_string(path).ok().and_then(|text| text.trim().parse().ok());
    let next = last.map_or(clock_s, |last: u64| clock_s.max(last.saturating_add(1)));
    atomic::write(path, |out| writeln!(out, "{next}"))?;
    Ok(next)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const YEAR_S: u64 = 365 * 24 * 3600;

    #[test]
    fn session_numbers_increase_whatever_the_clock_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("session");
        let now = 56 * YEAR_S;
        let clocks = [now, now + 10, now - YEAR_S, 0, now + YEAR_S, now, now];
        let sessions: Vec<u64> = clocks.map(|clock| next_session(&path, clock).unwrap()).to_vec();
        assert!(sessions.windows(2).all(|pair| pair[0] < pair[1]), "{sessions:?}");
        assert_eq!((sessions[0], sessions[1]), (now, now + 10), "the clock's value while it increases");
        fs::write(&path, "torn").unwrap();
        assert_eq!(next_session(&path, 7).unwrap(), 7);
    }
}
