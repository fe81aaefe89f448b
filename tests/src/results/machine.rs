//! The date, the machine and the commit of a measurement.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

/// The root of the workspace.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// The commit that is checked out, with a `+` if files other than the documents differ from it; `unknown` without
/// git.
pub fn commit() -> String {
    let Some(commit) = git(&["rev-parse", "--short=7", "HEAD"]) else { return "unknown".to_owned() };
    let changes =
        git(&["status", "--porcelain", "--", ".", ":!shared/docs", ":!README.md"]).unwrap_or_default();
    if changes.is_empty() { commit } else { commit + "+" }
}

/// Whether the history of the checked-out commit contains another commit. `None` if the history is not available: without git, outside of a
/// repository, or in a shallow clone.
pub fn has_commit(commit: &str) -> Option<bool> {
    let is_whole = root().join(".git").exists()
        && git(&["rev-parse", "--is-shallow-repository"]).as_deref() == Some("false");
    is_whole.then(|| git(&["merge-base", "--is-ancestor", commit, "HEAD"]).is_some())
}

/// The output of a git command in the root; `None` if the command fails or git is not installed.
fn git(words: &[&str]) -> Option<String> {
    let output = Command::new("git").args(words).current_dir(root()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// The processor's model as Linux names it; the processor's architecture if the name is not available.
pub fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    model.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, model)| model.trim().to_owned())
}

/// Number of cores that this process may use; 1 if the system does not tell.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Today's date in UTC, for example `2026-11-22`.
pub fn today() -> String {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    date(since.as_secs() / 86_400)
}

/// The date `days` days after 1970-01-01. The calculation begins years on 1 March, so that a leap day is the last
/// day of its year.
fn date(days: u64) -> String {
    let days = days + 719_468;
    let (era, of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * of_year + 2) / 153;
    let day = of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = 400 * era + year_of_era + u64::from(month <= 2);
    format!("{year}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    use super::date;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (days, text) in
            [(0, "1970-01-01"), (11_016, "2000-02-29"), (11_017, "2000-03-01"), (20_779, "2026-11-22")]
        {
            assert_eq!(date(days), text);
        }
    }
}
