//! Finds quickly which cameras of a model show ground that another model's cameras see: by the surface that the model
//! shows from its own cameras. Small pictures of it are rendered once for each model, not for each pair of models.

use std::path::Path;

use cosurf_engine::Renderer;
use cosurf_scene::{Camera, evenly_spaced};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::matching::{Sight, is_well_seen, middle};
use super::similarity::Similarity;
use crate::merge::shifts::Shifts;
use crate::merge::{Locals, MergeError};
use crate::scratch::{Record, Records};

/// Limit on the number of cameras of a model from which small pictures are rendered. If a model has more cameras, some
/// are chosen evenly.
const SCOUTS: usize = 128;
/// Long side of the pictures, px.
const SIZE_PX: u32 = 48;
/// Every so many pixels along each axis give a point of the surface.
const STEP_PX: usize = 2;
/// A camera is used only if at least this share of its picture shows ground that the other model's own cameras see.
const SHARED_MIN: f64 = 0.15;

/// The surface that a model shows from one of its cameras.
#[derive(Serialize, Deserialize)]
pub(super) struct Scout {
    camera: Camera,
    /// Points of the surface, in the model's own frame.
    surface: Vec<DVec3>,
    /// Number of points that a picture full of surface has.
    points: usize,
}

impl Scout {
    fn of(renderer: &mut Renderer, camera: &Camera) -> Self {
        let sight = Sight::of(renderer, camera.fitted(SIZE_PX));
        let [width, height] = sight.size();
        let pixels =
            (0..height).step_by(STEP_PX).flat_map(|y| (0..width).step_by(STEP_PX).map(move |x| (x, y)));
        let solid = pixels.clone().filter(|(x, y)| sight.is_solid(*x, *y));
        let surface = solid.map(|(x, y)| sight.point(x, y, middle(x, y))).collect();
        Self { camera: *camera, surface, points: pixels.count() }
    }

    /// Share of the picture, 0..=1, that shows a surface which enough of `cameras` see from a similar direction and
    /// distance. `from_own` moves the scout into the frame of these cameras.
    fn shared(&self, from_own: &Similarity, cameras: &[Camera]) -> f64 {
        let here = from_own.camera(&self.camera);
        let is_shared = |point: &&DVec3| is_well_seen(from_own.apply(**point), &here, cameras);
        self.surface.iter().filter(is_shared).count() as f64 / self.points.max(1) as f64
    }
}

/// At most `count` of the cameras of `scouts`, those whose pictures show most ground that `cameras` see. `from_own` moves
/// the scouts into the frame of these cameras.
pub(super) fn best(scouts: &[Scout], from_own: &Similarity, cameras: &[Camera], count: usize) -> Vec<Camera> {
    let mut shares: Vec<(f64, Camera)> =
        scouts.iter().map(|scout| (scout.shared(from_own, cameras), scout.camera)).collect();
    shares.retain(|(share, _)| *share >= SHARED_MIN);
    shares.sort_by(|a, b| b.0.total_cmp(&a.0));
    shares.into_iter().take(count).map(|(_, camera)| camera).collect()
}

/// The scouts of all models, in a file.
pub(super) struct ScoutFile {
    records: Records,
    known: Vec<Record>,
}

impl ScoutFile {
    /// Renders what all models show from their own cameras. The file lies in the folder `scratch`. `is_given_up` is
    /// called between models; if it returns true, the result is an error.
    pub(super) fn of(
        locals: &dyn Locals,
        shifts: Shifts,
        scratch: &Path,
        is_given_up: &dyn Fn() -> bool,
    ) -> Result<Self, MergeError> {
        let mut file = Self { records: Records::new(scratch)?, known: Vec::with_capacity(locals.count()) };
        let look = |(): &mut (), index: usize| {
            let model = locals.load(index)?;
            let mut renderer = Renderer::new(&model.splats, shifts.threads);
            let cameras = evenly_spaced(&model.cameras, SCOUTS);
            Ok(cameras.iter().map(|camera| Scout::of(&mut renderer, camera)).collect::<Vec<_>>())
        };
        shifts.run(locals.count(), is_given_up, look, |_, scouts| {
            file.known.push(file.records.put(&scouts)?);
            Ok(())
        })?;
        Ok(file)
    }

    /// The scouts of a model.
    pub(super) fn read(&self, index: usize) -> Result<Vec<Scout>, MergeError> {
        Ok(self.records.get(self.known[index])?)
    }
}
