//! Measures how far the two true surfaces of rendered Boruszyn (points and a mesh) differ in their normals.

use anyhow::{Context, Result};
use cosurf_scene::{Caster, Dataset, Mesh};
use cosurf_tests::results::{Column, Measurement, Results};
use glam::Vec3;
use tempfile::TempDir;

use crate::commands::dataset;

/// Largest long side of the views in which the surfaces are compared, pixels.
const SIZE_PX: u32 = 480;
/// A point belongs to the facet seen at its pixel if their depths differ by less than this share.
const SAME_DEPTH: f64 = 0.002;

/// Measures the median angle between the normal of a true point and the normal of the mesh's facet at the same place,
/// over all views that show both. Opposite normals count as equal.
pub(crate) fn truth(_: &TempDir) -> Result<Results> {
    let data = dataset("gt_boruszyn")?;
    let points = Mesh::read(&data.join("gt/points.ply"))?;
    let caster = Caster::new(&Mesh::read(&data.join("gt/mesh.ply"))?);
    let mut angles_deg = Vec::new();
    for view in &Dataset::open(&data)?.views {
        let camera = view.camera.fitted(SIZE_PX);
        let surface = caster.cast(&camera);
        for (point, normal) in points.positions.iter().zip(&points.normals) {
            let [point, normal] = [point, normal].map(|values| Vec3::from_array(*values).as_dvec3());
            let Some(at_px) = camera.project(point).filter(|at_px| camera.contains(*at_px)) else { continue };
            let pixel = at_px.y as usize * camera.size_px[0] as usize + at_px.x as usize;
            let depth = camera.cam_from_world.transform(point).z;
            if (f64::from(surface.depth[pixel]) - depth).abs() < SAME_DEPTH * depth {
                let normal = camera.cam_from_world.rotation * normal;
                let facet = Vec3::from_array(surface.normals[pixel]).as_dvec3();
                angles_deg.push(normal.cross(facet).length().atan2(normal.dot(facet).abs()).to_degrees());
            }
        }
    }
    angles_deg.sort_unstable_by(f64::total_cmp);
    let median = *angles_deg.get(angles_deg.len() / 2).context("no view shows a point of the surface")?;
    let mut measurement = Measurement::start("truth", &[Column::new("normals", "°", 1)]);
    measurement.row("rendered Boruszyn, median", &[Some(median)]);
    Ok(measurement.finish()?)
}
