//! Reference results for the tests: rays and distances by brute force, in double precision, without any
//! code under test.

use glam::DVec3;

/// The first hit of a ray on any of the triangles: depth, and the unit normal that faces the ray's start.
pub(super) fn brute_force(triangles: &[[DVec3; 3]], origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
    let mut nearest: Option<(f64, DVec3)> = None;
    for [a, b, c] in triangles {
        let normal = (*b - *a).cross(*c - *a);
        let t = normal.dot(*a - origin) / normal.dot(direction);
        let p = origin + direction * t;
        // The point is inside if it is on the same side of all three edges.
        let side = |from: DVec3, to: DVec3| (to - from).cross(p - from).dot(normal) >= 0.0;
        let inside = side(*a, *b) && side(*b, *c) && side(*c, *a);
        if inside && t > 0.0 && nearest.is_none_or(|(best, _)| t < best) {
            nearest = Some((t, -normal.normalize() * normal.dot(direction).signum()));
        }
    }
    nearest
}

/// Distance of a point from a triangle: from its plane if the point projects inside, else from the nearest edge.
fn distance(p: DVec3, [a, b, c]: &[DVec3; 3]) -> f64 {
    let normal = (*b - *a).cross(*c - *a);
    let inside = |from: DVec3, to: DVec3| (to - from).cross(p - from).dot(normal) >= 0.0;
    if inside(*a, *b) && inside(*b, *c) && inside(*c, *a) {
        return (p - *a).dot(normal).abs() / normal.length();
    }
    let edge = |from: DVec3, to: DVec3| {
        let along = to - from;
        let t = (p - from).dot(along) / along.length_squared().max(1e-12);
        p.distance(from + along * t.clamp(0.0, 1.0))
    };
    edge(*a, *b).min(edge(*b, *c)).min(edge(*c, *a))
}

/// Distance of a point from the nearest triangle.
pub(super) fn distance_to_surface(triangles: &[[DVec3; 3]], p: DVec3) -> f64 {
    triangles.iter().map(|t| distance(p, t)).fold(f64::INFINITY, f64::min)
}
