//! The local models that are merged, wherever they are kept.

use cosurf_link::Model;
use cosurf_scene::Camera;

use super::error::MergeError;

/// Local models in a fixed order, loaded when they are needed.
pub trait Locals {
    /// Number of models.
    fn count(&self) -> usize;

    /// Loads a model.
    fn load(&self, index: usize) -> Result<Model, MergeError>;

    /// True if a model was pruned before upload: it renders black where it removed splats, so it cannot teach.
    fn is_compressed(&self, index: usize) -> bool {
        let _ = index;
        false
    }
}

/// Local models, with what a first pass over them has gathered.
pub(super) struct Surveyed<'a> {
    pub(super) locals: &'a dyn Locals,
    /// Cameras of each model.
    pub(super) cameras: Vec<Vec<Camera>>,
    /// Number of splats of each model.
    pub(super) sizes: Vec<usize>,
    /// The highest degree of spherical harmonics of all models.
    pub(super) sh_degree: u32,
}

/// Reads each of some models once.
pub(super) fn survey(locals: &dyn Locals) -> Result<Surveyed<'_>, MergeError> {
    let mut surveyed = Surveyed { locals, cameras: Vec::new(), sizes: Vec::new(), sh_degree: 0 };
    for i in 0..locals.count() {
        let Model { splats, cameras } = locals.load(i)?;
        surveyed.sizes.push(splats.len());
        surveyed.sh_degree = surveyed.sh_degree.max(splats.sh_degree);
        surveyed.cameras.push(cameras);
    }
    Ok(surveyed)
}
