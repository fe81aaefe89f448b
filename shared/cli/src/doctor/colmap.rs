//! COLMAP, which finds the poses of photographs. Only some commands need it.

use std::path::Path;
use std::process::{Command, Stdio};

use super::Finding;

/// Most characters of the version that are shown.
const VERSION_CHARS_MAX: usize = 80;

/// Checks that the program `colmap` runs, and tells its version.
pub fn check() -> Finding {
    check_program(Path::new("colmap"))
}

fn check_program(program: &Path) -> Finding {
    let output = Command::new(program).arg("help").stdin(Stdio::null()).output();
    let text = output.map(|output| String::from_utf8_lossy(&output.stdout).into_owned()).unwrap_or_default();
    match text.lines().find(|line| line.starts_with("COLMAP")) {
        Some(line) => Finding::ok("colmap", line.chars().take(VERSION_CHARS_MAX).collect::<String>()),
        None => {
            let remedy =
                "install it (on Debian and Ubuntu the package colmap) if photographs come without poses";
            Finding::note("colmap", "COLMAP is not on PATH", remedy)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_program_is_a_note() {
        let finding = check_program(Path::new("no-such-colmap")).to_string();
        assert!(finding.starts_with("note") && finding.contains("package colmap"), "{finding}");
    }
}
