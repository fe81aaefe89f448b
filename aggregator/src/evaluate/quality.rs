//! The figures of a model's quality, and the references that they need besides photographs: LPIPS networks and a true
//! surface.

use std::path::Path;

use cosurf_scene::raycast::TRIANGLES_MAX;
use cosurf_scene::{Caster, LocalFrame, Mesh, SceneError, files};
use serde::{Deserialize, Serialize};

use super::lpips::{LpipsError, LpipsPair, LpipsScore};
use super::surface::SurfaceQuality;

/// Path of the true surface inside a dataset's folder.
const TRUE_MESH: &str = "gt/mesh.ply";
/// Bytes of memory for each byte of the true surface's file, for triangles, vertices and the tree for rays. Measured: 4.4.
const MEMORY_PER_BYTE: u64 = 5;

/// How well a model agrees with photographs and with the true surface, in one view or as a mean over views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Peak signal-to-noise ratio of the colours, dB.
    pub psnr: f64,
    /// Structural similarity of the colours, -1..=1; 1 for equal pictures.
    pub ssim: f64,
    /// LPIPS distances; absent without LPIPS weights, and if the pictures are too small.
    pub lpips: Option<LpipsScore>,
    /// Errors of the surface; absent without a true surface, and if the camera sees none of it.
    pub surface: Option<SurfaceQuality>,
}

impl Quality {
    /// The mean of each figure over the views that have it; `None` without views.
    pub(crate) fn mean(of: &[Quality]) -> Option<Self> {
        let mean = |value: fn(&Quality) -> f64| of.iter().map(value).sum::<f64>() / of.len() as f64;
        let surfaces: Vec<SurfaceQuality> = of.iter().filter_map(|quality| quality.surface).collect();
        (!of.is_empty()).then(|| Self {
            psnr: mean(|quality| quality.psnr),
            ssim: mean(|quality| quality.ssim),
            lpips: LpipsScore::mean(of.iter().filter_map(|quality| quality.lpips)),
            surface: SurfaceQuality::mean(&surfaces),
        })
    }
}

/// Why the references for the figures cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum YardstickError {
    /// The weights of LPIPS cannot be read.
    #[error(transparent)]
    Lpips(#[from] LpipsError),
    /// The true mesh cannot be read.
    #[error(transparent)]
    Truth(#[from] SceneError),
}

/// The references that models are compared with, besides photographs.
#[derive(Debug)]
pub(crate) struct Yardsticks {
    pub(crate) lpips: Option<LpipsPair>,
    pub(crate) truth: Option<Caster>,
}

impl Yardsticks {
    /// Upper bound on the memory that the mesh of the dataset `data` takes as true surface, bytes; 0 if it has none.
    pub(crate) fn memory_bytes(data: &Path) -> u64 {
        let file = files::folder_of(data).join(TRUE_MESH);
        file.metadata().map_or(0, |file| MEMORY_PER_BYTE * file.len())
    }

    /// Reads the LPIPS weights from the folder `lpips`, and the true surface from the mesh `truth`. Without `truth`,
    /// reads the mesh of the dataset `data`, if it has one. The surface is in `frame`.
    pub(crate) fn read(
        data: &Path,
        lpips: Option<&Path>,
        truth: Option<&Path>,
        frame: &LocalFrame,
    ) -> Result<Self, YardstickError> {
        let folder = files::folder_of(data);
        let own = folder.join(TRUE_MESH);
        let truth = truth.or_else(|| own.is_file().then_some(own.as_path()));
        let truth = truth.map(|truth| read_truth(truth, frame)).transpose()?;
        Ok(Self { lpips: lpips.map(LpipsPair::read).transpose()?, truth })
    }
}

fn read_truth(path: &Path, frame: &LocalFrame) -> Result<Caster, SceneError> {
    let mesh = Mesh::read(path)?.into_frame(frame);
    match mesh.triangles.len() {
        0 => Err(SceneError::malformed(path, "has no triangles; the true surface must be a mesh")),
        count if count > TRIANGLES_MAX => {
            let reason = format!("has {count} triangles, more than {TRIANGLES_MAX}; simplify the mesh");
            Err(SceneError::malformed(path, reason))
        }
        _ => Ok(Caster::new(&mesh)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn colors(psnr: f64, ssim: f64) -> Quality {
        Quality { psnr, ssim, lpips: None, surface: None }
    }

    #[test]
    fn the_mean_is_over_the_views_that_have_a_figure() {
        assert_eq!(Quality::mean(&[]), None);
        let mut of = [colors(20.0, 0.5), colors(30.0, 0.75), colors(40.0, 1.0)];
        assert_eq!(Quality::mean(&of), Some(colors(30.0, 0.75)));
        of[0].lpips = Some(LpipsScore { vgg: 0.5, alex: 0.25 });
        of[2].lpips = Some(LpipsScore { vgg: 0.25, alex: 0.75 });
        assert_eq!(Quality::mean(&of).unwrap().lpips, Some(LpipsScore { vgg: 0.375, alex: 0.5 }));
    }

    #[test]
    fn a_true_mesh_is_found_beside_the_data_or_where_it_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let read = |truth| {
            Yardsticks::read(folder.path(), None, truth, &LocalFrame::WORLD)
                .map(|yardsticks| yardsticks.truth.is_some())
        };
        assert!(!read(None).unwrap());
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh = Mesh { positions, triangles: vec![[0, 1, 2]], ..Mesh::default() };
        std::fs::create_dir(folder.path().join("gt")).unwrap();
        mesh.write_ply(&folder.path().join("gt/mesh.ply")).unwrap();
        assert!(read(None).unwrap());
        let points = folder.path().join("points.ply");
        Mesh { triangles: Vec::new(), ..mesh }.write_ply(&points).unwrap();
        let error = read(Some(&points)).unwrap_err().to_string();
        assert!(error.contains("points.ply") && error.contains("no triangles"), "{error}");
        assert!(read(Some(&folder.path().join("none.ply"))).is_err());
        let weights = Some(folder.path());
        let error =
            Yardsticks::read(folder.path(), weights, None, &LocalFrame::WORLD).unwrap_err().to_string();
        assert!(error.contains("vgg.safetensors") && error.lines().count() == 1, "{error}");
    }
}
