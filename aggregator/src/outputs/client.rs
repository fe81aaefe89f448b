//! The client's part of a report: the model for the viewer, within limits of memory and of the report's size, and an
//! overview.

use std::path::Path;

use cosurf_contract::usage;
use cosurf_geo::Georeference;
use cosurf_scene::{Camera, Caster, LocalFrame, Picture};
use glam::DVec3;

use crate::evaluate::splat_errors;
use crate::report::{Captioned, Client};
use crate::service::{contributions, global_ply};
use crate::viewer::{Room, Walkable};
use crate::views::open_within;

/// Size of the overview, px.
const OVERVIEW_PX: [u32; 2] = [1280, 640];
/// Largest model in a report, bytes of SPZ. In base64 it takes a third more; so a report with its pictures stays below
/// 15 MB, which mail and messengers carry.
const MODEL_BYTES_MAX: usize = 9_500_000;

/// The true surface.
pub(crate) struct Truth<'a> {
    pub(crate) surface: &'a Caster,
    /// The frame of the surface.
    pub(crate) frame: &'a LocalFrame,
}

impl Truth<'_> {
    /// How far places of the world are from the surface, world units; see [`splat_errors`].
    fn errors(&self, places: &[DVec3], cameras: &[Camera]) -> Vec<f32> {
        let places: Vec<DVec3> = places.iter().map(|place| self.frame.local_from_world(*place)).collect();
        let cameras: Vec<Camera> = cameras.iter().map(|camera| self.frame.local_camera(camera)).collect();
        let unit = self.frame.unit() as f32;
        splat_errors(&places, &cameras, self.surface).into_iter().map(|error| error * unit).collect()
    }
}

/// The client's part of the report in a folder with a global model. What takes too much of `memory_bytes` is left out, and
/// the report says so. Rendering uses `threads` (at least 1) threads. The viewer shows the errors of the splats if the true
/// surface is known.
pub(crate) fn client(folder: &Path, memory_bytes: u64, threads: usize, truth: Option<Truth>) -> Client {
    let free = memory_bytes.saturating_sub(usage::resident_bytes());
    // Half of it: the page is held once more while it is written, and the allocator does not return everything.
    let room = Room { memory_bytes: Some(free / 2), file_bytes: Some(MODEL_BYTES_MAX), ..Room::UNLIMITED };
    let model = Walkable::read(folder, room).map(|model| model.with_devices(contributions(folder)));
    let model = model.map(|model| match truth {
        Some(truth) => model.with_errors(|places, cameras| truth.errors(places, cameras)),
        None => model,
    });
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
