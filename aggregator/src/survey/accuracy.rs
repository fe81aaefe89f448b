//! `accuracy.json`: what the deliverables are, and how accurate they are known to be.
//!
//! What it knows nothing about: how anything was computed; it only states it.

use cosurf_geo::{DroneResiduals, Geodetic, Georeference, GpsResiduals, PointResidual};
use serde::Serialize;

use super::heights::Covered;
use super::lattice::Lattice;
use super::solid::SolidSize;
use super::splat_tiles::SplatTiles;
use super::volumes::Volumes;

/// The content of `accuracy.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Accuracy {
    /// Origin of the site.
    pub origin: Geodetic,
    /// EPSG number of the coordinate system of the maps and points.
    pub epsg: u32,
    /// What heights are.
    pub heights: String,
    /// Side of a pixel of the maps, metres in the coordinate system.
    pub gsd_m: f64,
    /// Width and height of the maps, px.
    pub size_px: [u32; 2],
    /// Area with heights, square metres on the ground.
    pub covered_m2: f64,
    /// Lowest and highest height, metres.
    pub height_range_m: [f64; 2],
    /// Median of the errors of heights that `confidence.tif` claims, metres.
    pub height_error_m: f64,
    /// Number of points in `points.laz`.
    pub points: u64,
    /// Points per square metre of the covered area.
    pub points_per_m2: f64,
    /// Edge length of the mesh's voxels, metres: detail of the surface that is smaller is not in the heights.
    pub voxel_m: f64,
    /// Number of triangles in `mesh.glb`.
    pub triangles: usize,
    /// Bound on the error of `mesh.glb` and of the finest tiles, metres, by the estimate of the decimation.
    pub mesh_error_m: f64,
    /// Side of a pixel of `mesh.jpg` on the surface, metres; absent if there was too little memory for it, so that colours
    /// belong to vertices.
    pub texel_m: Option<f64>,
    /// Number of levels of detail in `tileset.json`.
    pub tile_levels: usize,
    /// Number of cameras.
    pub cameras: usize,
    /// Number of splats of the finest tiles of `splats/tileset.json`.
    pub splats: usize,
    /// Number of levels of detail in `splats/tileset.json`.
    pub splat_levels: usize,
    /// Number of splats that floated above the surface or lay far outside of it, and are not in `ortho.tif`, `splats` and
    /// `splats.ply`.
    pub splats_left_out: usize,
    /// How well the photographs' GPS agrees with their poses; absent if the place does not come from GPS.
    pub gps: Option<GpsResiduals>,
    /// The points on the ground that the place was fitted to; absent if there are none.
    pub control: Option<PointsAccuracy>,
    /// Points on the ground that were held out; absent if there are none. Only these tell the accuracy on the ground.
    pub check: Option<PointsAccuracy>,
    /// Of a model that was merged from those of several drones: what is known of the place of each. The fields above are then
    /// absent. Empty otherwise.
    pub drones: Vec<DroneResiduals>,
    /// A line for each polygon that is not in `volumes.json`, with the reason.
    pub volumes_left_out: Vec<String>,
    /// For each file: how it was made.
    pub made: Vec<MadeFile>,
}

/// How well points on the ground were met.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointsAccuracy {
    /// Root mean square of the residuals: east, north, up, metres.
    pub rmse_m: [f64; 3],
    /// The residual of each.
    pub points: Vec<PointResidual>,
}

/// How a file was made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MadeFile {
    /// Name of the file.
    pub file: &'static str,
    /// One sentence.
    pub how: String,
}

/// Figures of what was made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Made {
    pub(super) covered: Covered,
    pub(super) height_error_m: f64,
    pub(super) points: u64,
    pub(super) solid: SolidSize,
    pub(super) voxel_m: f64,
    pub(super) cameras: usize,
    pub(super) splats: SplatTiles,
}

pub(super) fn accuracy_of(
    georeference: &Georeference,
    lattice: &Lattice,
    made: &Made,
    contours_m: f64,
    volumes: Option<&Volumes>,
) -> Accuracy {
    let Made { covered, height_error_m, points, solid, voxel_m, cameras, splats } = *made;
    let residuals = &georeference.residuals;
    Accuracy {
        origin: georeference.origin,
        epsg: georeference.epsg,
        heights: lattice.place().heights(),
        gsd_m: lattice.gsd_m(),
        size_px: lattice.size_px(),
        covered_m2: covered.area_m2,
        height_range_m: covered.range_m,
        height_error_m,
        points,
        points_per_m2: points as f64 / covered.area_m2,
        voxel_m,
        triangles: solid.triangles,
        mesh_error_m: solid.error_m,
        texel_m: solid.texel_m,
        tile_levels: solid.levels,
        cameras,
        splats: splats.splats,
        splat_levels: splats.levels,
        splats_left_out: splats.left_out,
        gps: residuals.gps,
        control: PointsAccuracy::of(&residuals.control),
        check: PointsAccuracy::of(&residuals.check),
        drones: georeference.drones.clone(),
        volumes_left_out: volumes.map_or_else(Vec::new, |volumes| volumes.left_out.clone()),
        made: made_files(contours_m, solid.texel_m, volumes.is_some()),
    }
}

fn made_files(contours_m: f64, texel_m: Option<f64>, has_volumes: bool) -> Vec<MadeFile> {
    let colors = match texel_m {
        Some(_) => "Its picture is mesh.jpg.",
        None => "Colours belong to vertices, because there was too little memory for a picture.",
    };
    let mut files = vec![
        ("dsm.tif", "Highest surface of a mesh, at the centre of each pixel, if three cameras show it and few look through it; the mesh was fused from the model's depth in all cameras.".into()),
        ("dtm.tif", "Heights of dsm.tif where the progressive morphological filter (Zhang et al. 2003) finds bare ground, and between them heights of the ground around; gaps of dsm.tif up to 50 m wide are filled.".into()),
        ("ortho.tif", "The splats of the model, rendered from straight above each pixel, without those that float above the mesh.".into()),
        ("confidence.tif", "How many views show the surface of dsm.tif at each pixel; the root mean square of the differences between the heights they show and dsm.tif, metres; and the error that about 68 % of such heights stay below, metres, by a model of views, differences and edges that was fitted to two known surfaces.".into()),
        ("points.laz", "The vertices of the mesh that two cameras see and that no more views look through than show, where dsm.tif has heights, with its colours, as a Cloud-Optimised Point Cloud.".into()),
        ("mesh.glb", format!("The mesh without the other vertices, decimated by quadric errors of position and colour. {colors} Its heights are above the origin.")),
        ("mesh.obj", "The triangles of mesh.glb in the coordinate system and with the heights of the maps, minus the whole kilometres that its first line tells.".into()),
        ("tileset.json", "The same mesh as a quadtree of tiles, each level decimated further; its place is earth-centred, so it needs no geoid.".into()),
        ("splats/tileset.json", "The splats of the model without those that float above the mesh or lie far outside of it, as a quadtree of tiles of glTF with SPZ; each level has a quarter of the splats of the level below, enlarged to cover as much.".into()),
        ("splats.ply", "The same splats, in metres about the origin, with further properties: views and through, the numbers of cameras that show the centre of the splat and that look through it; spread_m, the root mean square of the distances along the rays between the centre and the surface that the former show; and error_m by the model of confidence.tif, without edges, or 0 where nothing can be claimed.".into()),
        ("contours.geojson", format!("Lines every {contours_m} m, by marching squares through means of dtm.tif.")),
    ];
    if let Some(texel_m) = texel_m {
        files.push(("mesh.jpg", format!("The colours of mesh.glb and mesh.obj, in pixels of {texel_m:.3} m: the mean of what the cameras show that see the place, weighted by the fourth power of their pixels per metre of the surface; of the vertices where none does.")));
        files.push(("mesh.mtl", "Names mesh.jpg as the picture of mesh.obj.".into()));
    }
    if has_volumes {
        files.push((
            "volumes.json",
            "Sums over the pixels of dsm.tif in each polygon, against a plane fitted to the heights at its border.".into(),
        ));
    }
    files.into_iter().map(|(file, how)| MadeFile { file, how }).collect()
}

impl PointsAccuracy {
    fn of(points: &[PointResidual]) -> Option<Self> {
        (!points.is_empty()).then(|| Self { rmse_m: PointResidual::rms_m(points), points: points.to_vec() })
    }
}

impl Accuracy {
    /// The content of the file.
    pub(super) fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("numbers and texts") + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rmse_is_that_of_each_axis() {
        let point = |residual_m| PointResidual { name: "A".into(), photographs: 3, residual_m };
        let points = [point([3.0, 0.0, -1.0]), point([-4.0, 0.2, 1.0])];
        let rmse_m = PointsAccuracy::of(&points).map_or([0.0; 3], |accuracy| accuracy.rmse_m);
        let wanted = [12.5f64.sqrt(), 0.02f64.sqrt(), 1.0];
        assert!((0..3).all(|axis| (rmse_m[axis] - wanted[axis]).abs() < 1e-12), "{rmse_m:?}");
        assert_eq!(PointsAccuracy::of(&[]), None);
    }
}
