//! The client's part of a report: the model for the viewer, within limits of memory and of the report's size, and an
//! overview.

use std::path::Path;

use cosurf_contract::usage;
use cosurf_geo::Georeference;
use cosurf_scene::Picture;

use crate::report::{Captioned, Client};
use crate::service::{camera_counts, global_ply};
use crate::viewer::{Room, Walkable};
use crate::views::open_within;

/// Size of the overview, px.
const OVERVIEW_PX: [u32; 2] = [1280, 640];
/// Largest model in a report, bytes of SPZ. In base64 it takes a third more; so a report with its pictures stays below
/// 15 MB, which mail and messengers carry.
const MODEL_BYTES_MAX: usize = 9_500_000;

/// The client's part of the report in a folder with a global model. What takes too much of `memory_bytes` is left out, and
/// the report says so. Rendering uses `threads` (at least 1) threads.
pub(crate) fn client(folder: &Path, memory_bytes: u64, threads: usize) -> Client {
    let free = memory_bytes.saturating_sub(usage::resident_bytes());
    // Half of it: the page is held once more while it is written, and the allocator does not return everything.
    let room = Room { memory_bytes: Some(free / 2), file_bytes: Some(MODEL_BYTES_MAX), ..Room::UNLIMITED };
    let model = Walkable::read(folder, room).map(|model| model.with_devices(camera_counts(folder)));
    let model = model.map_err(|error| error.to_string());
    let overview = model.as_ref().ok().and_then(|model| overview(folder, model, memory_bytes, threads));
    // The mission and the survey report a wrong file; here it only means a world without a place.
    let georeference = Georeference::of_folder(folder).ok().flatten();
    Client::new(folder, georeference, model, overview)
}

/// The whole model from above; `None` if that takes too much memory.
fn overview(folder: &Path, model: &Walkable, memory_bytes: u64, threads: usize) -> Option<Captioned> {
    let mut views = open_within(global_ply(folder), model.frame(), memory_bytes, threads).ok()?;
    let rendering = views.render(&model.overview(OVERVIEW_PX)).ok()?;
    Captioned::new("the whole model from above", &Picture::from_unit(OVERVIEW_PX, &rendering.rgb)).ok()
}
