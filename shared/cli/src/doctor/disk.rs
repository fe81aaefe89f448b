//! The disk of a folder: whether it can be written, how much room it has, and how fast it is.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use cosurf_scene::bytes::format_bytes;
use cosurf_scene::{SceneError, check_space};

use super::Finding;

/// Bytes that are written to measure the speed.
const SAMPLE_BYTES: usize = 32 << 20;
/// Bytes of a single write.
const BLOCK_BYTES: usize = 1 << 20;
/// Below this speed, checkpoints hold up training noticeably: a model of a million splats has about 700 MB of them.
const SLOW_BYTES_PER_S: f64 = 10e6;

/// Checks the disk of `folder`, which need not exist yet, for `needed_bytes`.
pub fn check(folder: &Path, needed_bytes: u64) -> Finding {
    let there = nearest(folder);
    let speed = match write_speed(&there) {
        Ok(speed) => speed,
        Err(cause) => {
            let remedy = "let this user write there, or name another folder in `out`";
            return Finding::mend(
                "disk",
                format!("{}: cannot be written ({cause})", there.display()),
                remedy,
            );
        }
    };
    if let Err(error) = check_space(&there, needed_bytes) {
        return Finding::failed("disk", error);
    }
    let free = match check_space(&there, u64::MAX) {
        Err(SceneError::DiskFull { free_bytes, .. }) => format!("{} free, ", format_bytes(free_bytes)),
        _ => String::new(),
    };
    let found = format!("{}: {free}{:.0} MB/s", there.display(), speed / 1e6);
    match speed < SLOW_BYTES_PER_S {
        true => Finding::note("disk", found, "a faster disk makes checkpoints and merges faster"),
        false => Finding::ok("disk", found),
    }
}

/// The folder, or the nearest one above it that exists.
fn nearest(folder: &Path) -> PathBuf {
    let above = folder.ancestors().find(|folder| folder.is_dir());
    above.filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new(".")).to_owned()
}

/// Speed of writing to the disk of a folder, bytes per second. Leaves no file there.
fn write_speed(folder: &Path) -> io::Result<f64> {
    let mut file = tempfile::tempfile_in(folder)?;
    // Disks that compress would write zeros too fast.
    let block: Vec<u8> =
        (0..BLOCK_BYTES as u32).map(|i| (i.wrapping_mul(2_654_435_769) >> 24) as u8).collect();
    let begun = Instant::now();
    for _ in 0..SAMPLE_BYTES / BLOCK_BYTES {
        file.write_all(&block)?;
    }
    file.sync_data()?;
    Ok(SAMPLE_BYTES as f64 / begun.elapsed().as_secs_f64().max(1e-6))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_folder_to_come_is_checked_where_it_will_be_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let finding = check(&folder.path().join("a/b"), 1);
        assert!(!finding.is_fault() && finding.to_string().contains("MB/s"), "{finding}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn too_little_room_and_what_cannot_be_written_must_be_mended() {
        let folder = tempfile::tempdir().unwrap();
        let full = check(folder.path(), u64::MAX);
        assert!(full.is_fault() && full.to_string().contains("another disk"), "{full}");
        let finding = check(Path::new("/proc/self"), 1);
        assert!(finding.is_fault() && finding.to_string().contains("let this user write"), "{finding}");
    }
}
