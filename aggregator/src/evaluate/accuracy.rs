//! How true a mesh is: precision, recall and F-score at a threshold, as in Tanks and Temples (Knapitsch
//! et al. 2017), and mean distances both ways.
//!
//! The mesh is judged by samples spread evenly over its area, and once more by its vertices, as the
//! benchmark does: vertices reward whoever cuts plane ground into few triangles and noise into many.
//!
//! Two decisions, the same for every method:
//!
//! - Truth often covers only part of what was reconstructed. The mesh counts where the truth's footprint
//!   on the ground (z is up) is no farther than the threshold (see `region`), at whatever height, so
//!   that floaters count. How much was cropped away is part of the result.
//! - Truth given as points is a sample itself. Where its points lie so far apart that a perfect mesh
//!   would miss them, each point that has a normal stands for a disc of its share of the surface,
//!   of at most the threshold's radius.
//!
//! What it refuses to know: where meshes come from, alignment (poses are given, nothing is fitted).

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

/// Samples of a surface are this share of the threshold apart.
const SPACING: f64 = 0.25;
/// Truth points among which the closest disc is searched.
const DISCS: usize = 6;

/// Shares, 0..=1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Of the mesh: as close to the truth as the threshold.
    pub precision: f64,
    /// Of the truth: as close to the mesh.
    pub recall: f64,
    /// Their harmonic mean.
    pub f_score: f64,
}

/// What a mesh is worth.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Accuracy {
    /// World units.
    pub threshold_m: f64,
    /// By samples spread evenly over the area.
    pub samples: Score,
    /// By vertices.
    pub vertices: Score,
    /// Mean distance from the mesh's samples to the truth, world units.
    pub mesh_to_truth_m: f64,
    /// Mean distance from the truth to the mesh's samples.
    pub truth_to_mesh_m: f64,
    /// Mean of the two.
    pub chamfer_m: f64,
    /// Share of the mesh's area that was cropped away, 0..=1.
    pub cropped: f64,
    /// Distance between the mesh's samples.
    pub sample_spacing_m: f64,
    /// Radius of the discs for which the truth's points stand; 0 where it is a mesh, or dense enough.
    pub truth_disc_m: f64,
}

/// Why a mesh cannot be judged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AccuracyError {
    /// Nothing to judge.
    #[error("the mesh has no triangles; is it a cloud of points?")]
    NoTriangles,
    /// Nothing to judge by.
    #[error("the truth has no points")]
    NoTruth,
    /// More samples than memory should take.
    #[error(
        "the threshold is so small that the surface would need more than {SAMPLES_MAX} samples; choose a larger one"
    )]
    TooFine,
}

/// About 3 GB with all that is derived from them.
const SAMPLES_MAX: usize = 60_000_000;

/// Judges `mesh` by `truth`, a mesh or (without triangles) points of the surface. Returns also the
/// distance of each vertex from the truth, NaN where it was cropped away.
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

/// The surface as it is.
struct Truth {
    points: Vec<Vec3>,
    /// Mean distance between them.
    spacing_m: f64,
    /// Of the points, or empty where they stand for nothing but themselves.
    normals: Vec<[f32; 3]>,
    disc_m: f32,
    tree: Tree,
}

impl Truth {
    fn new(truth: &Mesh, threshold_m: f64, spacing_m: f64, seed: u64) -> Result<Self, AccuracyError> {
        let is_cloud = truth.triangles.is_empty();
        // Another seed, so that a mesh judged by itself meets other samples.
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

    /// Radius of a disc as large as the surface for each point: for points spread evenly at random,
    /// a disc about one as far as its second neighbour holds two of them on average.
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
        // Without a normal, the height is 0: the disc would be a ball.
        let radius = if normal == Vec3::ZERO { 0.0 } else { self.disc_m };
        Vec3::new(height, (aside - radius).max(0.0), 0.0).length()
    }

    /// Distances from the truth to points of the mesh.
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

/// Of the values that are not NaN; infinite where there are none.
fn mean(distances: &[f32]) -> f64 {
    let counted = || distances.iter().filter(|d| !d.is_nan());
    match counted().count() {
        0 => f64::INFINITY,
        n => counted().map(|d| f64::from(*d)).sum::<f64>() / n as f64,
    }
}
