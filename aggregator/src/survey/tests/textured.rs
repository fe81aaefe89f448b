//! The textured mesh, read from its files as other programs do.

use std::path::Path;

use glam::{DVec2, DVec3, Vec3};

/// Checks that `mesh.obj` with its picture is green south of a place of the map and blue north of it, as the model is.
pub(super) fn check(out: &Path, middle: DVec3, triangles: usize) {
    let obj = std::fs::read_to_string(out.join("mesh.obj")).unwrap();
    let rows = |kind: &str| -> Vec<Vec<&str>> {
        let lines = obj.lines().filter_map(|line| line.split_once(' ')).filter(|(first, _)| *first == kind);
        lines.map(|(_, rest)| rest.split(' ').collect()).collect()
    };
    let numbers = |kind: &str| -> Vec<Vec<f64>> {
        rows(kind).iter().map(|row| row.iter().map(|number| number.parse().unwrap()).collect()).collect()
    };
    let (positions, places, faces) = (numbers("v"), numbers("vt"), rows("f"));
    assert_eq!((faces.len(), places.len()), (triangles, positions.len()));
    let material = std::fs::read_to_string(out.join(rows("mtllib")[0][0])).unwrap();
    assert!(material.contains(&format!("newmtl {}\n", rows("usemtl")[0][0])), "{material}");
    let picture = material.lines().find_map(|line| line.strip_prefix("map_Kd ")).unwrap();
    let picture = image::open(out.join(picture)).unwrap().to_rgb8();
    let size_px = DVec2::new(f64::from(picture.width()), f64::from(picture.height()));
    let mut counts = [0; 2];
    for face in faces {
        let corners = face.iter().map(|corner| {
            let (position, place) = corner.split_once('/').unwrap();
            let index = position.parse::<usize>().unwrap() - 1;
            assert_eq!(position, place);
            (positions[index][1], DVec2::new(places[index][0], 1.0 - places[index][1]))
        });
        let (north, uv) =
            corners.fold((0.0, DVec2::ZERO), |sum, of| (sum.0 + of.0 / 3.0, sum.1 + of.1 / 3.0));
        let north_m = north - middle.y.rem_euclid(1000.0);
        let [x, y] = (uv * size_px).to_array().map(|px| px as u32);
        let wanted = if north_m < 0.0 { [26.0, 204.0, 51.0] } else { [26.0, 51.0, 204.0] };
        // Grid north is 1.1° from north here, and splats on the line between the colours blend.
        if north_m.abs() > 0.9 {
            let found = Vec3::from(picture.get_pixel(x, y).0.map(f32::from));
            assert!((found - Vec3::from(wanted)).abs().max_element() < 40.0, "{north_m} m north: {found}");
            counts[usize::from(north_m < 0.0)] += 1;
        }
    }
    assert!(counts.iter().all(|count| *count > 10), "{counts:?}");
}
