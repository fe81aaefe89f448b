//! The city as a dataset on disk, in the layout that real scenes have.

use std::fs;
use std::io::Write;
use std::path::Path;

use super::{City, TruthMesh, TruthPoint};
use crate::{Dataset, SceneError, atomic, colmap};

/// Folder of the pictures.
pub(super) const PICTURES: &str = "images";
/// Folder of the truth.
const TRUTH: &str = "gt";
/// JPEG quality of the pictures.
const QUALITY: u8 = 95;
/// Truth points per square metre of the flown square, and how many there are at least and at most.
const POINTS_PER_M2: f64 = 2.0;
const POINTS_RANGE: (f64, f64) = (20_000.0, 400_000.0);

pub(super) fn write(
    city: &City,
    folder: &Path,
    mut progress: impl FnMut(usize, usize),
) -> Result<Dataset, SceneError> {
    for name in [PICTURES, TRUTH] {
        let folder = folder.join(name);
        fs::create_dir_all(&folder).map_err(|cause| SceneError::io(&folder, cause))?;
    }
    let mut dataset = city.dataset();
    let total = dataset.views.len();
    for (i, view) in dataset.views.iter_mut().enumerate() {
        view.path = folder.join(&view.path);
        city.render(&view.camera).picture.write_jpeg(&view.path, QUALITY)?;
        progress(i + 1, total);
    }
    colmap::write(folder, &dataset)?;
    write_mesh(&folder.join(TRUTH).join("mesh.ply"), &city.truth_mesh())?;
    let area = city.settings.extent_m * city.settings.extent_m;
    let count = (POINTS_PER_M2 * area).clamp(POINTS_RANGE.0, POINTS_RANGE.1) as usize;
    let points = city.truth_points(count, city.settings.seed);
    write_points(&folder.join(TRUTH).join("points.ply"), &points)?;
    Ok(dataset)
}

/// The beginning of a binary PLY with vertices of these float properties and a colour.
fn header(vertices: usize, floats: &[&str]) -> String {
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\ncomment units metres, x east y north z up\n\
         element vertex {vertices}\n"
    );
    for name in floats {
        text += &format!("property float {name}\n");
    }
    for name in ["red", "green", "blue"] {
        text += &format!("property uchar {name}\n");
    }
    text
}

fn write_mesh(path: &Path, mesh: &TruthMesh) -> Result<(), SceneError> {
    atomic::write(path, |out| {
        out.write_all(header(mesh.positions.len(), &["x", "y", "z"]).as_bytes())?;
        let faces = mesh.triangles.len();
        write!(out, "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n")?;
        for (position, rgb) in mesh.positions.iter().zip(&mesh.rgb) {
            out.write_all(position.map(f32::to_le_bytes).as_flattened())?;
            out.write_all(rgb)?;
        }
        for corners in &mesh.triangles {
            out.write_all(&[3])?;
            out.write_all(corners.map(u32::to_le_bytes).as_flattened())?;
        }
        Ok(())
    })
}

fn write_points(path: &Path, points: &[TruthPoint]) -> Result<(), SceneError> {
    atomic::write(path, |out| {
        out.write_all(header(points.len(), &["x", "y", "z", "nx", "ny", "nz"]).as_bytes())?;
        out.write_all(b"end_header\n")?;
        for point in points {
            out.write_all(point.position.map(f32::to_le_bytes).as_flattened())?;
            out.write_all(point.normal.map(f32::to_le_bytes).as_flattened())?;
            out.write_all(&point.rgb)?;
        }
        Ok(())
    })
}
