//! Datasets: pictures with poses and a sparse point cloud, from any supported source.

use std::path::PathBuf;

use glam::DVec3;

use crate::camera::extent;
use crate::{Camera, LocalFrame, Mask};

/// A photograph with its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Name of the picture in the dataset's files, often a relative path. Names are unique in a
    /// dataset, and views are sorted by name.
    pub name: String,
    /// The camera. Its intrinsics are for the picture's size on disk.
    pub camera: Camera,
    /// The picture's file.
    pub path: PathBuf,
    /// The picture's mask, if it has one.
    pub mask: Option<Mask>,
}

/// A point of the sparse reconstruction.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePoint {
    /// World position.
    pub position: DVec3,
    /// 8-bit colour.
    pub rgb: [u8; 3],
    /// The track: indices into [`Dataset::views`] of the views that see the point, ascending; empty if
    /// the format has no tracks.
    pub views: Vec<u32>,
}

/// Views sorted by name, and the sparse point cloud.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dataset {
    /// The views, sorted by name; names are unique.
    pub views: Vec<View>,
    /// The sparse point cloud; may be empty.
    pub points: Vec<SparsePoint>,
}

impl Dataset {
    /// Splits the views as 3DGS does for its evaluation. View `i`, counted in the order of names, is
    /// held out if `i % every == 0`; an `every` of 0 holds out none. Returns the indices of training
    /// views and of held-out views.
    pub fn split(&self, every: u32) -> (Vec<usize>, Vec<usize>) {
        (0..self.views.len()).partition(|i| every == 0 || i % every as usize != 0)
    }

    /// Index of the view called `name`.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.views.binary_search_by(|view| view.name.as_str().cmp(name)).ok()
    }

    /// The dataset of the chosen views (indices in any order, repeats ignored) and of the points that
    /// they see. A point without a track counts as seen if it projects into a chosen picture. Tracks
    /// are renumbered for the new dataset; views that were not chosen are removed from them.
    pub fn subset(&self, views: &[usize]) -> Self {
        let mut chosen = views.to_vec();
        chosen.sort_unstable();
        chosen.dedup();
        let views: Vec<View> = chosen.iter().map(|&view| self.views[view].clone()).collect();
        let mut new_of_old = vec![None; self.views.len()];
        for (new, &old) in chosen.iter().enumerate() {
            new_of_old[old] = Some(new as u32);
        }
        let seen = |point: &SparsePoint| {
            let track = point.views.iter().filter_map(|&view| new_of_old[view as usize]).collect::<Vec<_>>();
            let is_seen = match point.views[..] {
                [] => views.iter().any(|view| view.camera.sees(point.position)),
                _ => !track.is_empty(),
            };
            is_seen.then_some(SparsePoint { views: track, ..*point })
        };
        let points = self.points.iter().filter_map(seen).collect();
        Self { views, points }
    }

    /// The cameras of all views.
    pub fn cameras_of_views(&self) -> impl Iterator<Item = &Camera> + Clone {
        self.views.iter().map(|view| &view.camera)
    }

    /// Maps the dataset from the world into a local frame.
    pub fn into_frame(mut self, frame: &LocalFrame) -> Self {
        self.views.iter_mut().for_each(|view| view.camera = frame.local_camera(&view.camera));
        self.points.iter_mut().for_each(|point| point.position = frame.local_from_world(point.position));
        self
    }

    /// The size of the scene as 3DGS defines it, in world units; see [`extent`].
    pub fn extent(&self) -> f64 {
        extent(self.cameras_of_views())
    }
}
