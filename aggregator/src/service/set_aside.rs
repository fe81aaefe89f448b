//! Damage to the service's own files, found at the start. What cannot be used is renamed and told, and everything else
//! starts.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cosurf_scene::{SceneError, files, ply};
use serde::de::IgnoredAny;

use super::checked;
use super::event::ServiceEvent;
use super::folder::{MADE_FILES, REPORT_FILES, global_ply};
use super::record::{MERGED, Merging, file_hash};
use super::restore::{self, HELD, WISHES, WISHES_LOCK};
use super::trial::{READING, SUSPECTS};

/// What follows if a file is set aside that the service makes.
const ANEW: &str = "the file is made anew";

/// Sets aside what an earlier run or somebody else has left in the place of the service's own files, and cannot be used.
/// They are made anew. Returns the events that tell it.
pub(super) fn set_aside_files(folder: &Path) -> Result<Vec<ServiceEvent>, SceneError> {
    let mut told = Vec::new();
    let recorded = Merging::read(folder).map(|record| record.files_blake3).unwrap_or_default();
    for name in MADE_FILES {
        let check = |path: &Path| match recorded.get(name) {
            Some(hash) if file_hash(path)? != *hash => {
                Err(SceneError::malformed(path, "its hash is not that of the last merge"))
            }
            None if path == global_ply(folder) => ply::check_length(path),
            _ => Ok(()),
        };
        told.extend(set_aside_unless(&folder.join(name), check, ANEW)?);
    }
    for name in REPORT_FILES.into_iter().chain([READING, WISHES, WISHES_LOCK]) {
        told.extend(set_aside_unless(&folder.join(name), |_| Ok(()), ANEW)?);
    }
    let is_whole = |path: &Path| checked::read::<IgnoredAny>(path).map(drop);
    for name in [SUSPECTS, HELD] {
        told.extend(set_aside_unless(&folder.join(name), is_whole, ANEW)?);
    }
    let is_whole = |path: &Path| checked::read::<Merging>(path).map(drop);
    told.extend(set_aside_unless(&folder.join(MERGED), is_whole, ANEW)?);
    let is_record = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "json");
    for path in restore::records(folder)?.into_iter().filter(is_record) {
        told.extend(set_aside_unless(&path, is_whole, "its revision can be restored no longer")?);
    }
    Ok(told)
}

/// Sets a file aside unless it can be opened and `check` accepts it, or it is missing. The event tells what `follows`.
fn set_aside_unless(
    path: &Path,
    check: impl Fn(&Path) -> Result<(), SceneError>,
    follows: &str,
) -> Result<Option<ServiceEvent>, SceneError> {
    match files::open(path).and_then(|_| check(path)) {
        Ok(()) => Ok(None),
        Err(SceneError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) if files::is_damage(&error) => {
            let kept = files::set_aside(path)?;
            let reason =
                format!("{error}; it is set aside as {}, which may be deleted; {follows}", kept.display());
            Ok(Some(ServiceEvent::SetAside { reason }))
        }
        Err(error) => Err(error),
    }
}
