#![allow(clippy::unwrap_used)]
use glam::DVec3;

use super::*;

/// f, cx, cy, b1, b2, k1 to k4 and p1 to p4 of Metashape; the exaggerated lens of a drone of 400 × 300 pixels.
const CAMERA: [f64; 13] = [330.0, 6.0, -4.0, 2.5, -1.8, -0.11, 0.03, -0.02, 0.03, 0.004, -0.006, 0.3, -0.2];
const SIZE_PX: [u32; 2] = [400, 300];

/// Where Metashape's *frame* camera shows a point (X, Y, Z): the formulas of its manual word for word.
fn manual(camera: [f64; 13], point: DVec3) -> DVec2 {
    let [f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4] = camera;
    let (x, y) = (point.x / point.z, point.y / point.z);
    let r = (x.powi(2) + y.powi(2)).sqrt();
    let radial = 1.0 + k1 * r.powi(2) + k2 * r.powi(4) + k3 * r.powi(6) + k4 * r.powi(8);
    let growth = 1.0 + p3 * r.powi(2) + p4 * r.powi(4);
    let bent_x = x * radial + (p1 * (r.powi(2) + 2.0 * x.powi(2)) + 2.0 * p2 * x * y) * growth;
    let bent_y = y * radial + (p2 * (r.powi(2) + 2.0 * y.powi(2)) + 2.0 * p1 * x * y) * growth;
    let [w, h] = SIZE_PX.map(f64::from);
    DVec2::new(w * 0.5 + cx + bent_x * f + bent_x * b1 + bent_y * b2, h * 0.5 + cy + bent_y * f)
}

fn lens(camera: [f64; 13]) -> Lens {
    let [f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4] = camera;
    let full =
        FullBrown { radial: [k1, k2, k3, k4], tangential: [p2, p1], growth: [p3, p4], skew: b2 / (f + b1) };
    let center_px = 0.5 * DVec2::from(SIZE_PX.map(f64::from)) + DVec2::new(cx, cy);
    Lens {
        focal_px: DVec2::new(f + b1, f),
        center_px,
        size_px: SIZE_PX,
        distortion: Distortion::FullBrown(full),
    }
}

fn brown(lens: &Lens) -> FullBrown {
    match lens.distortion {
        Distortion::FullBrown(brown) => brown,
        other => panic!("{other:?}"),
    }
}

/// Directions over the whole picture.
fn rays() -> impl Iterator<Item = DVec2> {
    (0..13).flat_map(|i| (0..11).map(move |j| DVec2::new(0.1 * f64::from(i - 6), 0.08 * f64::from(j - 5))))
}

fn largest_px(differs: impl Fn(DVec2) -> f64) -> f64 {
    rays().map(differs).fold(0.0, f64::max)
}

#[test]
fn directions_are_shown_where_the_manual_says() {
    let ours = lens(CAMERA);
    let shown = |ray: DVec2| brown(&ours).distort(ray).0 * ours.focal_px + ours.center_px;
    let off_px = |camera| largest_px(|ray| shown(ray).distance(manual(camera, 7.0 * ray.extend(1.0))));
    assert!(off_px(CAMERA) < 1e-9, "{} px", off_px(CAMERA));
    // Each term counts: a model without it, or with its two kinds mixed up, is another one.
    for term in [3, 4, 8, 9, 10, 11, 12] {
        let mut without = CAMERA;
        without[term] = 0.0;
        assert!(off_px(without) > 0.05, "term {term}: {} px", off_px(without));
    }
    let mut swapped = CAMERA;
    swapped.swap(9, 10);
    assert!(off_px(swapped) > 1.0, "{} px", off_px(swapped));
}

/// Where OpenCV shows a direction: its documentation's formulas (`calib3d`, *Detailed Description*), with a fourth radial
/// term.
fn opencv([k1, k2, k3, k4]: [f64; 4], [p1, p2]: [f64; 2], x: f64, y: f64) -> DVec2 {
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3) + k4 * r2.powi(4);
    DVec2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )
}

#[test]
fn directions_are_shown_where_opencv_says() {
    let (radial, tangential) = ([-0.11, 0.03, -0.02, 0.03], [0.004, -0.006]);
    let full = FullBrown { radial, tangential, ..FullBrown::default() };
    let off = |radial, tangential| {
        rays()
            .map(|ray| full.distort(ray).0.distance(opencv(radial, tangential, ray.x, ray.y)))
            .fold(0.0, f64::max)
    };
    assert!(off(radial, tangential) < 1e-15);
    assert!(off([-0.11, 0.03, -0.02, 0.0], tangential) > 1e-4 && off(radial, [-0.006, 0.004]) > 1e-3);
}

#[test]
fn slopes_are_those_of_finite_differences() {
    const STEP: f64 = 1e-6;
    let brown = brown(&lens(CAMERA));
    for ray in rays() {
        let slope = brown.distort(ray).1;
        for (axis, column) in [(DVec2::X, slope.x_axis), (DVec2::Y, slope.y_axis)] {
            let at = |step: f64| brown.distort(ray + axis * step).0;
            let wanted = (at(STEP) - at(-STEP)) / (2.0 * STEP);
            assert!(column.distance(wanted) < 1e-8, "{ray}: {column} {wanted}");
        }
    }
}

/// The direction that the manual's camera shows at a position, by halving a grid about the best direction.
fn sought(camera: [f64; 13], at_px: DVec2) -> DVec2 {
    let (mut best, mut step) = (DVec2::ZERO, 0.5);
    while step > 1e-11 {
        let around = (-2..=2).flat_map(|i| (-2..=2).map(move |j| DVec2::new(f64::from(i), f64::from(j))));
        let off_px = |ray: &DVec2| manual(camera, ray.extend(1.0)).distance(at_px);
        best = around.map(|by| best + by * step).min_by(|a, b| off_px(a).total_cmp(&off_px(b))).unwrap();
        step *= 0.6;
    }
    best
}

#[test]
fn positions_show_the_directions_that_a_search_finds() {
    let ours = lens(CAMERA);
    for at_px in [[0.0, 0.0], [400.0, 0.0], [0.0, 300.0], [400.0, 300.0], [206.0, 146.0], [33.0, 250.0]] {
        let at_px = DVec2::from(at_px);
        let ray = brown(&ours).ray((at_px - ours.center_px) / ours.focal_px).unwrap();
        let wanted = sought(CAMERA, at_px);
        assert!(ray.distance(wanted) < 1e-8, "{at_px}: {ray} {wanted}");
    }
    let corner = sought(CAMERA, DVec2::ZERO);
    let mut without = CAMERA;
    without[8] = 0.0;
    assert!(corner.distance(sought(without, DVec2::ZERO)) > 1e-4, "k4 counts in the corners");
}

/// A black picture with a white disc at each position.
fn picture(discs: &[DVec2]) -> Picture {
    let pixel = |i: u32| {
        let center = DVec2::new(f64::from(i % SIZE_PX[0]) + 0.5, f64::from(i / SIZE_PX[0]) + 0.5);
        let distance = discs.iter().map(|disc| disc.distance(center)).fold(f64::INFINITY, f64::min);
        [((4.5 - distance).clamp(0.0, 1.0) * 255.0) as u8; 3]
    };
    Picture::new(SIZE_PX, (0..SIZE_PX[0] * SIZE_PX[1]).flat_map(pixel).collect())
}

/// The middle of the light within 9 pixels of a position.
fn middle_of_light(picture: &Picture, near: DVec2) -> DVec2 {
    let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
    for (i, rgb) in picture.rgb.chunks_exact(3).enumerate() {
        let width = picture.size_px[0] as usize;
        let at = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        if at.distance(near) < 9.0 {
            sum += at * f64::from(rgb[0]);
            weight += f64::from(rgb[0]);
        }
    }
    sum / weight
}

/// The largest error of a disc, pixels, and the number of discs, in a picture that the manual's camera took and that the
/// lens of another camera straightened.
fn straightened(taken: [f64; 13], by: [f64; 13]) -> (f64, usize) {
    let rays: Vec<DVec2> = rays().filter(|ray| ((ray.x * 10.0).round() as i64) % 2 == 0).collect();
    let discs: Vec<DVec2> = rays.iter().map(|ray| manual(taken, ray.extend(1.0))).collect();
    let lens = lens(by);
    let pinhole = lens.straight().unwrap();
    let straight = lens.straightened(&picture(&discs), &pinhole);
    assert_eq!(straight.size_px, pinhole.size_px);
    let at_px = rays.iter().map(|ray| *ray * pinhole.focal_px + pinhole.center_px);
    let limit = DVec2::from(pinhole.size_px.map(f64::from)) - 9.0;
    let inside = at_px.filter(|at| at.min_element() > 9.0 && at.x < limit.x && at.y < limit.y);
    let off: Vec<f64> = inside.map(|at| middle_of_light(&straight, at).distance(at)).collect();
    (off.iter().copied().fold(0.0, f64::max), off.len())
}

#[test]
fn straightened_pictures_show_points_where_a_pinhole_shows_them() {
    let (off_px, count) = straightened(CAMERA, CAMERA);
    assert!(off_px < 0.1 && count > 40, "{off_px} px of {count} discs");
    let mut mirrored = CAMERA;
    mirrored[9] = -CAMERA[9];
    mirrored[10] = -CAMERA[10];
    let (off_px, _) = straightened(CAMERA, mirrored);
    assert!(off_px > 1.0, "{off_px} px");
}

#[test]
fn the_pinhole_shows_nothing_beyond_the_picture_and_most_of_it() {
    for turn in [1.0, -1.0] {
        let camera = std::array::from_fn(|i| if i > 3 { turn * CAMERA[i] } else { CAMERA[i] });
        let lens = lens(camera);
        let pinhole = lens.straight().unwrap();
        assert_eq!((pinhole.focal_px, pinhole.distortion), (lens.focal_px, Distortion::NONE));
        let [width, height] = pinhole.size_px.map(f64::from);
        let mut room_px = [f64::INFINITY; 4];
        for share in shares() {
            for (x, y) in [(0.0, share), (1.0, share), (share, 0.0), (share, 1.0)] {
                let at = lens.shown(&brown(&lens), &pinhole, DVec2::new(x * width, y * height));
                let room = [at.x, 400.0 - at.x, at.y, 300.0 - at.y];
                assert!(room.iter().all(|room| *room > -0.05), "{at} of {width} × {height}");
                room_px = std::array::from_fn(|i| room_px[i].min(room[i]));
            }
        }
        assert!(room_px.iter().all(|room| *room < 1.5), "a border further in would do: {room_px:?}");
    }
}

#[test]
fn models_that_fold_or_leave_nothing_are_refused() {
    let refusal = |term: usize, value: f64| {
        let mut camera = CAMERA;
        camera[term] = value;
        match lens(camera).straight().unwrap_err() {
            Refusal::Content(reason) => reason,
            Refusal::Io(error) => error.to_string(),
        }
    };
    for (term, value) in [(5, -3.0), (8, -20.0), (8, 1e30), (9, 5.0), (11, 1e6), (12, -1e300), (4, 1e12)] {
        let reason = refusal(term, value);
        assert!(reason.contains("folds") || reason.contains("leaves no"), "{term} {value}: {reason}");
    }
    // A principal point far outside is no reason.
    let mut far = CAMERA;
    far[1] = 30.0;
    assert!(lens(far).straight().is_ok());
}
