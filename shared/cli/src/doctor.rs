//! `doctor`: what of a computer, and of the way to others, keeps a program from working, and how to mend it.
//!
//! What it is: one module for each check. A check returns a [`Finding`], which [`Doctor`] prints as one line.
//!
//! What it knows nothing about: which checks a program needs. The programs choose them by their configuration.
//!
//! Where to start reading: [`Finding`], then [`disk`].

pub mod clock;
pub mod colmap;
pub mod compute;
pub mod disk;
mod finding;
pub mod line;
pub mod memory;
pub mod port;

use std::io::{self, Write};

use anyhow::{Result, ensure};
use cosurf_contract::{Escaped, counted};

pub use finding::Finding;

/// Prints findings, and counts those that must be mended.
#[derive(Debug)]
pub struct Doctor {
    json: bool,
    checks: usize,
    faults: usize,
}

impl Doctor {
    /// A doctor that has found nothing yet. With `json`, it prints lines of JSON instead of text.
    pub fn new(json: bool) -> Self {
        Self { json, checks: 0, faults: 0 }
    }

    /// Prints a finding on a line of its own.
    pub fn tell(&mut self, finding: &Finding) -> Result<()> {
        self.checks += 1;
        self.faults += usize::from(finding.is_fault());
        let mut stdout = io::stdout().lock();
        match self.json {
            true => writeln!(stdout, "{}", serde_json::to_string(finding)?)?,
            false => writeln!(stdout, "{}", Escaped(finding))?,
        }
        Ok(())
    }

    /// Fails if any finding must be mended.
    pub fn finish(self) -> Result<()> {
        let Self { checks, faults, .. } = self;
        ensure!(
            faults == 0,
            "{faults} of {} failed: see the lines that begin with mend",
            counted(checks, "check")
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn only_what_must_be_mended_fails() {
        let mut doctor = Doctor::new(false);
        doctor.tell(&Finding::ok("disk", "100 GiB free")).unwrap();
        doctor.tell(&Finding::note("colmap", "absent", "install it")).unwrap();
        doctor.finish().unwrap();
        let mut doctor = Doctor::new(true);
        doctor.tell(&Finding::ok("disk", "100 GiB free")).unwrap();
        doctor.tell(&Finding::mend("clock", "1970", "set it")).unwrap();
        assert!(doctor.finish().unwrap_err().to_string().starts_with("1 of 2 checks failed"));
    }
}
