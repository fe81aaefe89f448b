//! Checks that a disk has room before long work begins whose result must be written to it.

use std::path::Path;

use crate::SceneError;

/// Fails with [`SceneError::DiskFull`] if less than `needed_bytes` can be written to the disk of an existing folder. Where
/// the free space cannot be found out, it is taken to be enough.
pub fn check_space(folder: &Path, needed_bytes: u64) -> Result<(), SceneError> {
    match free_bytes(folder) {
        Some(free_bytes) if free_bytes < needed_bytes => {
            Err(SceneError::DiskFull { folder: folder.to_owned(), free_bytes, needed_bytes })
        }
        _ => Ok(()),
    }
}

#[cfg(unix)]
fn free_bytes(folder: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(folder).ok()?;
    disk.f_bavail.checked_mul(disk.f_frsize)
}

#[cfg(not(unix))]
fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    #[cfg(unix)]
    fn a_disk_without_room_is_told_with_the_remedy() {
        let folder = tempfile::tempdir().unwrap();
        check_space(folder.path(), 1).unwrap();
        let error = check_space(folder.path(), u64::MAX).unwrap_err().to_string();
        let name = folder.path().display().to_string();
        assert!(error.starts_with(&name) && error.contains("another disk"), "{error}");
        check_space(&folder.path().join("nowhere"), u64::MAX).unwrap();
    }
}
