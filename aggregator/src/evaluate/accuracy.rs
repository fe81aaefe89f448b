//! Accuracy of a mesh: precision, recall and F-score at a threshold, as in Tanks and Temples (Knapitsch
//! et al. 2017), and mean distances in both directions.
//!
//! The mesh is scored by samples spread evenly over its area, and a second time by its vertices, as the
//! benchmark does. The score by vertices also depends on how finely each part of the mesh is triangulated.
//!
//! Two rules hold for every mesh:
//!
//! - The truth often covers only part of the reconstruction. The mesh is therefore scored only above the
//!   truth's footprint on the ground (z is up) plus a margin (see `region`). It is scored at any height
//!   there, so that floaters count. The result states which share of the mesh was left out (*cropped*).
//! - A truth given as points is itself a sample. Even a perfect mesh has parts far from sparse points. Each
//!   point with a normal therefore stands for a disc as large as the point's share of the surface. The
//!   radius of a disc is at most the threshold.
//!
//! What it knows nothing about: where meshes come from, and alignment. Mesh and truth must be in the same
//! frame; nothing is fitted.

mod nearest;
mod region;
mod sample;
#[cfg(test)]
mod tests;

use std::f64::consts::PI;

use cosurf_scene::Mesh;
use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;

use nearest::Tree;
use region::Region;
use sample::sample;

/// Distance between the samples of a surface, as a share of the threshold.
const SPACING: f64 = 0.25;
/// Number of nearest truth points among which the closest disc is searched.
const DISCS: usize = 6;

/// Scores of a mesh at one threshold (a distance), each 0..=1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Share of the mesh within the threshold of the truth.
    pub precision: f64,
    /// Share of the truth within the threshold of the mesh.
    pub recall: f64,
    /// Harmonic mean of precision and recall.
    pub f_score: f64,
}

/// All figures of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Accuracy {
    /// The threshold: the largest distance that counts as correct, world units.
    pub threshold_m: f64,
    /// Scores of the mesh by samples spread evenly over its area.
    pub samples: Score,
    /// Scores of the mesh by its vertices.
    pub vertices: Score,
    /// Mean distance from the mesh's samples to the truth, world units; infinite if all samples were
    /// cropped.
    pub mesh_to_truth_m: f64,
    /// Mean distance from the truth to the mesh's samples, world units.
    pub truth_to_mesh_m: f64,
    /// Mean of `mesh_to_truth_m` and `truth_to_mesh_m`, world units.
    pub chamfer_m: f64,
    /// Share of the mesh's area that is not above the truth's footprint and was not scored, 0..=1.
    pub cropped: f64,
    /// Mean distance between the mesh's samples, world units.
    pub sample_spacing_m: f64,
    /// Radius of the disc that each truth point stands for, world units; 0 if the truth is a mesh or has no
    /// normals.
    pub truth_disc_m: f64,
}

/// Why a mesh cannot be scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AccuracyError {
    /// The mesh has no triangles.
    #[error("the mesh has no triangles: pass a triangle mesh, not a point cloud")]
    NoTriangles,
    /// The truth has no points.
    #[error("the true surface has no points: pass a mesh or a point cloud")]
    NoTruth,
    /// The threshold is so small that a surface needs more samples than the limit.
    #[error(
        "the threshold is so small that the surface needs more than {SAMPLES_MAX} samples: choose a larger one"
    )]
    TooFine,
}

/// Limit on the samples of one surface. That many samples, and the data derived from them, take about 3 GB.
const SAMPLES_MAX: usize = 60_000_000;

/// Scores `mesh` against `truth`. The truth is a mesh or, without triangles, points of the surface. `seed`
/// determines the random samples. Also returns the distance of each vertex of `mesh` from the truth, NaN for
/// cropped vertices.
pub fn judge(
    mesh: &Mesh,
    truth: &Mesh,
    threshold_m: f64,
    seed: u64,
) -> Result<(Accuracy, Vec<f32>), AccuracyError> {
    if mesh.triangles.is_empty() {
        return Err(AccuracyError::NoTriangles);
    }
    let spacing_m = SPACING * threshold_m;
    let truth = Truth::new(truth, threshold_m, spacing_m, seed)?;
    let samples = sample(mesh, spacing_m, seed, SAMPLES_MAX).ok_or(AccuracyError::TooFine)?;
    let region = Region::new(&truth.points, truth.spacing_m, threshold_m);
    let errors_of = |points: &[Vec3]| -> Vec<f32> {
        let error = |p: &Vec3| if region.contains(*p) { truth.distance(*p) } else { f32::NAN };
        points.par_iter().map(error).collect()
    };
    let sample_errors = errors_of(&samples);
    let vertices: Vec<Vec3> = mesh.positions.iter().copied().map(Vec3::from_array).collect();
    let vertex_errors = errors_of(&vertices);
    let sample_gaps = truth.gaps(&samples);
    let counted = sample_errors.iter().filter(|error| !error.is_nan()).count();
    let (mesh_to_truth_m, truth_to_mesh_m) = (mean(&sample_errors), mean(&sample_gaps));
    let accuracy = Accuracy {
        threshold_m,
        samples: score(&sample_errors, &sample_gaps, threshold_m),
        vertices: score(&vertex_errors, &truth.gaps(&vertices), threshold_m),
        mesh_to_truth_m,
        truth_to_mesh_m,
        chamfer_m: 0.5 * (mesh_to_truth_m + truth_to_mesh_m),
        cropped: 1.0 - counted as f64 / samples.len().max(1) as f64,
        sample_spacing_m: spacing_m,
        truth_disc_m: f64::from(truth.disc_m),
    };
    Ok((accuracy, vertex_errors))
}

/// The true surface, as points.
struct Truth {
    points: Vec<Vec3>,
    /// Mean distance between the points.
    spacing_m: f64,
    /// Normals of the points; empty if the points do not stand for discs.
    normals: Vec<[f32; 3]>,
    disc_m: f32,
    tree: Tree,
}

impl Truth {
    fn new(truth: &Mesh, threshold_m: f64, spacing_m: f64, seed: u64) -> Result<Self, AccuracyError> {
        let is_cloud = truth.triangles.is_empty();
        // The truth gets another seed than the mesh: a mesh that is scored against itself must not meet its
        // own samples.
        let points = match truth.triangles[..] {
            [] => truth.positions.iter().copied().map(Vec3::from_array).collect(),
            _ => sample(truth, spacing_m, seed ^ 1, SAMPLES_MAX).ok_or(AccuracyError::TooFine)?,
        };
        if points.is_empty() {
            return Err(AccuracyError::NoTruth);
        }
        let tree = Tree::new(&points);
        let mut truth = Self {
            normals: if is_cloud { truth.normals.clone() } else { Vec::new() },
            disc_m: 0.0,
            points,
            spacing_m,
            tree,
        };
        if is_cloud {
            let share_m = truth.share_radius();
            truth.spacing_m = f64::from(share_m) * PI.sqrt();
            truth.disc_m = if truth.normals.is_empty() { 0.0 } else { share_m.min(threshold_m as f32) };
        }
        Ok(truth)
    }

    /// Radius of a disc whose area is the share of the surface that one truth point stands for. If points
    /// are spread at random, a disc that reaches to the second nearest neighbour has the area of two shares
    /// on average.
    fn share_radius(&self) -> f32 {
        let squares: Vec<f32> = self
            .points
            .par_iter()
            .map(|p| self.tree.nearest::<3>(*p)[2].0)
            .filter(|d| d.is_finite())
            .collect();
        let mean = squares.iter().map(|d| f64::from(*d)).sum::<f64>() / squares.len().max(1) as f64;
        (mean / 2.0).sqrt() as f32
    }

    fn distance(&self, p: Vec3) -> f32 {
        if self.disc_m == 0.0 {
            return self.tree.nearest::<1>(p)[0].0.sqrt();
        }
        let candidates = self.tree.nearest::<DISCS>(p).into_iter().filter(|(d, _)| d.is_finite());
        candidates.map(|(_, i)| self.distance_to_disc(p, i as usize)).fold(f32::INFINITY, f32::min)
    }

    fn distance_to_disc(&self, p: Vec3, i: usize) -> f32 {
        let offset = p - self.points[i];
        let normal = Vec3::from_array(self.normals[i]);
        let height = offset.dot(normal);
        let aside = (offset - height * normal).length();
        // If the normal is zero, so is the height, and the disc would become a ball: use the point itself.
        let radius = if normal == Vec3::ZERO { 0.0 } else { self.disc_m };
        Vec3::new(height, (aside - radius).max(0.0), 0.0).length()
    }

    /// Distance from each truth point to the nearest of `to`, which are points of the mesh.
    fn gaps(&self, to: &[Vec3]) -> Vec<f32> {
        let tree = Tree::new(to);
        self.points.par_iter().map(|p| tree.nearest::<1>(*p)[0].0.sqrt()).collect()
    }
}

fn score(errors: &[f32], gaps: &[f32], threshold_m: f64) -> Score {
    let share = |distances: &[f32]| {
        let counted = distances.iter().filter(|d| !d.is_nan()).count();
        let close = distances.iter().filter(|d| f64::from(**d) <= threshold_m).count();
        close as f64 / counted.max(1) as f64
    };
    let (precision, recall) = (share(errors), share(gaps));
    let f_score = 2.0 * precision * recall / (precision + recall).max(f64::MIN_POSITIVE);
    Score { precision, recall, f_score }
}

/// Mean of the values that are not NaN; infinite if there are none.
fn mean(distances: &[f32]) -> f64 {
    let counted = || distances.iter().filter(|d| !d.is_nan());
    match counted().count() {
        0 => f64::INFINITY,
        n => counted().map(|d| f64::from(*d)).sum::<f64>() / n as f64,
    }
}
