//! The local models to merge, wherever they are stored.

use cosurf_engine::Trust;
use cosurf_link::Model;
use cosurf_scene::Camera;

use super::error::MergeError;

/// How large a model is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ModelSize {
    /// Number of splats.
    pub splats: usize,
    /// Degree of spherical harmonics, 0 to 3.
    pub sh_degree: u32,
}

/// Local models in a fixed order, loaded when they are needed.
pub trait Locals: Sync {
    /// Number of models.
    fn count(&self) -> usize;

    /// The size of the model at `index`, which is asked for before anything is loaded: whoever can tell without loading
    /// the model should.
    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        let Model { splats, .. } = self.load(index)?;
        Ok(ModelSize { splats: splats.len(), sh_degree: splats.sh_degree })
    }

    /// Loads the model at `index`.
    fn load(&self, index: usize) -> Result<Model, MergeError>;

    /// True if a model was pruned before upload: of the ground that it gave up, it shows at most the base.
    fn is_compressed(&self, index: usize) -> bool {
        let _ = index;
        false
    }

    /// Whether the place of a model on the earth is known. Models whose place is not known are laid on those whose is.
    fn is_placed(&self, index: usize) -> bool {
        let _ = index;
        true
    }

    /// How far the observations of a model are believed.
    fn trust(&self, index: usize) -> Trust {
        let _ = index;
        Trust::FULL
    }
}

/// Local models that are held in memory.
#[derive(Clone, Debug)]
pub struct InMemory(pub Vec<Model>);

impl Locals for InMemory {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
        let Model { splats, .. } = &self.0[index];
        Ok(ModelSize { splats: splats.len(), sh_degree: splats.sh_degree })
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        Ok(self.0[index].clone())
    }
}

/// The local models, with the cameras and sizes that a first pass over the models has gathered.
pub(super) struct Surveyed<'a> {
    pub(super) locals: &'a dyn Locals,
    /// Cameras of each model.
    pub(super) cameras: Vec<Vec<Camera>>,
    /// Number of splats of each model.
    pub(super) sizes: Vec<usize>,
    /// Highest degree of spherical harmonics of any model.
    pub(super) sh_degree: u32,
}

/// Loads every model once and gathers its cameras and size.
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
