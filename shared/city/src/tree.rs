//! Trees, bushes and hedges: trunks under crowns of irregular facets and loose sprays of leaves.

use glam::{Vec2, Vec3};

use super::detail::Detail;
use super::mesh::Mesh;
use super::noise::noise3;
use super::palette::Palette;
use super::random::Rng;
use super::shapes::{Frame, unit_circle};

/// The growth form of a tree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Habit {
    /// A crown of several rounded masses.
    Broad,
    /// Slim and tall.
    Poplar,
    /// Tiers of drooping branches.
    Conifer,
    /// A low mass without a trunk.
    Bush,
}

/// Plants a tree at a frame's origin.
pub(super) fn tree(
    mesh: &mut Mesh,
    frame: &Frame,
    habit: Habit,
    height_m: f32,
    detail: Detail,
    palette: &Palette,
    rng: &mut Rng,
) {
    let frame = frame.turned(unit_circle(rng.unit()));
    match habit {
        Habit::Broad => broad(mesh, &frame, height_m, detail, palette, rng),
        Habit::Poplar => {
            trunk(mesh, &frame, 0.2 * height_m, 0.022 * height_m, palette);
            let leaf = palette.leaves[0];
            let radius = 0.13 * height_m;
            let crown = Crown {
                center: frame.at(0.0, 0.0, 0.56 * height_m),
                radii: Vec3::new(radius, radius, 0.45 * height_m),
                leaf,
            };
            crown.grow(mesh, detail, rng);
        }
        Habit::Conifer => conifer(mesh, &frame, height_m, detail, palette, rng),
        Habit::Bush => {
            let r = 0.6 * height_m;
            let crown = Crown {
                center: frame.at(0.0, 0.0, 0.4 * height_m),
                radii: Vec3::new(r * rng.range(0.8, 1.3), r * rng.range(0.8, 1.3), r),
                leaf: rng.pick(&palette.leaves),
            };
            crown.grow(mesh, detail, rng);
        }
    }
}

fn trunk(mesh: &mut Mesh, frame: &Frame, height_m: f32, radius_m: f32, palette: &Palette) {
    mesh.drum(frame, [radius_m * 1.25, radius_m * 0.75], [-0.3, height_m], 6, [palette.bark; 2]);
}

fn broad(mesh: &mut Mesh, frame: &Frame, height_m: f32, detail: Detail, palette: &Palette, rng: &mut Rng) {
    trunk(mesh, frame, 0.55 * height_m, 0.028 * height_m, palette);
    let leaf = rng.pick(&palette.leaves);
    let spread = height_m * rng.range(0.26, 0.36);
    let masses = if detail == Detail::Fine { 4 + rng.index(4) } else { 3 };
    let around = rng.unit();
    for i in 0..masses {
        let d = unit_circle(around + i as f32 * 0.381_966) * (spread * rng.range(0.35, 0.75));
        let lift = height_m * if i == 0 { 0.72 } else { rng.range(0.45, 0.68) };
        let foot = if i == 0 { Vec2::ZERO } else { d };
        let r = spread * rng.range(0.5, 0.78);
        let crown = Crown {
            center: frame.at(foot.x, foot.y, lift),
            radii: Vec3::new(r * rng.range(0.9, 1.2), r * rng.range(0.9, 1.2), r * rng.range(0.7, 1.0)),
            leaf,
        };
        crown.grow(mesh, detail, rng);
    }
}

/// A mass of leaves around a point.
struct Crown {
    center: Vec3,
    radii: Vec3,
    leaf: u32,
}

impl Crown {
    fn grow(&self, mesh: &mut Mesh, detail: Detail, rng: &mut Rng) {
        self.core(mesh, detail, rng);
        let area = self.radii.x * self.radii.y + 2.0 * self.radii.x * self.radii.z;
        let sprays = match detail {
            Detail::Fine => (15.0 * area).min(190.0),
            Detail::Coarse => (4.0 * area).min(60.0),
        };
        for _ in 0..sprays as usize {
            self.spray(mesh, detail, rng);
        }
    }

    /// Adds the closed, irregular surface of the crown.
    fn core(&self, mesh: &mut Mesh, detail: Detail, rng: &mut Rng) {
        let seed = rng.seed();
        let (points, faces) = if detail == Detail::Fine { sphere() } else { icosahedron() };
        let place = |d: Vec3| {
            let bulge = 0.80 + 0.28 * noise3(d * 2.3, seed) + 0.12 * noise3(d * 6.1, seed ^ 1);
            self.center + d * self.radii * bulge
        };
        for face in faces {
            let corners = face.map(|i| place(points[i]));
            let hue = rng.signed() * 0.5;
            let uvs = face.map(|i| Vec2::new(0.50 + 0.25 * (points[i].z * 0.5 + 0.5), hue));
            mesh.triangle(corners, uvs, self.leaf);
        }
    }

    /// Adds a loose facet near the crown's surface.
    fn spray(&self, mesh: &mut Mesh, detail: Detail, rng: &mut Rng) {
        let d = direction(rng);
        let out = rng.range(0.76, 1.13);
        let center = self.center + d * self.radii * out;
        let normal = (d + direction(rng) * 0.8).normalize_or_zero();
        let along = normal.any_orthonormal_vector();
        let across = normal.cross(along);
        let size = rng.range(0.28, 0.70) * if detail == Detail::Fine { 1.0 } else { 1.5 };
        let turn = unit_circle(rng.unit());
        let corners = [0.0, 0.31, 0.69].map(|phase| {
            let p = unit_circle(phase + rng.range(-0.05, 0.05));
            let p = Vec2::new(p.x * turn.x - p.y * turn.y, p.x * turn.y + p.y * turn.x);
            center + (along * p.x + across * p.y) * (size * rng.range(0.8, 1.3))
        });
        let light = 0.70 + 0.38 * (out - 0.76) / 0.37 + 0.12 * d.z;
        mesh.triangle(corners, [Vec2::new(light, rng.signed()); 3], self.leaf);
    }
}

fn conifer(mesh: &mut Mesh, frame: &Frame, height_m: f32, detail: Detail, palette: &Palette, rng: &mut Rng) {
    trunk(mesh, frame, 0.35 * height_m, 0.02 * height_m, palette);
    let (tiers, points) = if detail == Detail::Fine { (8, 11) } else { (4, 7) };
    let widest = height_m * rng.range(0.19, 0.25);
    for tier in 0..tiers {
        let t = tier as f32 / tiers as f32;
        let radius = widest * (1.0 - t) + 0.25;
        let top = height_m * (0.28 + 0.72 * (t + 1.25 / tiers as f32)).min(1.0);
        let foot = height_m * (0.14 + 0.78 * t);
        let turn = rng.unit();
        let rim: Vec<Vec3> = (0..2 * points)
            .map(|i| {
                let out = if i % 2 == 0 { rng.range(0.85, 1.15) } else { rng.range(0.5, 0.7) };
                let d = unit_circle(turn + i as f32 / (2 * points) as f32) * (radius * out);
                let droop = if i % 2 == 0 { 0.0 } else { 0.06 * height_m / tiers as f32 * 4.0 };
                frame.at(d.x, d.y, foot + droop)
            })
            .collect();
        let peak = frame.at(0.0, 0.0, top);
        for i in 0..rim.len() {
            let hue = rng.signed();
            let uvs = [Vec2::new(0.65, hue), Vec2::new(1.05, hue), Vec2::new(1.05, hue)];
            mesh.triangle([peak, rim[i], rim[(i + 1) % rim.len()]], uvs, palette.conifer);
        }
    }
}

/// Adds an uneven hedge between two points on the ground.
pub(super) fn hedge(mesh: &mut Mesh, from: Vec3, to: Vec3, height_m: f32, palette: &Palette, rng: &mut Rng) {
    let pieces = ((to - from).length() / 1.3).max(1.0) as usize;
    let across = (to - from).truncate().perp().normalize_or_zero().extend(0.0);
    let mut ring = |i: usize| {
        let foot = from + (to - from) * (i as f32 / pieces as f32);
        let half = 0.45 * rng.range(0.8, 1.25);
        let top = height_m * rng.range(0.82, 1.12);
        [
            foot - across * half - Vec3::Z * 0.2,
            foot - across * (0.85 * half) + Vec3::Z * (0.9 * top),
            foot + across * (0.1 * half) + Vec3::Z * top,
            foot + across * (0.85 * half) + Vec3::Z * (0.88 * top),
            foot + across * half - Vec3::Z * 0.2,
        ]
    };
    let rings: Vec<[Vec3; 5]> = (0..=pieces).map(&mut ring).collect();
    for pair in rings.windows(2) {
        for side in 0..4 {
            let light = |i: usize| Vec2::new([0.55, 0.95, 1.0, 0.95, 0.55][i], 0.3);
            mesh.quad(
                [pair[0][side], pair[1][side], pair[1][side + 1], pair[0][side + 1]],
                [light(side), light(side), light(side + 1), light(side + 1)],
                palette.hedge,
            );
        }
    }
    for (ring, flip) in [(rings[0], 1.0), (rings[pieces], -1.0)] {
        for i in 1..4 {
            mesh.triangle([ring[0], ring[i], ring[i + 1]], [Vec2::new(0.8, 0.2 * flip); 3], palette.hedge);
        }
    }
}

/// A random unit vector, uniform over directions.
fn direction(rng: &mut Rng) -> Vec3 {
    loop {
        let p = Vec3::new(rng.signed(), rng.signed(), rng.signed());
        let squared = p.length_squared();
        if squared > 0.01 && squared <= 1.0 {
            return p.normalize();
        }
    }
}

/// The golden ratio.
const GOLDEN: f32 = 1.618_034;

const ICOSAHEDRON_FACES: [[usize; 3]; 20] = [
    [0, 11, 5],
    [0, 5, 1],
    [0, 1, 7],
    [0, 7, 10],
    [0, 10, 11],
    [1, 5, 9],
    [5, 11, 4],
    [11, 10, 2],
    [10, 7, 6],
    [7, 1, 8],
    [3, 9, 4],
    [3, 4, 2],
    [3, 2, 6],
    [3, 6, 8],
    [3, 8, 9],
    [4, 9, 5],
    [2, 4, 11],
    [6, 2, 10],
    [8, 6, 7],
    [9, 8, 1],
];

/// Unit directions and faces of an icosahedron.
fn icosahedron() -> (Vec<Vec3>, Vec<[usize; 3]>) {
    let g = GOLDEN;
    let points = [
        (-1.0, g, 0.0),
        (1.0, g, 0.0),
        (-1.0, -g, 0.0),
        (1.0, -g, 0.0),
        (0.0, -1.0, g),
        (0.0, 1.0, g),
        (0.0, -1.0, -g),
        (0.0, 1.0, -g),
        (g, 0.0, -1.0),
        (g, 0.0, 1.0),
        (-g, 0.0, -1.0),
        (-g, 0.0, 1.0),
    ];
    (points.map(|(x, y, z)| Vec3::new(x, y, z).normalize()).to_vec(), ICOSAHEDRON_FACES.to_vec())
}

/// Unit directions and faces of an icosahedron with each face divided into four: 80 faces.
fn sphere() -> (Vec<Vec3>, Vec<[usize; 3]>) {
    let (mut points, faces) = icosahedron();
    let mut finer = Vec::with_capacity(4 * faces.len());
    for [a, b, c] in faces {
        let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(i, j)| {
            // Both faces at an edge get the same bits, since addition commutes.
            let middle = (points[i] + points[j]).normalize();
            points.iter().position(|&p| p == middle).unwrap_or_else(|| {
                points.push(middle);
                points.len() - 1
            })
        });
        finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    (points, finer)
}
