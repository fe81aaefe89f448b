//! Volumes of polygons: how much of the surface lies above, and below, a plane that is fitted to the heights at the
//! polygon's border, as for a heap on sloping ground.
//!
//! What it knows nothing about: where heights come from.
//!
//! Where to start reading: [`find_volumes`]; [`polygons`] reads the file.

mod plane;
mod polygons;

use cosurf_scene::SceneError;
use glam::DVec2;
use serde::Serialize;

use super::error::SurveyError;
use super::lattice::Lattice;
use super::tiles::Tiles;
use plane::Plane;
use polygons::Polygon;
pub(super) use polygons::{check_near, read_polygons};

/// The volume of a polygon.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Volume {
    /// The property `name` of the polygon, or its number.
    pub name: String,
    /// Its area, square metres on the ground.
    pub area_m2: f64,
    /// Share of the area that has heights, 0 to 1. The rest counts in no other figure.
    pub covered_share: f64,
    /// Volume of the surface above the plane, cubic metres.
    pub cut_m3: f64,
    /// Volume between the surface and the plane where the surface is lower, cubic metres.
    pub fill_m3: f64,
    /// Mean height of the surface, metres.
    pub mean_height_m: f64,
    /// Root mean square of the differences between the plane and the border's heights, metres: how uneven the border is.
    pub border_rms_m: f64,
}

/// What can be measured of polygons.
#[derive(Clone, Debug, Default)]
pub(super) struct Volumes {
    volumes: Vec<Volume>,
    /// A line for each polygon that cannot be measured.
    pub(super) left_out: Vec<String>,
}

impl Volumes {
    /// The content of `volumes.json`.
    pub(super) fn to_json(&self) -> String {
        serde_json::to_string_pretty(&self.volumes).expect("numbers and texts") + "\n"
    }
}

/// The volume of each polygon.
pub(super) fn find_volumes(
    polygons: &[Polygon],
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
) -> Result<Volumes, SurveyError> {
    let mut found = Volumes::default();
    for polygon in polygons {
        match find_volume(polygon, lattice, heights)? {
            Some(volume) => found.volumes.push(volume),
            None => found.left_out.push(format!(
                "{}: its border shows too little of the surface to fit a plane to it; draw it on ground that dsm.tif covers",
                polygon.name
            )),
        }
    }
    Ok(found)
}

/// The volume of a polygon; `None` if its border shows too little of the surface.
fn find_volume(
    polygon: &Polygon,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
) -> Result<Option<Volume>, SurveyError> {
    let rings: Vec<Vec<DVec2>> =
        polygon.rings.iter().map(|ring| ring.iter().map(|at| lattice.px_from_map(*at)).collect()).collect();
    let border = border_heights(&rings[0], lattice.size_px(), heights)?;
    let Some(plane) = Plane::fitted(&border) else { return Ok(None) };
    let border_rms_m = plane.rms(&border);

    let (mut count, mut cut, mut fill, mut sum) = (0u64, 0.0, 0.0, 0.0);
    for_each_inside(&rings, heights, |px, height| {
        let above = height - plane.height(px);
        count += 1;
        cut += above.max(0.0);
        fill += (-above).max(0.0);
        sum += height;
    })?;
    let pixel_m2 = lattice.pixel_area_m2(polygons::middle(&rings[0]))?;
    let area_px = polygons::area(&rings);
    Ok(Some(Volume {
        name: polygon.name.clone(),
        area_m2: area_px * pixel_m2,
        covered_share: (count as f64 / area_px).min(1.0),
        cut_m3: cut * pixel_m2,
        fill_m3: fill * pixel_m2,
        mean_height_m: if count > 0 { sum / count as f64 } else { plane.height(polygons::middle(&rings[0])) },
        border_rms_m,
    }))
}

/// The heights along a ring, a pixel apart: position, px, and height, metres. Without those that are missing.
fn border_heights(
    ring: &[DVec2],
    size_px: [u32; 2],
    heights: &mut Tiles<f32>,
) -> Result<Vec<(DVec2, f64)>, SceneError> {
    let inside = |at: DVec2| {
        let is_inside = at.cmpge(DVec2::ZERO).all() && at.x < size_px[0].into() && at.y < size_px[1].into();
        is_inside.then_some([at.x as u32, at.y as u32])
    };
    let mut pixels: Vec<(usize, [u32; 2])> =
        polygons::along(ring, size_px).filter_map(inside).map(|px| (heights.tile_of(px), px)).collect();
    pixels.sort_unstable();
    pixels.dedup();
    let mut border = Vec::with_capacity(pixels.len());
    for group in pixels.chunk_by(|a, b| a.0 == b.0) {
        let (window, values) = (heights.window(group[0].0), heights.read(group[0].0)?);
        for (_, [x, y]) in group {
            let height = values[((y - window.at[1]) * window.size[0] + x - window.at[0]) as usize];
            if !height.is_nan() {
                border.push((DVec2::new(f64::from(*x), f64::from(*y)) + 0.5, f64::from(height)));
            }
        }
    }
    Ok(border)
}

/// Calls `visit` with the centre, px, and the height, metres, of each pixel that has a height and whose centre is inside.
fn for_each_inside(
    rings: &[Vec<DVec2>],
    heights: &mut Tiles<f32>,
    mut visit: impl FnMut(DVec2, f64),
) -> Result<(), SceneError> {
    let corners = || rings[0].iter();
    let bound =
        |of: fn(f64, f64) -> f64, start: f64, axis: usize| corners().map(|at| at[axis]).fold(start, of);
    let low = [0, 1].map(|axis| bound(f64::min, f64::INFINITY, axis));
    let high = [0, 1].map(|axis| bound(f64::max, f64::NEG_INFINITY, axis));
    for tile in 0..heights.len() {
        let window = heights.window(tile);
        let is_apart = (0..2).any(|axis| {
            let [first, size] = [window.at[axis], window.size[axis]].map(f64::from);
            high[axis] < first || low[axis] > first + size
        });
        if is_apart {
            continue;
        }
        let values = heights.read(tile)?;
        for y in 0..window.size[1] {
            let at_y = f64::from(window.at[1] + y) + 0.5;
            let crossings = polygons::crossings(rings, at_y);
            let row = &values[(y * window.size[0]) as usize..][..window.size[0] as usize];
            for (x, height) in row.iter().enumerate().filter(|(_, height)| !height.is_nan()) {
                let at = DVec2::new(f64::from(window.at[0]) + x as f64 + 0.5, at_y);
                // Inside is where an odd number of borders lies to the west.
                if crossings.partition_point(|crossing| *crossing < at.x) % 2 == 1 {
                    visit(at, f64::from(*height));
                }
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::lattice::tests::lattice;
    use super::*;

    /// A map of 60 m × 50 m with pixels of 0.1 m, of a slope with a pyramid: 4 m high, 20 m wide.
    fn heap() -> (Lattice, Tiles<f32>, DVec2) {
        let lattice = lattice([0.0, 0.0], [60.0, 50.0], 0.1);
        let folder = tempfile::tempdir().unwrap();
        let mut heights = Tiles::new(folder.path(), lattice.size_px(), 128).unwrap();
        let middle = DVec2::new(310.0, 260.0);
        for tile in 0..heights.len() {
            let window = heights.window(tile);
            let value = |i: u32| {
                let px = [window.at[0] + i % window.size[0], window.at[1] + i / window.size[0]];
                let px = DVec2::new(f64::from(px[0]) + 0.5, f64::from(px[1]) + 0.5);
                let from = ((px - middle) * 0.1).abs();
                let heap = (4.0 - 0.4 * from.max_element()).max(0.0);
                (80.0 + 0.02 * px.x - 0.01 * px.y + heap) as f32
            };
            let values: Vec<f32> = (0..window.pixels() as u32).map(value).collect();
            heights.write(tile, &values).unwrap();
        }
        (lattice, heights, middle)
    }

    fn square(lattice: &Lattice, middle: DVec2, half_px: f64) -> Polygon {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]];
        let ring = corners.map(|corner| lattice.map_from_px(middle + DVec2::from(corner) * half_px));
        Polygon { name: "heap".into(), rings: vec![ring.to_vec()] }
    }

    #[test]
    fn a_pyramid_on_a_slope_has_the_volume_of_its_formula() {
        let (lattice, mut heights, middle) = heap();
        let polygon = square(&lattice, middle, 120.0);
        let volume = &find_volumes(&[polygon], &lattice, &mut heights).unwrap().volumes[0];
        let scale = lattice.pixel_area_m2(middle).unwrap() / 0.01;
        // A third of the base times the height.
        let wanted = 400.0 * 4.0 / 3.0 * scale;
        assert!((volume.cut_m3 - wanted).abs() < 0.003 * wanted, "{volume:?} for {wanted}");
        assert!(volume.fill_m3 < 0.01 && volume.border_rms_m < 0.001, "{volume:?}");
        assert!((volume.area_m2 - 576.0 * scale).abs() < 1e-6 && volume.covered_share > 0.999, "{volume:?}");
        // The slope at the middle, and the pyramid spread over the square.
        let mean = 80.0 + 6.2 - 2.6 + 400.0 * 4.0 / 3.0 / 576.0;
        assert!((volume.mean_height_m - mean).abs() < 0.01, "{volume:?} for {mean}");
    }

    #[test]
    fn holes_do_not_count() {
        let (lattice, mut heights, middle) = heap();
        let mut polygon = square(&lattice, middle, 120.0);
        polygon.rings.extend(square(&lattice, middle, 100.0).rings);
        let volume = &find_volumes(&[polygon], &lattice, &mut heights).unwrap().volumes[0];
        assert!(volume.cut_m3 < 0.01 && volume.covered_share > 0.99, "{volume:?}");
    }

    #[test]
    fn a_polygon_beside_the_map_is_left_out_and_the_others_are_measured() {
        let (lattice, mut heights, middle) = heap();
        let polygons = [square(&lattice, middle + 5000.0, 120.0), square(&lattice, middle, 120.0)];
        let found = find_volumes(&polygons, &lattice, &mut heights).unwrap();
        assert_eq!(found.volumes.len(), 1);
        assert!(found.left_out[0].starts_with("heap: its border"), "{:?}", found.left_out);
    }
}
