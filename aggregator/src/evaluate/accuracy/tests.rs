//! Scores surfaces whose correct scores follow from their geometry.

#![allow(clippy::unwrap_used)]

use super::*;

/// A horizontal square at z = 3 m. It has sides of `side_m` and a corner above the origin, and consists of
/// squares of half a metre.
fn square(side_m: f32) -> Mesh {
    let n = (2.0 * side_m) as u32;
    let at = |i: u32| [0.5 * (i % (n + 1)) as f32, 0.5 * (i / (n + 1)) as f32, 3.0];
    let mut mesh = Mesh { positions: (0..(n + 1) * (n + 1)).map(at).collect(), ..Mesh::default() };
    for y in 0..n {
        for x in 0..n {
            let i = y * (n + 1) + x;
            mesh.triangles.push([i, i + 1, i + n + 2]);
            mesh.triangles.push([i, i + n + 2, i + n + 1]);
        }
    }
    mesh
}

fn moved(mesh: &Mesh, by: [f32; 3]) -> Mesh {
    let mut mesh = mesh.clone();
    mesh.positions.iter_mut().for_each(|p| (0..3).for_each(|k| p[k] += by[k]));
    mesh
}

fn joined(a: &Mesh, b: &Mesh) -> Mesh {
    let mut mesh = a.clone();
    mesh.positions.extend(&b.positions);
    let first = a.positions.len() as u32;
    mesh.triangles.extend(b.triangles.iter().map(|triangle| triangle.map(|v| v + first)));
    mesh
}

/// Samples of a mesh, as a point cloud with upward normals.
fn cloud(mesh: &Mesh, spacing_m: f64) -> Mesh {
    let points = sample(mesh, spacing_m, 5, SAMPLES_MAX).unwrap();
    let normals = vec![[0.0, 0.0, 1.0]; points.len()];
    Mesh { positions: points.iter().map(Vec3::to_array).collect(), normals, ..Mesh::default() }
}

fn accuracy(mesh: &Mesh, truth: &Mesh) -> Accuracy {
    judge(mesh, truth, 0.5, 0).unwrap().0
}

fn near(value: f64, wanted: f64, tolerance: f64) -> bool {
    (value - wanted).abs() <= tolerance
}

#[test]
fn a_mesh_scores_one_against_itself() {
    let mesh = square(20.0);
    let found = accuracy(&mesh, &mesh);
    assert_eq!((found.samples.precision, found.samples.recall, found.samples.f_score), (1.0, 1.0, 1.0));
    assert_eq!(found.vertices.precision, 1.0);
    // The samples are spread at random, on average one for each square of 0.125 m. In such a random pattern,
    // the nearest sample is half of that, 0.0625 m, away on average.
    assert!(near(found.chamfer_m, 0.0625, 0.005), "{}", found.chamfer_m);
    assert_eq!((found.cropped, found.truth_disc_m), (0.0, 0.0));
}

#[test]
fn a_mesh_two_thresholds_off_is_wrong_everywhere() {
    let mesh = square(20.0);
    let found = accuracy(&moved(&mesh, [0.0, 0.0, 1.0]), &mesh);
    assert_eq!((found.samples.f_score, found.vertices.f_score), (0.0, 0.0));
    assert!(near(found.mesh_to_truth_m, 1.0, 0.01) && near(found.truth_to_mesh_m, 1.0, 0.01));
    let within = accuracy(&moved(&mesh, [0.0, 0.0, 0.45]), &mesh);
    assert!(within.samples.f_score > 0.99, "{within:?}");
    let beyond = accuracy(&moved(&mesh, [0.0, 0.0, 0.55]), &mesh);
    assert_eq!(beyond.samples.f_score, 0.0);
}

#[test]
fn missing_surface_costs_recall_and_a_floater_costs_precision() {
    let truth = square(20.0);
    let half = Mesh { triangles: truth.triangles[..truth.triangles.len() / 2].to_vec(), ..truth.clone() };
    let found = accuracy(&half, &truth);
    // The mesh covers half of the truth. A strip as wide as the threshold beside that half is also near
    // enough.
    assert!(near(found.samples.recall, 0.525, 0.003), "{found:?}");
    assert_eq!(found.samples.precision, 1.0);
    let floater = joined(&truth, &moved(&square(20.0), [0.0, 0.0, 15.0]));
    let found = accuracy(&floater, &truth);
    assert!(near(found.samples.precision, 0.5, 0.005) && found.samples.recall == 1.0, "{found:?}");
    assert!(near(found.samples.f_score, 2.0 / 3.0, 0.005));
    assert!(near(found.mesh_to_truth_m, 7.5, 0.1), "{found:?}");
}

#[test]
fn the_mesh_is_scored_only_above_the_truths_footprint() {
    let (mesh, truth) = (square(40.0), square(20.0));
    let (found, errors) = judge(&mesh, &truth, 0.5, 0).unwrap();
    assert!(near(found.cropped, 1.0 - (20.5 / 40.0f64).powi(2), 0.005), "{found:?}");
    assert!(found.samples.precision > 0.99 && found.samples.recall == 1.0, "{found:?}");
    let judged = errors.iter().filter(|error| !error.is_nan()).count();
    assert_eq!(judged, 41 * 41, "vertices on the square and its border");
}

#[test]
fn a_mesh_outside_the_footprint_has_zero_precision() {
    let truth = square(20.0);
    let found = accuracy(&moved(&truth, [100.0, 0.0, 0.0]), &truth);
    assert_eq!((found.samples.precision, found.samples.f_score, found.cropped), (0.0, 0.0, 1.0));
    assert_eq!(found.mesh_to_truth_m, f64::INFINITY);
}

#[test]
fn sparse_truth_points_stand_for_discs() {
    let mesh = square(30.0);
    let truth = cloud(&mesh, 0.8);
    let found = accuracy(&mesh, &truth);
    // A disc with the area of a 0.8 m square has a radius of 0.451 m. The estimate is slightly larger, because
    // points at the border have fewer neighbours.
    assert!(near(found.truth_disc_m, 0.451, 0.03), "{found:?}");
    assert!(found.samples.precision > 0.985 && found.samples.recall == 1.0, "{found:?}");
    let bare = Mesh { normals: Vec::new(), ..truth.clone() };
    let without = accuracy(&mesh, &bare);
    // Without normals, points do not stand for discs. The points are random, on average one for each square of 0.8 m,
    // so a share of exp(-π 0.5² / 0.8²) of the area is farther than the threshold, 0.5 m, from every point.
    assert!(near(without.samples.precision, 1.0 - 0.293, 0.02), "{without:?}");
    let lifted = accuracy(&moved(&mesh, [0.0, 0.0, 0.6]), &truth);
    assert_eq!(lifted.samples.precision, 0.0, "discs are flat");
}

#[test]
fn sampling_is_even_and_the_same_for_the_same_seed() {
    let mesh = joined(
        &square(10.0),
        &Mesh {
            positions: vec![[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [0.0, 20.0, 0.0]],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        },
    );
    let points = sample(&mesh, 0.1, 3, SAMPLES_MAX).unwrap();
    let large = points.iter().filter(|p| p.z == 0.0).count() as f64;
    assert!(near(large, 40_000.0, 2.0) && near(points.len() as f64 - large, 10_000.0, 300.0));
    assert_eq!(points, sample(&mesh, 0.1, 3, SAMPLES_MAX).unwrap());
    assert_ne!(points, sample(&mesh, 0.1, 4, SAMPLES_MAX).unwrap());
    assert_eq!(sample(&mesh, 0.1, 3, 40_000), None, "more than the limit");
}

#[test]
fn the_tree_finds_what_comparing_all_finds() {
    let points: Vec<Vec3> = sample(&square(10.0), 0.3, 1, SAMPLES_MAX)
        .unwrap()
        .into_iter()
        .map(|p| p + Vec3::Z * (p.x * 7.0).sin())
        .collect();
    let tree = Tree::new(&points);
    for query in points.iter().step_by(7).map(|p| *p + Vec3::new(0.03, -0.2, 0.4)) {
        let mut all: Vec<(f32, u32)> = points.iter().map(|p| p.distance_squared(query)).zip(0..).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert_eq!(tree.nearest::<4>(query), all[..4]);
        assert!(tree.is_any_within(query, all[0].0 * 1.001) && !tree.is_any_within(query, all[0].0));
    }
    assert_eq!(Tree::new(&points[..1]).nearest::<2>(points[0])[1].0, f32::INFINITY);
}

#[test]
fn input_that_cannot_be_scored_is_refused() {
    let mesh = square(5.0);
    let empty = Mesh::default();
    assert_eq!(judge(&cloud(&mesh, 0.5), &mesh, 0.5, 0).unwrap_err(), AccuracyError::NoTriangles);
    assert_eq!(judge(&mesh, &empty, 0.5, 0).unwrap_err(), AccuracyError::NoTruth);
    assert_eq!(judge(&mesh, &mesh, 1e-6, 0).unwrap_err(), AccuracyError::TooFine);
}
