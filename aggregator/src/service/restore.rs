//! Older revisions of the global model: what each was merged from, and the operator's wish to make one of them the newest
//! again.
//!
//! A restored revision stays until the operator asks for a merge, or a device that it was merged from is forgotten. Models
//! that arrive until then are stored.
//!
//! What it knows nothing about: how a revision is read and sent.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use cosurf_link::{ModelKey, ModelStore, StoreError};
use cosurf_scene::{SceneError, atomic, files};
use serde::{Deserialize, Serialize};

use super::checked;
use super::error::ServiceError;
use super::folder::{global_store, written_s};
use super::model_list::{ModelList, any_listed};
use super::record::{Merging, WITHDRAWN, remove};

/// The file with the wishes, inside the folder of the service: a line for each, oldest first, with the number of a revision or
/// [`MERGE`].
pub(super) const WISHES: &str = "restore";
/// The file that is locked while the wishes are changed, inside the folder of the service.
pub(super) const WISHES_LOCK: &str = "restore.lock";
/// Largest number of wishes that wait. Each waits for the one before it, and a merge may take hours.
const WISHES_MAX: usize = 16;
/// The file with the number of the older revision that the newest one is a copy of, inside the folder of the service. It is
/// there as long as no merge may replace the copy, and outlasts damage to the files of the copy.
pub(super) const HELD: &str = "held";
/// The folder with the record of each revision that is kept, inside the folder of the service.
const RECORDS: &str = "revisions";

/// In the place of a number: a merge, which the restored revision must not outlast.
const MERGE: &str = "release";
/// In the place of [`MERGE`], once the merge was begun. The line stays until the merge is made, so it outlasts a kill.
const BEGUN_MERGE: &str = "merging";

/// The file [`HELD`].
#[derive(Serialize, Deserialize)]
struct Held {
    revision: u64,
}

/// What the operator wishes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wish {
    /// Make this revision the newest one.
    Restore(u64),
    /// Merge at once, and let that replace a restored revision.
    Merge,
    /// The same, and it was begun, in this run of the program or in one that was killed.
    BegunMerge,
    /// Its line in the file is damaged.
    Unreadable,
}

/// How far the merge is that the operator wishes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WishedMerge {
    /// None is wished, or this run of the program has not begun it.
    NotBegun,
    /// It is still to come, or running.
    Begun,
    Made,
}

impl Wish {
    fn of(line: &str) -> Self {
        match line {
            MERGE => Self::Merge,
            BEGUN_MERGE => Self::BegunMerge,
            number => number.parse().map_or(Self::Unreadable, Self::Restore),
        }
    }
}

/// A revision that can be restored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OldRevision {
    /// Its number.
    pub revision: u64,
    /// When it was made, as the date of its record's file tells: seconds since 1970; absent if the file has no date.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub made_s: Option<u64>,
    /// Number of splats.
    pub splats: usize,
    /// Number of local models that were merged.
    pub models: usize,
    /// The revision that it repeats; absent if it was merged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub restored_from: Option<u64>,
}

/// Why a revision is not restored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RestoreError {
    /// The service does not keep the revision, or not what it was merged from.
    #[error("revision {0} is not kept")]
    NotKept(u64),
    /// Its model is damaged.
    #[error("the model of revision {0} is damaged")]
    Damaged(u64),
    /// Nothing tells what it was merged from.
    #[error("the record of revision {0} ({RECORDS}/{0}.json) is damaged or missing")]
    NoRecord(u64),
    /// Another one may be restored in its place.
    #[error("{0}; {1}")]
    Instead(Box<Self>, String),
    /// It is the newest one.
    #[error("revision {0} is the newest one already")]
    Newest(u64),
    /// A device whose models it was merged from has been forgotten since.
    #[error("revision {0} was merged from models of a device that was forgotten since")]
    Withdrawn(u64),
    /// Too many wishes wait.
    #[error("{WISHES_MAX} restores and merges that were asked for still wait; ask again once some are done")]
    Busy,
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] SceneError),
    /// The stored revisions cannot be listed.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// The revisions that the service with this folder can restore, newest first.
pub fn old_revisions(folder: &Path) -> Result<Vec<OldRevision>, RestoreError> {
    let can_be_restored = |number: &u64| check(folder, *number).ok();
    let old = |record: Merging| OldRevision {
        revision: record.revision,
        made_s: written_s(&record_path(folder, record.revision)),
        splats: record.summary.splats,
        models: record.inputs.len().saturating_sub(record.kept_out.len()),
        restored_from: record.restored_from,
    };
    Ok(newest_first(folder)?.iter().filter_map(can_be_restored).map(old).collect())
}

/// The stored revisions of the service with this folder that cannot be restored, newest first, and why. The newest revision is
/// not among them.
pub fn lost_revisions(folder: &Path) -> Result<Vec<(u64, RestoreError)>, RestoreError> {
    let fault = |number: u64| {
        let error = check(folder, number).err()?;
        (!matches!(error, RestoreError::Newest(_))).then_some((number, error))
    };
    Ok(newest_first(folder)?.into_iter().filter_map(fault).collect())
}

/// What a stored revision of the service with this folder was merged from; `None` if that is not known.
pub(crate) fn record_of(folder: &Path, revision: u64) -> Option<Merging> {
    let record = checked::read::<Merging>(&record_path(folder, revision)).ok();
    record.filter(|record| record.revision == revision)
}

/// Asks the service with this folder to restore a revision, whether it is running or not. What was asked for before is done
/// before.
pub fn ask_to_restore(folder: &Path, revision: u64) -> Result<(), RestoreError> {
    let found = find(folder, revision).and_then(|(key, _)| {
        let read = ModelStore::beside(&global_store(folder)).get(key);
        read.map(drop).map_err(|_| RestoreError::Damaged(revision))
    });
    match found {
        Ok(()) => add_wish(folder, &revision.to_string()),
        Err(error) => Err(RestoreError::Instead(Box::new(error), others(folder, revision))),
    }
}

/// Says which revisions can be restored instead of one that cannot.
pub(super) fn others(folder: &Path, revision: u64) -> String {
    let old = old_revisions(folder).unwrap_or_default();
    let others = old.iter().map(|old| old.revision).filter(|other| *other != revision);
    let others: Vec<String> = others.map(|other| other.to_string()).collect();
    let others = if others.is_empty() { "none".to_owned() } else { others.join(", ") };
    format!("others that can be restored: {others}")
}

/// As [`ask_to_restore`], for a revision that can be restored, and before all that was asked for.
pub(super) fn ask_again(folder: &Path, revision: u64) -> Result<(), SceneError> {
    change_wishes(folder, |wishes| wishes.insert(0, revision.to_string()))
}

/// Asks the service with this folder to let its next merge, which begins at once, replace a restored revision. What was asked for
/// before is done before.
pub fn ask_to_release(folder: &Path) -> Result<(), RestoreError> {
    add_wish(folder, MERGE)
}

/// Adds a wish to those that wait. One that is the last already is not added: it was asked for twice.
fn add_wish(folder: &Path, wish: &str) -> Result<(), RestoreError> {
    let mut is_full = false;
    change_wishes(folder, |wishes| {
        let is_there = wishes.last().is_some_and(|last| last == wish);
        is_full = !is_there && wishes.len() >= WISHES_MAX;
        if !is_there && !is_full {
            wishes.push(wish.to_owned());
        }
    })?;
    if is_full { Err(RestoreError::Busy) } else { Ok(()) }
}

/// What the operator wishes first.
pub(super) fn wish(folder: &Path) -> Result<Option<Wish>, SceneError> {
    Ok(wishes(folder)?.first().map(|line| Wish::of(line)))
}

/// Notes that the merge of the first wish was begun. So one that is asked for from now on is another one.
pub(super) fn note_begun_merge(folder: &Path) -> Result<(), SceneError> {
    change_wishes(folder, |wishes| {
        wishes
            .iter_mut()
            .take(1)
            .filter(|first| *first == MERGE)
            .for_each(|first| *first = BEGUN_MERGE.into());
    })
}

/// Removes the first wish, which is fulfilled or cannot be.
pub(super) fn end_wish(folder: &Path) -> Result<(), SceneError> {
    change_wishes(folder, |wishes| _ = wishes.drain(..wishes.len().min(1)))
}

/// The lines of the wishes that wait, oldest first.
fn wishes(folder: &Path) -> Result<Vec<String>, SceneError> {
    match files::read(&folder.join(WISHES)) {
        Err(SceneError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        bytes => Ok(String::from_utf8_lossy(&bytes?).lines().map(|line| line.trim().to_owned()).collect()),
    }
}

/// Changes the wishes that wait, while no other program does.
fn change_wishes(folder: &Path, change: impl FnOnce(&mut Vec<String>)) -> Result<(), SceneError> {
    let path = folder.join(WISHES_LOCK);
    let failed = |cause| SceneError::io(&path, cause);
    let lock = File::options().create(true).append(true).open(&path).map_err(failed)?;
    lock.lock().map_err(failed)?;
    let before = wishes(folder)?;
    let mut wishes = before.clone();
    change(&mut wishes);
    if wishes == before {
        return Ok(());
    }
    match wishes.is_empty() {
        true => remove(&folder.join(WISHES)).map(drop),
        false => atomic::write_bytes(&folder.join(WISHES), wishes.join("\n").as_bytes()),
    }
}

/// Notes that a revision which repeats this one stays.
pub(super) fn hold(folder: &Path, revision: u64) -> Result<(), SceneError> {
    checked::write(&folder.join(HELD), &Held { revision })
}

/// The revision that must be repeated as long as the operator asks for no merge.
pub(super) fn held(folder: &Path) -> Option<u64> {
    checked::read::<Held>(&folder.join(HELD)).ok().map(|held| held.revision)
}

/// Lets a merge replace what is held.
pub(super) fn let_go(folder: &Path) -> Result<(), SceneError> {
    remove(&folder.join(HELD)).map(drop)
}

/// The key and the record of a revision, if it can be restored.
pub(super) fn find(folder: &Path, revision: u64) -> Result<(ModelKey, Merging), RestoreError> {
    let record = check(folder, revision)?;
    let key = stored(folder)?.into_iter().find(|key| key.model.0 == revision);
    key.map(|key| (key, record)).ok_or(RestoreError::NotKept(revision))
}

/// All that is in the folder of the records, which is created unless it is there.
pub(super) fn records(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let records = folder.join(RECORDS);
    files::create_folder(&records)?;
    let paths = fs::read_dir(&records).and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
    paths.map_err(|cause| SceneError::io(&records, cause))
}

/// Keeps the record of a revision, and removes those of revisions that are no longer stored.
pub(super) fn keep_record(folder: &Path, record: &Merging) -> Result<(), ServiceError> {
    let others = records(folder)?;
    checked::write(&record_path(folder, record.revision), record)?;
    let kept: Vec<PathBuf> =
        stored(folder)?.into_iter().map(|key| record_path(folder, key.model.0)).collect();
    Ok(others.iter().filter(|path| !kept.contains(path)).try_for_each(|path| remove(path).map(drop))?)
}

fn record_path(folder: &Path, revision: u64) -> PathBuf {
    folder.join(RECORDS).join(format!("{revision}.json"))
}

fn stored(folder: &Path) -> Result<Vec<ModelKey>, StoreError> {
    ModelStore::beside(&global_store(folder)).keys()
}

/// The numbers of the stored revisions, newest first.
fn newest_first(folder: &Path) -> Result<Vec<u64>, StoreError> {
    let mut numbers: Vec<u64> = stored(folder)?.into_iter().map(|key| key.model.0).collect();
    numbers.sort_unstable_by_key(|number| std::cmp::Reverse(*number));
    Ok(numbers)
}

/// The record of a revision, if it can be restored.
fn check(folder: &Path, revision: u64) -> Result<Merging, RestoreError> {
    if Merging::read(folder).is_some_and(|newest| newest.revision == revision) {
        return Err(RestoreError::Newest(revision));
    }
    if !stored(folder)?.iter().any(|key| key.model.0 == revision) {
        return Err(RestoreError::NotKept(revision));
    }
    let record = record_of(folder, revision).ok_or(RestoreError::NoRecord(revision))?;
    match any_listed(&ModelList::read_all(&folder.join(WITHDRAWN))?, &record.inputs) {
        true => Err(RestoreError::Withdrawn(revision)),
        false => Ok(record),
    }
}
