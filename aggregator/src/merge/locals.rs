//! The local models that are merged, wherever they are kept.

use cosurf_link::Model;
use cosurf_scene::Camera;

use super::error::MergeError;

/// Local models in a fixed order, read when they are needed.
pub trait Locals {
    /// How many there are.
    fn count(&self) -> usize;

    /// Reads one.
    fn load(&self, index: usize) -> Result<Model, MergeError>;

    /// Whether one has left ground to others before it was sent: there it shows nothing, and it teaches nothing.
    fn is_compressed(&self, index: usize) -> bool {
        let _ = index;
        false
    }
}

/// Local models, and what is known of them before the first is merged.
pub(super) struct Surveyed<'a> {
    pub(super) locals: &'a dyn Locals,
    /// Those of each.
    pub(super) cameras: Vec<Vec<Camera>>,
    /// Splats of each.
    pub(super) sizes: Vec<usize>,
    /// The highest.
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
