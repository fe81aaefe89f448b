//! Datasets: pictures with poses and a sparse cloud, wherever they come from.

use std::path::PathBuf;

use glam::DVec3;

use crate::Camera;

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
}
