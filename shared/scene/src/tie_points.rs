//! The tie points of Metashape: a PLY beside the file of its cameras, which *Export Tie Points* (*Export Points* with the
//! source *Tie points* in older versions) writes. The XML of cameras has none.
//!
//! What it knows nothing about: cameras' lenses, and the formats of points other than PLY.

use std::path::{Path, PathBuf};

use crate::layout::Layout;
use crate::metashape::Cameras;
use crate::sieve::Sieve;
use crate::{Camera, SceneError, SparsePoint, files, metashape, ply};

/// Most files of a folder that are looked at.
const ENTRIES_MAX: usize = 1000;
/// Bytes of the points by which a file is judged, about a thousand points.
const JUDGED_BYTES: usize = 1 << 17;

/// Why the points of a file are not used.
const ELSEWHERE: &str = "most are not where the cameras look; export tie points in the coordinates of the cameras, as local coordinates";
const GEOCENTRIC: &str = "the cameras are earth-centred, and points of a PLY are not; export both from a chunk in local coordinates";

/// The file of points that belongs to a file of cameras: the PLY of the same name, or the only one in the folder.
pub(crate) fn beside(cameras: &Path) -> Option<PathBuf> {
    let folder = files::folder_of(cameras);
    let named = files::in_any_case(cameras.with_extension("ply"));
    if named.is_file() {
        return Some(named);
    }
    let entries =
        folder.read_dir().into_iter().flatten().take(ENTRIES_MAX).flatten().map(|entry| entry.path());
    let is_ply = |path: &PathBuf| path.extension().is_some_and(|end| end.eq_ignore_ascii_case("ply"));
    let mut found = entries.filter(|path| is_ply(path) && path.is_file());
    let only = found.next()?;
    found.next().is_none().then_some(only)
}

/// Points that are not used: their file, and the reason.
pub(crate) type Unused = (PathBuf, String);

/// Adds the points of the file that belongs to `file`, which has these cameras. Tells if there is one whose points are not
/// used.
pub(crate) fn read_into(sieve: &mut Sieve, file: &Path, cameras: &Cameras) -> Option<Unused> {
    let path = beside(file)?;
    let read = |sieve: &mut Sieve| {
        ply::read_points_into(sieve, &path).map_err(|error| match error {
            SceneError::Malformed { reason, .. } => reason,
            other => other.to_string(),
        })
    };
    let mut judge = || {
        if cameras.is_geocentric {
            return Err(GEOCENTRIC.to_owned());
        }
        let mut judged = Sieve::new(JUDGED_BYTES);
        read(&mut judged)?;
        let (points, _) = judged.end();
        let views: Vec<Camera> =
            cameras.shots.iter().map(|shot| shot.lens.pinhole(shot.cam_from_world)).collect();
        let is_seen = |point: &&SparsePoint| views.iter().any(|view| view.sees(point.position));
        match 2 * points.iter().filter(is_seen).count() >= points.len() {
            true => read(sieve),
            false => Err(ELSEWHERE.to_owned()),
        }
    };
    let reason = judge().err()?;
    Some((path, format!("its points are not used: {reason}")))
}

/// What [`read_into`] tells about a dataset; nothing if it is none of Metashape.
pub(crate) fn note(path: &Path) -> Option<String> {
    let Ok(Layout::Metashape(file)) = Layout::of(path) else { return None };
    let (points, reason) = read_into(&mut Sieve::new(0), &file, &metashape::read(&file).ok()?)?;
    Some(format!("{}: {reason}", points.display()))
}
