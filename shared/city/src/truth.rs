//! The true surface as a mesh, and as points spread evenly over its area.

use std::collections::HashMap;

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::light;
use super::material::Material;
use super::mesh::Triangle;
use super::random::Rng;
use super::render::World;
use super::sight::Sight;
use cosurf_scene::{Camera, Mesh};

/// Surface that this many cameras see counts as seen.
const CAMERAS_MIN: usize = 3;
/// Longest edge of the mesh's triangles, metres.
const EDGE_M: f32 = 1.6;
/// Colours are averaged over an area of this size, metres.
const FOOTPRINT_M: f32 = 0.12;
/// Random points that a thread tries at once.
const BATCH: usize = 1024;
/// Rounds before giving up; a round tries as many points as are wanted.
const ROUNDS: usize = 30;

/// A point of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruthPoint {
    /// World position.
    pub position: [f32; 3],
    /// Unit normal on the side that the cameras see.
    pub normal: [f32; 3],
    /// Colour, without reflections.
    pub rgb: [u8; 3],
}

/// A piece of a triangle of the city.
struct Piece {
    /// Index of the city's triangle.
    of: u32,
    /// The piece's corners, as weights of the triangle's second and third corner.
    corners: [Vec2; 3],
    /// Unit normal on the side that is seen.
    normal: Vec3,
}

fn position(triangle: &Triangle, weights: Vec2) -> Vec3 {
    let [a, b, c] = triangle.corners;
    a + (b - a) * weights.x + (c - a) * weights.y
}

/// The seen surface, cut into small triangles.
pub(super) fn mesh(world: &World, cameras: &[Camera]) -> Mesh {
    let sight = Sight::new(&world.bvh, cameras);
    let pieces: Vec<Piece> = (0..world.mesh.triangles.len())
        .into_par_iter()
        .flat_map_iter(|i| {
            let (triangle, sight) = (&world.mesh.triangles[i], &sight);
            let pieces =
                if sight.may_be_seen_by(&triangle.corners, CAMERAS_MIN) { cut(triangle) } else { Vec::new() };
            pieces.into_iter().filter_map(move |corners| {
                let middle = (corners[0] + corners[1] + corners[2]) * (1.0 / 3.0);
                let normal = seen_side(sight, triangle, middle)?;
                Some(Piece { of: i as u32, corners, normal })
            })
        })
        .collect();
    weld(world, &pieces)
}

/// The bare ground and water, seen or not: without kerbs' sides, buildings, plants and things that stand on it. It has no
/// colours, and no two triangles share a corner.
pub(super) fn ground(world: &World) -> Mesh {
    let is_ground = |material: u32| {
        let material = &world.mesh.materials[material as usize];
        matches!(material, Material::Street | Material::Ground(_) | Material::Water)
    };
    let corners: Vec<[Vec3; 3]> = world
        .mesh
        .triangles
        .iter()
        .filter(|triangle| is_ground(triangle.material))
        .map(|triangle| triangle.corners)
        .collect();
    Mesh {
        positions: corners.as_flattened().iter().map(|corner| corner.to_array()).collect(),
        triangles: (0..corners.len() as u32).map(|i| [0, 1, 2].map(|corner| 3 * i + corner)).collect(),
        ..Mesh::default()
    }
}

/// Cuts a triangle into similar triangles with edges of at most [`EDGE_M`], given as weights of its corners.
fn cut(triangle: &Triangle) -> Vec<[Vec2; 3]> {
    let [a, b, c] = triangle.corners;
    let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
    let n = (longest / EDGE_M).ceil().max(1.0) as usize;
    let at = |i: usize, j: usize| Vec2::new(i as f32, j as f32) * (1.0 / n as f32);
    let mut pieces = Vec::with_capacity(n * n);
    for i in 0..n {
        for j in 0..n - i {
            pieces.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            if i + j + 1 < n {
                pieces.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
    }
    pieces
}

/// The normal on the side from which cameras see a point; `None` if too few do.
fn seen_side(sight: &Sight, triangle: &Triangle, weights: Vec2) -> Option<Vec3> {
    let point = position(triangle, weights).as_dvec3();
    let [a, b, c] = triangle.corners;
    let normal = (b - a).cross(c - a).try_normalize()?;
    let seen_by = sight.seen_by(point, CAMERAS_MIN)?;
    let to_camera = sight.cameras[seen_by[0]].cam_from_world.center() - point;
    Some(if normal.dot(to_camera.as_vec3()) < 0.0 { -normal } else { normal })
}

/// Merges equal corners of pieces with the same material, so that edges between materials stay sharp.
fn weld(world: &World, pieces: &[Piece]) -> Mesh {
    let mut mesh = Mesh::default();
    let mut known: HashMap<([u32; 3], u32), u32> = HashMap::new();
    // The piece and its corner that each vertex takes its colour from.
    let mut sources = Vec::new();
    for (i, piece) in pieces.iter().enumerate() {
        let triangle = &world.mesh.triangles[piece.of as usize];
        let corners = [0, 1, 2].map(|k| {
            let p = position(triangle, piece.corners[k]).to_array();
            *known.entry((p.map(f32::to_bits), triangle.material)).or_insert_with(|| {
                mesh.positions.push(p);
                sources.push((i, k));
                sources.len() as u32 - 1
            })
        });
        mesh.triangles.push(corners);
    }
    mesh.rgb = sources
        .par_iter()
        .map(|&(i, k)| {
            let piece = &pieces[i];
            let middle = (piece.corners[0] + piece.corners[1] + piece.corners[2]) * (1.0 / 3.0);
            // Slightly inside the piece, so that adjoining surfaces do not shade it.
            let inside = piece.corners[k].lerp(middle, 0.05);
            light::encode(world.matt_shade(piece.of, inside.to_array(), piece.normal, FOOTPRINT_M))
        })
        .collect();
    mesh
}

/// Points spread evenly over the seen area.
pub(super) fn points(world: &World, cameras: &[Camera], count: usize, seed: u64) -> Vec<TruthPoint> {
    let sight = Sight::new(&world.bvh, cameras);
    let areas = cumulated_areas(&world.mesh.triangles, &sight);
    let mut points = Vec::with_capacity(count);
    let per_round = count.div_ceil(BATCH);
    for round in 0..ROUNDS {
        let batches: Vec<Vec<TruthPoint>> = (round * per_round..(round + 1) * per_round)
            .into_par_iter()
            .map(|batch| {
                let mut rng = Rng::new(seed, 0x10_0000 + batch as u64);
                (0..BATCH).filter_map(|_| try_point(world, &sight, &areas, &mut rng)).collect()
            })
            .collect();
        points.extend(batches.into_iter().flatten());
        if points.len() >= count {
            points.truncate(count);
            break;
        }
    }
    points
}

/// Cumulative sum of the triangles' areas; triangles that too few cameras may see count as 0.
fn cumulated_areas(triangles: &[Triangle], sight: &Sight) -> Vec<f64> {
    let area = |t: &Triangle| {
        let [a, b, c] = t.corners;
        0.5 * f64::from((b - a).cross(c - a).length())
    };
    let areas: Vec<f64> = triangles
        .par_iter()
        .map(|t| if sight.may_be_seen_by(&t.corners, CAMERAS_MIN) { area(t) } else { 0.0 })
        .collect();
    let sum = |sum: &mut f64, area: f64| {
        *sum += area;
        Some(*sum)
    };
    areas.into_iter().scan(0.0, sum).collect()
}

fn try_point(world: &World, sight: &Sight, areas: &[f64], rng: &mut Rng) -> Option<TruthPoint> {
    let pick = rng.unit_f64() * areas.last().filter(|total| **total > 0.0)?;
    let i = areas.partition_point(|&sum| sum <= pick).min(areas.len() - 1);
    let (mut u, mut v) = (rng.unit(), rng.unit());
    if u + v > 1.0 {
        (u, v) = (1.0 - u, 1.0 - v);
    }
    let triangle = &world.mesh.triangles[i];
    let normal = seen_side(sight, triangle, Vec2::new(u, v))?;
    Some(TruthPoint {
        position: position(triangle, Vec2::new(u, v)).to_array(),
        normal: normal.to_array(),
        rgb: light::encode(world.matt_shade(i as u32, [u, v], normal, FOOTPRINT_M)),
    })
}
