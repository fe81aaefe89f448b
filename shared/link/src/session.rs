//! Session numbers that always increase, even if the clock goes back. A board without a battery starts in
//! 1970, and the first satellite fix may move its clock by years.

use std::io::{ErrorKind, Write};
use std::path::Path;

use cosurf_scene::{SceneError, atomic, files};

/// Numbers above this one are damage: no clock and no count of sessions comes near. It is the year 36,812.
const NUMBER_MAX: u64 = 1 << 40;

/// Returns the number of a new session, and writes it to the file at `path` so that the next session gets a
/// greater one. The number is `clock_s` (seconds since 1970) or the last number plus one, whichever is
/// greater. A file that cannot be read, or whose number is damaged, counts as missing; what is no file is set aside.
pub fn next_session(path: &Path, clock_s: u64) -> Result<u64, SceneError> {
    let text = files::read(path).and_then(|bytes| {
        String::from_utf8(bytes).map_err(|error| SceneError::malformed(path, error.to_string()))
    });
    if matches!(&text, Err(error) if files::is_damage(error)) {
        let kept = files::set_aside(path)?;
        tracing::warn!("{}: damaged, and set aside as {}", path.display(), kept.display());
    }
    let last = text.ok().and_then(|text| text.trim().parse().ok()).filter(|last| *last < NUMBER_MAX);
    let next = last.map_or(clock_s, |last: u64| clock_s.max(last + 1));
    unless_full(atomic::write(path, |out| writeln!(out, "{next}")))?;
    Ok(next)
}

/// Goes on although the disk is full: what would not start cannot tell it to anybody. The next session gets its number
/// from the clock.
fn unless_full(written: Result<(), SceneError>) -> Result<(), SceneError> {
    match written {
        Err(SceneError::Io { path, cause }) if cause.kind() == ErrorKind::StorageFull => {
            tracing::warn!("{}: the disk is full; the number of the session is not kept", path.display());
            Ok(())
        }
        written => written,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

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

    #[test]
    fn a_full_disk_does_not_keep_a_program_from_starting() {
        let failed = |kind: ErrorKind| SceneError::io(Path::new("session"), kind.into());
        assert!(unless_full(Err(failed(ErrorKind::StorageFull))).is_ok());
        assert!(unless_full(Err(failed(ErrorKind::PermissionDenied))).is_err());
    }

    /// With the highest number, no later session could count as new.
    #[test]
    fn a_damaged_number_does_not_disable_a_device_for_good() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("session");
        for text in [u64::MAX.to_string(), (u64::MAX - 1).to_string(), NUMBER_MAX.to_string(), "\u{0}".into()]
        {
            fs::write(&path, &text).unwrap();
            assert_eq!(
                [next_session(&path, 70).unwrap(), next_session(&path, 70).unwrap()],
                [70, 71],
                "{text}"
            );
        }
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert_eq!(next_session(&path, 80).unwrap(), 80);
        assert!(folder.path().join("session.damaged").is_dir());
    }
}
