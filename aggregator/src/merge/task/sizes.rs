//! How large a task may be before it is read.

use super::super::error::MergeError;

/// Largest size of the encoded contents, bytes. A camera takes about 130.
const CONTENTS_BYTES_MAX: u64 = 64 << 20;
/// Largest size of a task, bytes. Nearly all are splats of teachers.
const TASK_BYTES_MAX: u64 = 16 << 30;

/// An error if the contents, which end at the byte `first`, or the whole task with its `bytes` are too large to be read.
pub(super) fn check_sizes(first: u64, bytes: u64) -> Result<(), MergeError> {
    at_most("bytes of contents", first, CONTENTS_BYTES_MAX)?;
    at_most("bytes", bytes, TASK_BYTES_MAX)
}

/// An error if `count` is more than `most`. `what` names what is counted.
pub(super) fn at_most(what: &str, count: u64, most: u64) -> Result<(), MergeError> {
    match count {
        _ if count > most => {
            Err(MergeError::TaskRefused { reason: format!("it has {count} {what}, more than {most}") })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_task_that_is_too_large_is_refused_before_it_is_read() {
        assert!(check_sizes(1000, TASK_BYTES_MAX).is_ok());
        for (first, bytes) in [(1000, TASK_BYTES_MAX + 1), (CONTENTS_BYTES_MAX + 1, TASK_BYTES_MAX)] {
            let error = check_sizes(first, bytes).unwrap_err().to_string();
            assert!(error.contains("refused"), "{error}");
        }
    }
}
