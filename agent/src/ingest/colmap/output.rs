//! What COLMAP prints, versions 3.6 to 4: progress, and why it failed.

/// Longest line of an error that is told, characters.
const LINE_CHARS_MAX: usize = 300;

/// How far a command of COLMAP is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Progress {
    /// Photographs or blocks that are done.
    pub(crate) done: usize,
    /// Number of all of them, if COLMAP tells it.
    pub(crate) of: Option<usize>,
}

/// The progress that a line tells, if it does.
pub(super) fn progress(line: &str) -> Option<Progress> {
    let counted = [
        "Processed file [",
        "Matching image [",
        "Matching block [",
        "Processing image [",
        "Processing block [",
        "Undistorting image [",
    ];
    if let Some(counts) = counted.iter().find_map(|start| Some(line.split_once(start)?.1)) {
        let counts = counts.split_once(']')?.0.split(", ");
        // `[2/3, 1/4]` is the first of four parts of the second of three.
        return counts
            .map(part)
            .reduce(|outer, inner| {
                let ((done, of), (inner_done, inner_of)) = (outer?, inner?);
                Some((
                    done.checked_sub(1)?.checked_mul(inner_of)?.checked_add(inner_done)?,
                    of.checked_mul(inner_of)?,
                ))
            })?
            .map(|(done, of)| Progress { done, of: Some(of) });
    }
    // `Registering image #12 (34)`, since 3.12 `Registering image #12 (num_reg_frames=34)`.
    let (_, registering) = line.split_once("Registering image #")?;
    let number = registering.split_once('(')?.1.split_once(')')?.0;
    Some(Progress { done: number.rsplit('=').next()?.parse().ok()?, of: None })
}

fn part(text: &str) -> Option<(usize, usize)> {
    let (done, of) = text.split_once('/')?;
    Some((done.trim().parse().ok()?, of.trim().parse().ok()?))
}

/// The line that tells why COLMAP failed: the last that speaks of an error, or the last of all.
#[derive(Default)]
pub(super) struct Complaint {
    last: Option<String>,
    last_error: Option<String>,
}

impl Complaint {
    pub(super) fn read(&mut self, line: &str) {
        let line = line.trim();
        // The stack of a failed check tells a user nothing.
        let is_stack = line.contains("@ ") && line.contains("0x");
        if line.is_empty() || is_stack || line.starts_with("***") {
            return;
        }
        let text: String = line.chars().take(LINE_CHARS_MAX).collect();
        let lower = text.to_lowercase();
        // Ceres prints residuals as errors too; those of COLMAP are these.
        if ["error:", "failed", "exception", "cannot"].iter().any(|word| lower.contains(word))
            && !lower.contains("error [px]")
        {
            self.last_error = Some(text.clone());
        }
        self.last = Some(text);
    }

    pub(super) fn text(self) -> Option<String> {
        self.last_error.or(self.last)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn progress_of_old_and_new_versions_is_read() {
        for (line, done, of) in [
            ("Processed file [12/75]\n", 12, Some(75)),
            ("I20260101 10:00:00.000000 12 feature_extraction.cc:254] Processed file [1/2]", 1, Some(2)),
            ("Matching image [3/75] in 5.693s", 3, Some(75)),
            ("Matching block [2/3, 1/4] in 1.0s", 5, Some(12)),
            ("Undistorting image [75/75]", 75, Some(75)),
            ("Registering image #12 (34)", 34, None),
            ("Registering image #12 (num_reg_frames=34)", 34, None),
        ] {
            assert_eq!(progress(line), Some(Progress { done, of }), "{line}");
        }
        for line in [
            "",
            "Processed file [x/2]",
            "Processed file [",
            "Matching block [0/3, 1/4]",
            "Registering image #1",
            "Elapsed time",
        ] {
            assert_eq!(progress(line), None, "{line}");
        }
    }

    #[test]
    fn the_reason_of_a_failure_is_the_last_error_and_not_the_stack() {
        let reason = |text: &str| {
            let mut complaint = Complaint::default();
            text.lines().for_each(|line| complaint.read(line));
            complaint.text()
        };
        let text = "Loading\nERROR: failed to create sparse model\n\nElapsed time: 0.1 [minutes]\n*** Check failure stack trace: ***\n    @ 0x1  main\nPC: @   0x0 (unknown)\n";
        assert_eq!(reason(text).unwrap(), "ERROR: failed to create sparse model");
        assert_eq!(reason("one\ntwo\n").unwrap(), "two");
        assert_eq!(reason("\n"), None);
    }
}
