//! The record of what operators have done: a file with a line of JSON for each action. Only the newest lines are kept, so
//! the file stays small.
//!
//! What it knows nothing about: who may act, and how actions are done.

use std::fmt;
use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use cosurf_scene::{SceneError, atomic, files};
use serde::Serialize;

/// Name of the file in the folder of the service.
const FILE: &str = "actions.jsonl";
/// Largest number of lines; the oldest ones go.
const LINES_MAX: usize = 1000;
/// Longest outcome, characters: a line stays below a kilobyte.
const OUTCOME_CHARS_MAX: usize = 300;

/// The record of a service.
#[derive(Debug)]
pub(super) struct Audit {
    path: PathBuf,
    /// Held while the file is written.
    writing: Mutex<()>,
}

#[derive(Serialize)]
struct Entry<'a> {
    /// Seconds since 1970.
    time_s: u64,
    /// The address of the browser or script, or of the proxy in front of it.
    by: IpAddr,
    action: &'a str,
    outcome: &'a str,
}

impl Audit {
    /// The record in the folder of a service.
    pub(super) fn of(folder: &Path) -> Self {
        Self { path: folder.join(FILE), writing: Mutex::new(()) }
    }

    /// Adds an action. `by` is where the request came from.
    pub(super) fn note(
        &self,
        by: IpAddr,
        action: &impl fmt::Display,
        outcome: &str,
    ) -> Result<(), SceneError> {
        let outcome: String = outcome.chars().take(OUTCOME_CHARS_MAX).collect();
        let time_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let entry = Entry { time_s, by, action: &action.to_string(), outcome: &outcome };
        let failed = |cause| SceneError::io(&self.path, cause);
        let line = serde_json::to_string(&entry).map_err(|cause| failed(io::Error::other(cause)))?;
        let _guard = self.writing.lock().unwrap_or_else(PoisonError::into_inner);
        let before = match files::read(&self.path) {
            Ok(bytes) => bytes,
            Err(SceneError::Io { cause, .. }) if cause.kind() == io::ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(error),
        };
        let before = String::from_utf8_lossy(&before);
        let kept: Vec<&str> = before.lines().rev().take(LINES_MAX - 1).collect();
        let mut text: String = kept.into_iter().rev().flat_map(|line| [line, "\n"]).collect();
        text.push_str(&line);
        text.push('\n');
        atomic::write_bytes(&self.path, text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_newest_actions_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(FILE);
        let old: String = (0..LINES_MAX + 5).map(|i| format!("{{\"old\":{i}}}\n")).collect();
        std::fs::write(&path, old).unwrap();
        let audit = Audit::of(folder.path());
        audit.note(IpAddr::from([127, 0, 0, 1]), &"merge now", "done\nwith \"quotes\"").unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!((lines.len(), lines[0]), (LINES_MAX, "{\"old\":6}"));
        let last: serde_json::Value = serde_json::from_str(lines[LINES_MAX - 1]).unwrap();
        assert_eq!((&last["by"], &last["action"]), (&"127.0.0.1".into(), &"merge now".into()));
        assert!(
            last["time_s"].as_u64().unwrap() > 1_700_000_000 && last["outcome"] == "done\nwith \"quotes\""
        );
    }
}
