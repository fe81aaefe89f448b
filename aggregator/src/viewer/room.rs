//! How large a model for the viewer may become, and how the most important splats are chosen if it is larger.

use std::path::Path;

use cosurf_link::plain_importance;
use cosurf_scene::{Camera, LocalFrame, Splats, model, spz};

use super::error::WalkableError;

/// Usual number of splats of a first part: about a megabyte.
pub const FIRST_SPLATS: usize = 40_000;
/// Number of splats that are read at a time.
const READ_AT_ONCE: usize = 4096;
/// Share of the splats that is kept beyond what the last file's size asks for: other splats compress a little worse.
const CAUTION: f64 = 0.97;

/// How large a model for the viewer may become.
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// Limit on the splats in memory and on what is made of them, bytes; `None` for no limit.
    pub memory_bytes: Option<u64>,
    /// Limit on the SPZ, bytes; `None` for no limit.
    pub file_bytes: Option<usize>,
    /// Limit on the number of splats; `None` for no limit.
    pub splats: Option<usize>,
    /// Number of splats of a first part, which a page shows until it has the rest; `None` for no first part.
    pub first_splats: Option<usize>,
}

impl Room {
    /// No limits.
    pub const UNLIMITED: Self =
        Self { memory_bytes: None, file_bytes: None, splats: None, first_splats: None };

    /// Largest number of splats: as many as fit into the memory together with their SPZ before and after its compression, and
    /// its text in a page.
    pub(super) fn splats_max(&self, sh_degree: u32) -> usize {
        let body = spz::body_bytes(sh_degree);
        let each = Splats::bytes_per_splat(sh_degree) + body + 4 * body / 3;
        let fit = self.memory_bytes.map_or(usize::MAX, |bytes| (bytes / each as u64) as usize);
        fit.min(self.splats.unwrap_or(usize::MAX))
    }
}

/// The splats of a file for the viewer.
pub(super) struct Read {
    /// All usable splats, or the most important ones of them if the memory is small, in `frame`.
    pub(super) splats: Splats,
    /// Number of usable splats of the file.
    pub(super) of_splats: usize,
    /// Number of splats that no viewer can draw: infinite, or not a number.
    pub(super) broken_splats: usize,
    pub(super) frame: LocalFrame,
}

/// Reads the splats of a file.
pub(super) fn read(path: &Path, cameras: &[Camera], room: Room) -> Result<Read, WalkableError> {
    let frame = match cameras {
        [] => LocalFrame::at(model::origin(path)?),
        cameras => LocalFrame::of(cameras.iter()),
    };
    let (count, sh_degree) = model::size(path)?;
    let most = room.splats_max(sh_degree);
    if count <= most {
        let splats = model::read(path, &frame)?;
        let of_splats = splats.len();
        return Ok(Read { splats, of_splats, broken_splats: count - of_splats, frame });
    }
    let mut importances = Vec::with_capacity(count);
    model::read_parts(path, &frame, READ_AT_ONCE, |part| importances.extend(plain_importance(part)))?;
    let of_splats = importances.len();
    let splats = if of_splats <= most {
        model::read(path, &frame)?
    } else {
        let least = least_of(importances, most);
        let mut kept = Splats::with_capacity(most, sh_degree);
        model::read_parts(path, &frame, READ_AT_ONCE, |part| keep(part, least, most, &mut kept))?;
        kept
    };
    Ok(Read { splats, of_splats, broken_splats: count - of_splats, frame })
}

/// The most important splats of some; `None` if there are not more than twice as many, which is not worth a part of its own.
pub(super) fn first_of(splats: &Splats, most: usize) -> Option<Splats> {
    (splats.len() / 2 > most).then(|| most_important(splats, most))
}

/// The `most` most important splats. `most` must be below the number of splats.
fn most_important(splats: &Splats, most: usize) -> Splats {
    let least = least_of(plain_importance(splats), most);
    let mut kept = Splats::with_capacity(most, splats.sh_degree);
    keep(splats, least, most, &mut kept);
    kept
}

/// Encodes as many splats as the limit allows, the most important ones. Returns the file and these splats, in its order.
pub(super) fn encode(
    mut splats: Splats,
    file_bytes: Option<usize>,
    path: &Path,
) -> Result<(Vec<u8>, Splats), WalkableError> {
    loop {
        let bytes = spz::to_bytes(&splats).ok_or_else(|| WalkableError::TooFar { path: path.into() })?;
        let limit = file_bytes.unwrap_or(usize::MAX);
        if bytes.len() <= limit {
            return Ok((bytes, splats));
        }
        let most = ((splats.len() as f64 * limit as f64 / bytes.len() as f64 * CAUTION) as usize).max(1);
        splats = most_important(&splats, most);
    }
}

/// The smallest importance of the `most` most important splats. `most` must be below the number of splats.
fn least_of(mut importances: Vec<f32>, most: usize) -> f32 {
    let at = importances.len() - most.max(1);
    *importances.select_nth_unstable_by(at, f32::total_cmp).1
}

/// Appends the splats that are at least so important, until there are `most`.
fn keep(from: &Splats, least: f32, most: usize, kept: &mut Splats) {
    for (i, importance) in plain_importance(from).into_iter().enumerate() {
        if importance >= least && kept.len() < most {
            kept.push_from(from, i);
        }
    }
}
