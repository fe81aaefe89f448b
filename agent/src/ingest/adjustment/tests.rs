//! A flight of 20 photographs that look straight down, and what an adjustment makes of it.

#![allow(clippy::unwrap_used)]

use cosurf_geo::{ControlPoint, Geodetic, SiteFrame};
use cosurf_scene::Pose;
use glam::DQuat;

use super::super::lens::Lens;
use super::super::photographs::Photographs;
use super::super::placing::Places;
use super::super::reconstruction::{Posed, TieMark, TiePoint};
use super::super::settling::settle;
use super::*;

/// What no photograph knows: the true lens.
const LENS: Lens = Lens {
    size_px: [800, 600],
    focal_px: DVec2::splat(690.0),
    center_px: DVec2::new(410.0, 292.0),
    distortion: [-0.06, 0.012, 0.0, 0.0],
};
/// Ground of a pixel, metres.
const PIXEL_M: f64 = 60.0 / 690.0;

/// Errors that look random, of about this size.
fn noise(dice: &mut fastrand::Rng, size: f64) -> f64 {
    (dice.f64() + dice.f64() + dice.f64() + dice.f64() - 2.0) * 3_f64.sqrt() * size
}

/// Ground that is almost flat: its photographs hardly tell a bowl from a lens.
fn ground(x: f64, y: f64) -> DVec3 {
    DVec3::new(x, y, 0.1 * (x / 17.0).sin() + 0.1 * (y / 11.0).cos())
}

fn station(i: usize) -> Station {
    let (line, along) = (i / 5, i % 5);
    let center = DVec3::new(along as f64 * 15.0 - 30.0, line as f64 * 20.0 - 30.0, 60.0);
    let heading =
        DQuat::from_rotation_z(if line % 2 == 0 { 0.0 } else { std::f64::consts::PI } + 0.02 * along as f64);
    let sway = DQuat::from_rotation_y(0.004 * (i % 4) as f64 - 0.006);
    // A half turn about x looks down.
    Station { rotation: sway * DQuat::from_rotation_x(std::f64::consts::PI) * heading, center }
}

/// The true block, with marks that are a third of a pixel off.
fn truth() -> Reconstruction {
    let mut dice = fastrand::Rng::with_seed(7);
    let posed = |i: usize| {
        let Station { rotation, center } = station(i);
        let cam_from_world = Pose { rotation, translation: -(rotation * center) };
        Posed { name: format!("{i:02}.jpg"), cam_from_world, lens: 0 }
    };
    let mut its = Reconstruction {
        posed: (0..20).map(posed).collect(),
        lenses: vec![LENS],
        points: Vec::new(),
        marks: Vec::new(),
    };
    for _ in 0..700 {
        let at = ground(90.0 * dice.f64() - 45.0, 90.0 * dice.f64() - 45.0);
        if seen(at).len() < 4 {
            continue;
        }
        let point = its.points.len() as u32;
        let seen = seen(at).into_iter().map(|(photograph, at_px)| TieMark {
            point,
            photograph: photograph as u32,
            at_px: at_px + DVec2::new(noise(&mut dice, 0.3), noise(&mut dice, 0.3)),
        });
        its.marks.extend(seen);
        its.points.push(TiePoint { position: at, rgb: [0; 3] });
    }
    its
}

/// The photographs that show a point, and where.
fn seen(at: DVec3) -> Vec<(usize, DVec2)> {
    let shown = (0..20).filter_map(|i| Some((i, project(&station(i), &LENS, at)?)));
    shown.filter(|(_, px)| px.cmpge(DVec2::ZERO).all() && px.cmple(DVec2::new(800.0, 600.0)).all()).collect()
}

/// What a program makes of the block that does not know where the principal point is, and bends it.
fn bent() -> Reconstruction {
    let mut its = truth();
    its.lenses[0] = Lens { center_px: DVec2::new(400.0, 300.0), distortion: [-0.05, 0.0, 0.0, 0.0], ..LENS };
    let bowl = |at: DVec3| at + DVec3::Z * (at.truncate().length_squared() / 800.0 - 1.0);
    for point in &mut its.points {
        point.position = bowl(point.position);
    }
    for posed in &mut its.posed {
        posed.cam_from_world.translation =
            -(posed.cam_from_world.rotation * bowl(posed.cam_from_world.center()));
    }
    its
}

/// Control points in the corners and in the middle.
fn control(weight: f64) -> Vec<KnownPoint> {
    let places = [[-35.0, -33.0], [33.0, -35.0], [34.0, 33.0], [-33.0, 35.0], [1.0, 2.0]];
    let known = |[x, y]: [f64; 2]| {
        let at_m = ground(x, y);
        KnownPoint { seen_m: at_m, at_m, weight: DVec3::splat(weight), marks: seen(at_m) }
    };
    places.map(known).into()
}

/// The errors of height of the points: root mean square, about their mean if `is_free`.
fn height_rms_m(its: &Reconstruction, is_free: bool) -> f64 {
    let truth = truth();
    let off = || its.points.iter().zip(&truth.points).map(|(is, was)| is.position.z - was.position.z);
    let count = its.points.len() as f64;
    let mean = if is_free { off().sum::<f64>() / count } else { 0.0 };
    (off().map(|off| (off - mean).powi(2)).sum::<f64>() / count).sqrt()
}

#[test]
fn control_points_straighten_a_bowl_that_photographs_do_not_tell() {
    let before = bent();
    assert!(height_rms_m(&before, true) > 0.5, "{}", height_rms_m(&before, true));
    let mut without = before.clone();
    adjust(&mut without, &[], &[]).unwrap();
    let mut with = before.clone();
    adjust(&mut with, &[], &control(0.02_f64.powi(-2))).unwrap();
    let [without_m, with_m] = [height_rms_m(&without, true), height_rms_m(&with, false)];
    assert!(with_m < PIXEL_M, "{with_m} m");
    assert!(without_m > 2.0 * with_m, "photographs alone do not tell: {without_m} m, {with_m} m");
    let lens = with.lenses[0];
    // Where all is level, a tilt of all cameras makes good a wrong principal point.
    assert!((lens.focal_px - LENS.focal_px).length() < 3.0, "{lens:?}");
    // The same input gives the same bits.
    let mut again = before;
    adjust(&mut again, &[], &control(0.02_f64.powi(-2))).unwrap();
    assert_eq!(again, with);
}

#[test]
fn a_control_point_without_weight_bends_nothing() {
    let mut points = control(0.02_f64.powi(-2));
    points[0].at_m.z += 2.0;
    points[0].weight = DVec3::splat(1e-3);
    let mut its = bent();
    adjust(&mut its, &[], &points).unwrap();
    assert!(height_rms_m(&its, false) < 1.5 * PIXEL_M, "{}", height_rms_m(&its, false));
}

#[test]
fn a_control_point_two_metres_off_is_told_and_bends_nothing() {
    let origin = Geodetic { latitude_deg: 53.0, longitude_deg: 16.0, height_m: 60.0 };
    let site = SiteFrame::new(origin).unwrap();
    let point = |(i, its): (usize, KnownPoint)| ControlPoint {
        name: i.to_string(),
        place: site.geodetic_from_enu(its.at_m + DVec3::X * if i == 2 { 2.0 } else { 0.0 }),
        marks: its
            .marks
            .into_iter()
            .map(|(photograph, at_px)| cosurf_geo::Mark { photograph: format!("{photograph:02}.jpg"), at_px })
            .collect(),
    };
    let photographs = Photographs {
        folder: "photographs".into(),
        usable: Vec::new(),
        left_out: Vec::new(),
        notes: Vec::new(),
        control: control(1.0).into_iter().enumerate().map(point).collect(),
    };
    let places = Places::of(&photographs, Some(origin)).unwrap();
    let mut its = bent();
    let placed = settle(&mut its, places.as_ref(), &mut |_| ()).unwrap();
    let told: Vec<&str> = placed.left_out.iter().map(|(name, _)| &**name).collect();
    assert_eq!(told, ["control point 2"], "{:?}", placed.left_out);
    assert!(placed.left_out[0].1.starts_with("is 2.0 m"), "{:?}", placed.left_out);
    assert!(height_rms_m(&its, false) < 1.5 * PIXEL_M, "{}", height_rms_m(&its, false));
}

#[test]
fn wrong_marks_do_not_count() {
    let mut its = bent();
    for mark in its.marks.iter_mut().step_by(50) {
        mark.at_px += DVec2::new(60.0, -40.0);
    }
    let mut points = control(0.02_f64.powi(-2));
    points[4].marks[0].1.x += 90.0;
    // The first time, the bent block hides which marks are wrong.
    adjust(&mut its, &[], &points).unwrap();
    adjust(&mut its, &[], &points).unwrap();
    // The points of wrong marks themselves are off.
    let mut off_m: Vec<f64> =
        its.points.iter().zip(&truth().points).map(|(a, b)| (a.position - b.position).length()).collect();
    off_m.sort_by(f64::total_cmp);
    assert!(off_m[off_m.len() / 2] < PIXEL_M, "{}", off_m[off_m.len() / 2]);
}

#[test]
fn places_of_photographs_count_by_their_weight() {
    let mut its = truth();
    let known: Vec<KnownCenter> = (0..20)
        .map(|i| KnownCenter {
            photograph: i,
            at_m: station(i).center + DVec3::new(0.0, 0.0, 3.0),
            weight: DVec3::splat(if i == 3 { 0.0 } else { 100.0 }),
        })
        .collect();
    adjust(&mut its, &known, &[]).unwrap();
    for (i, posed) in its.posed.iter().enumerate() {
        let off = posed.cam_from_world.center() - known[i].at_m;
        assert!(off.length() < 0.15, "{i}: {off}");
    }
}

#[test]
fn photographs_that_share_nothing_stay_where_they_are() {
    let mut its = truth();
    its.marks.clear();
    let before = its.clone();
    adjust(&mut its, &[], &[]).unwrap();
    assert_eq!(its, before);
}
