//! Whether pictures have arrived in a folder that is watched, and are complete.
//!
//! What it knows nothing about: clocks, and how pictures are read. Whoever watches says what time it is.

use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

use blake3::Hash;
use cosurf_scene::Dataset;
use serde::{Deserialize, Serialize};

/// Files count as complete once nothing has changed for this long. Copies from a memory card pause for less.
const QUIET: Duration = Duration::from_secs(10);
/// Photographs below this number cannot be posed.
const PHOTOGRAPHS_MIN: usize = 3;
/// Files beyond this number are refused: no flight has so many.
const FILES_MAX: usize = 1_000_000;

/// What a folder holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// Pictures with poses.
    Dataset,
    /// Photographs without poses.
    Photographs,
}

/// The files of a folder at a moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// Hash over the names, sizes and times of change of all files.
    hash: Hash,
    /// What can be trained on; `None` if there is nothing yet.
    content: Option<Content>,
}

impl Snapshot {
    /// Looks at a folder and all folders in it. Names that begin with a dot do not count, nor does an absent folder.
    pub fn of(folder: &Path) -> io::Result<Self> {
        let mut files = Vec::new();
        match list(folder, folder, &mut files) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            // A file that vanishes meanwhile changes the next snapshot.
            _ => files.sort_unstable(),
        }
        let content = match () {
            () if Dataset::has_poses(folder) => Some(Content::Dataset),
            () if files.iter().filter(|file| file.is_photograph()).count() >= PHOTOGRAPHS_MIN => {
                Some(Content::Photographs)
            }
            () => None,
        };
        let mut hasher = blake3::Hasher::new();
        for File { name, bytes, changed_ns } in &files {
            hasher.update(&(name.len() as u64).to_le_bytes()).update(name.as_bytes());
            hasher.update(&bytes.to_le_bytes()).update(&changed_ns.to_le_bytes());
        }
        Ok(Self { hash: hasher.finalize(), content })
    }
}

/// A file: its name with `/` between folders, its size, and when it was changed, nanoseconds since 1970.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct File {
    name: String,
    bytes: u64,
    changed_ns: u128,
}

impl File {
    fn is_photograph(&self) -> bool {
        let end = self.name.rsplit('.').next().unwrap_or_default().to_ascii_lowercase();
        ["jpg", "jpeg", "png"].contains(&end.as_str())
    }
}

fn list(root: &Path, folder: &Path, files: &mut Vec<File>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().starts_with('.') {
            continue;
        }
        let (path, metadata) = (entry.path(), entry.metadata()?);
        if metadata.is_dir() {
            list(root, &path, files)?;
        } else if files.len() < FILES_MAX {
            let parts = path.strip_prefix(root).unwrap_or(&path).iter().map(|part| part.to_string_lossy());
            let since = metadata.modified()?.duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
            let name = parts.collect::<Vec<_>>().join("/");
            files.push(File { name, bytes: metadata.len(), changed_ns: since.as_nanos() });
        } else {
            return Err(io::Error::other(format!("more than {FILES_MAX} files")));
        }
    }
    Ok(())
}

/// The flight that was begun last, as a file keeps it over restarts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flight {
    /// Hash of its files.
    hash: String,
    /// Whether its model was delivered.
    is_done: bool,
}

impl Flight {
    /// The same flight, with its model delivered.
    pub fn done(self) -> Self {
        Self { is_done: true, ..self }
    }
}

/// A flight whose files are complete.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// The flight, not done yet.
    pub flight: Flight,
    /// What its folder holds.
    pub content: Content,
    /// Whether it was begun before: then its checkpoint counts.
    pub is_begun: bool,
}

/// Waits for files that are complete and not those of the flight that is done.
#[derive(Debug)]
pub struct Watch {
    last: Option<Flight>,
    seen: Option<(Snapshot, Duration)>,
}

impl Watch {
    /// A watch after the flight that was begun last, if there was one.
    pub fn after(last: Option<Flight>) -> Self {
        Self { last, seen: None }
    }

    /// Notes what the folder holds at the time `now`. Returns the flight once its files are complete.
    pub fn observe(&mut self, snapshot: Snapshot, now: Duration) -> Option<Arrival> {
        let since = match &self.seen {
            Some((seen, since)) if *seen == snapshot => *since,
            _ => now,
        };
        let (hash, content) = (snapshot.hash.to_hex().to_string(), snapshot.content);
        self.seen = Some((snapshot, since));
        let last = self.last.as_ref().filter(|last| last.hash == hash);
        if now.saturating_sub(since) < QUIET || last.is_some_and(|last| last.is_done) {
            return None;
        }
        let is_begun = last.is_some();
        Some(Arrival { flight: Flight { hash, is_done: false }, content: content?, is_begun })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn at(watch: &mut Watch, folder: &Path, second: u64) -> Option<Arrival> {
        watch.observe(Snapshot::of(folder).unwrap(), Duration::from_secs(second))
    }

    #[test]
    fn photographs_count_once_they_are_complete_and_only_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let mut watch = Watch::after(None);
        fs::write(path.join("notes.txt"), "wind 3 m/s").unwrap();
        assert_eq!((at(&mut watch, path, 0), at(&mut watch, path, 60)), (None, None), "no photographs");
        for name in ["1.JPG", "2.jpg", ".3.jpg"] {
            fs::write(path.join(name), "x").unwrap();
        }
        assert_eq!((at(&mut watch, path, 70), at(&mut watch, path, 90)), (None, None), "too few");
        fs::create_dir(path.join("card2")).unwrap();
        fs::write(path.join("card2/3.jpg"), "x").unwrap();
        assert_eq!(at(&mut watch, path, 91), None);
        fs::write(path.join("card2/3.jpg"), "more").unwrap();
        assert_eq!(
            (at(&mut watch, path, 100), at(&mut watch, path, 109)),
            (None, None),
            "still being copied"
        );
        let arrival = at(&mut watch, path, 110).unwrap();
        assert_eq!((arrival.content, arrival.is_begun), (Content::Photographs, false));
        let mut watch = Watch::after(Some(arrival.flight.clone()));
        assert_eq!(at(&mut watch, path, 0), None);
        assert!(at(&mut watch, path, 10).unwrap().is_begun, "after a restart it goes on");
        let mut watch = Watch::after(Some(arrival.flight.done()));
        assert_eq!((at(&mut watch, path, 0), at(&mut watch, path, 10)), (None, None), "done");
        fs::write(path.join("reconstruction.json"), "[]").unwrap();
        at(&mut watch, path, 20);
        let arrival = at(&mut watch, path, 30).unwrap();
        assert_eq!((arrival.content, arrival.is_begun), (Content::Dataset, false), "another flight");
        assert_eq!(Snapshot::of(&path.join("absent")).unwrap().content, None);
    }
}
