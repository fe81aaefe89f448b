//! Datasets: pictures with poses and a sparse cloud, wherever they come from.

use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::{Camera, SceneError};

/// A picture that was taken: its name, its camera, its file.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// File name as the dataset gives it, unique in the dataset; views are sorted by it.
    pub name: String,
    /// The camera, for the picture's own size on disk.
    pub camera: Camera,
    /// Where the picture lies.
    pub path: PathBuf,
}

/// A point of the sparse reconstruction.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePoint {
    /// World position.
    pub position: DVec3,
    /// 8-bit colour.
    pub rgb: [u8; 3],
    /// Indices into [`Dataset::views`] of the views that see it; empty where the format does not say.
    pub views: Vec<u32>,
}

/// Views sorted by name, and the sparse cloud.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dataset {
    /// Sorted by name, names unique.
    pub views: Vec<View>,
    /// May be empty.
    pub points: Vec<SparsePoint>,
}

impl Dataset {
    /// The field's split: with names sorted, view `i` is held out where `i % every == 0`; 0 holds
    /// out none. Returns indices of the views to train on and of those held out.
    pub fn split(&self, every: u32) -> (Vec<usize>, Vec<usize>) {
        (0..self.views.len()).partition(|i| every == 0 || i % every as usize != 0)
    }

    /// Opens a COLMAP model (`path/sparse/0`, `path/sparse` or `path` itself, pictures in
    /// `path/images` or beside the model) or a `transforms.json` (the file, or the folder that has
    /// it). Every picture's header is read: a camera whose picture has another size of the same
    /// aspect is rescaled to it.
    pub fn open(path: &Path) -> Result<Self, SceneError> {
        let _ = path;
        unimplemented!("lands next")
    }

    /// Index of the view called `name`.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.views.binary_search_by(|view| view.name.as_str().cmp(name)).ok()
    }

    /// The dataset of the chosen views (indices, any order, repeats ignored) and of the points that
    /// they see: by their tracks, or, where a point has none, by projection into the pictures.
    pub fn subset(&self, views: &[usize]) -> Self {
        let _ = views;
        unimplemented!("lands next")
    }

    /// The scene's size as 3DGS defines it, world units: 1.1 times the largest distance of a camera
    /// from the cameras' mean; 0 where there is at most one.
    pub fn extent(&self) -> f64 {
        unimplemented!("lands next")
    }
}
