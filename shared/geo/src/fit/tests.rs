#![allow(clippy::unwrap_used)]
use glam::{DQuat, DVec3};

use super::*;

const TRUTH: Similarity = Similarity {
    scale: 11.3,
    rotation: DQuat::from_xyzw(0.1, 0.7, -0.1, 0.7),
    translation: DVec3::new(12.0, -40.0, 300.0),
};

fn truth() -> Similarity {
    Similarity { rotation: TRUTH.rotation.normalize(), ..TRUTH }
}

/// A place in a flight of lines 150 m long, with these errors.
fn sighting(i: usize, error_m: DVec3) -> Sighting {
    let (line, along) = (i / 10, i % 10);
    let enu_m = DVec3::new(along as f64 * 15.0, line as f64 * 20.0, 45.0 + (i % 3) as f64);
    let truth = truth();
    let model = truth.rotation.inverse() * (enu_m - truth.translation) / truth.scale;
    Sighting { model, enu_m: enu_m + error_m, has_height: true, sigma_m: [0.02; 2], is_told: false }
}

fn up(off_deg: f64, sigma_deg: f64) -> Up {
    let direction = truth().rotation.inverse() * (DQuat::from_rotation_x(off_deg.to_radians()) * DVec3::Z);
    Up { direction, sigma_rad: sigma_deg.to_radians() }
}

fn tilt_deg(fit: &Fit) -> f64 {
    let z = fit.similarity.rotation * (truth().rotation.inverse() * DVec3::Z);
    z.angle_between(DVec3::Z).to_degrees()
}

/// Errors that look random, of about this size.
fn noise(i: usize, size_m: f64) -> DVec3 {
    let mut dice = fastrand::Rng::with_seed(i as u64);
    DVec3::from([(); 3].map(|()| (dice.f64() + dice.f64() + dice.f64() - 1.5) * 2.0 * size_m))
}

#[test]
fn exact_places_give_the_exact_similarity_whatever_up_says() {
    let gps: Vec<_> = (0..40).map(|i| sighting(i, DVec3::ZERO)).collect();
    let fit = fit(&gps, &[], &up(3.0, 2.0)).unwrap();
    assert!(tilt_deg(&fit) < 0.2, "{}", tilt_deg(&fit));
    let worst = gps.iter().map(|place| place.residual(&fit.similarity).length()).fold(0.0, f64::max);
    assert!(worst < 0.2, "{worst} m");
    assert!(fit.gps.iter().all(|its| its.agrees));
    assert!((fit.similarity.scale / TRUTH.scale - 1.0).abs() < 0.001);
}

#[test]
fn one_photograph_ten_kilometres_off_changes_nothing() {
    let mut gps: Vec<_> = (0..40).map(|i| sighting(i, noise(i, 3.0))).collect();
    let without = fit(&gps[1..], &[], &up(1.0, 2.0)).unwrap();
    gps[0].enu_m += DVec3::new(10_000.0, 0.0, 0.0);
    let with = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
    assert_eq!(with.gps.iter().filter(|its| !its.agrees).count(), 1);
    assert!(!with.gps[0].agrees && with.gps[0].weight.length() < 1e-6 * with.gps[1].weight.length());
    let place = sighting(20, DVec3::ZERO).model;
    assert!(with.similarity.apply(place).distance(without.similarity.apply(place)) < 0.5);
    assert_eq!(with.residuals.unwrap().photographs, 40);
    assert!((2.0..8.0).contains(&with.residuals.unwrap().horizontal_rms_m), "{:?}", with.residuals);
}

#[test]
fn drifting_heights_do_not_tilt_the_ground() {
    // From the first line to the last, the heights of GPS climb by 30 m within 60 m: a tilt of 27 degrees.
    let drift = |i: usize| DVec3::new(0.0, 0.0, i as f64 * 0.75) + noise(i, 3.0);
    let gps: Vec<_> = (0..40).map(|i| sighting(i, drift(i))).collect();
    let fit = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
    assert!(tilt_deg(&fit) < 6.0, "{}", tilt_deg(&fit));
    assert!(fit.residuals.unwrap().vertical_rms_m > 5.0, "{:?}", fit.residuals);
    assert!((0.5..6.0).contains(&fit.uncertainty.tilt_deg), "{:?}", fit.uncertainty);
}

#[test]
fn a_flight_that_is_thirty_metres_too_high_is_as_level_as_another() {
    let gps: Vec<_> =
        (0..40).map(|i| sighting(i, noise(i, 3.0) + DVec3::Z * if i < 12 { 30.0 } else { 0.0 })).collect();
    let fit = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
    assert!(tilt_deg(&fit) < 4.0, "{}", tilt_deg(&fit));
}

#[test]
fn control_points_outweigh_gps() {
    let gps: Vec<_> = (0..40).map(|i| sighting(i, DVec3::new(7.0, -4.0, 25.0) + noise(i, 3.0))).collect();
    let control: Vec<_> =
        [0, 9, 30, 39].map(|i| Sighting { sigma_m: [0.05; 2], ..sighting(i, noise(i, 0.02)) }).to_vec();
    let fit = fit(&gps, &control, &up(3.0, 2.0)).unwrap();
    let off = fit.similarity.apply(sighting(20, DVec3::ZERO).model).distance(sighting(20, DVec3::ZERO).enu_m);
    assert!(off < 0.2, "{off} m");
    assert!(fit.uncertainty.horizontal_m < 0.2, "{:?}", fit.uncertainty);
    let horizontal_m = fit.residuals.unwrap().horizontal_rms_m;
    assert!((7.0..13.0).contains(&horizontal_m), "GPS is 8 m off: {horizontal_m}");
}

#[test]
fn one_of_four_control_points_that_is_wrong_is_told() {
    let gps: Vec<_> = (0..40).map(|i| sighting(i, noise(i, 3.0))).collect();
    let control = |count: usize| {
        let mut control: Vec<_> = [0, 9, 30, 39, 20][..count]
            .iter()
            .map(|i| Sighting { sigma_m: [0.05; 2], ..sighting(*i, noise(*i, 0.02)) })
            .collect();
        control[1].enu_m.x += 2.0;
        control
    };
    let five = fit(&gps, &control(5), &up(1.0, 2.0)).unwrap();
    assert_eq!(
        five.control.iter().map(|its| its.agrees).collect::<Vec<_>>(),
        [true, false, true, true, true]
    );
    assert!(five.control[1].weight.x < 1e-3 * five.control[0].weight.x, "{:?}", five.control);
    let three = fit(&gps, &control(3), &up(1.0, 2.0)).unwrap();
    assert!(three.control.iter().all(|its| its.agrees), "nobody can tell which one is wrong");
}

#[test]
fn places_without_heights_are_enough_for_the_plane() {
    let gps: Vec<_> =
        (0..10).map(|i| Sighting { has_height: false, ..sighting(i * 4, noise(i, 1.0)) }).collect();
    let fit = fit(&gps, &[], &up(0.0, 2.0)).unwrap();
    assert!((fit.similarity.scale / TRUTH.scale - 1.0).abs() < 0.05);
    assert!(fit.uncertainty.vertical_m > 100.0);
}

#[test]
fn too_little_is_refused() {
    let gps: Vec<_> = (0..2).map(|i| sighting(i, DVec3::ZERO)).collect();
    assert!(fit(&gps, &[], &up(0.0, 2.0)).unwrap_err().to_string().contains("fewer than 3"));
    let same = [sighting(1, DVec3::ZERO); 5];
    assert!(fit(&same, &[], &up(0.0, 2.0)).unwrap_err().to_string().contains("same place"));
}

#[test]
fn a_mirrored_square_is_refused() {
    let corner = |x: f64, y: f64| {
        let model = truth().rotation.inverse() * DVec3::new(x, y, 0.0);
        Sighting {
            model,
            enu_m: DVec3::new(-x, y, 0.0),
            has_height: true,
            sigma_m: [0.02; 2],
            is_told: false,
        }
    };
    let square = [corner(-50.0, -50.0), corner(-50.0, 50.0), corner(50.0, 50.0), corner(50.0, -50.0)];
    let error = fit(&square, &[], &up(0.0, 2.0)).unwrap_err().to_string();
    assert!(error.contains("contradict"), "{error}");
}

/// A place that tells this accuracy.
fn told(i: usize, sigma_m: f64, error_m: DVec3) -> Sighting {
    Sighting { sigma_m: [sigma_m, 2.0 * sigma_m], is_told: true, ..sighting(i, error_m) }
}

/// How far the middle of the flight is from where it is, metres.
fn off_m(fit: &Fit) -> f64 {
    let middle = sighting(20, DVec3::ZERO);
    fit.similarity.apply(middle.model).distance(middle.enu_m)
}

#[test]
fn places_with_a_fixed_solution_outweigh_the_others() {
    // Three of four are off by the same 3 m, as GPS is within a flight; the fixed ones are off by 2 cm.
    let wrong = DVec3::new(2.5, -1.5, 4.0);
    let is_fixed = |i: usize| i.is_multiple_of(4);
    let place = |i: usize| match is_fixed(i) {
        true => told(i, 0.02, noise(i, 0.02)),
        false => sighting(i, wrong + noise(i, 1.0)),
    };
    let gps: Vec<_> = (0..40).map(place).collect();
    let with = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
    assert!(off_m(&with) < 0.1, "{} m", off_m(&with));
    assert_eq!(with.residuals.unwrap().with_accuracy, 10);
    assert!(
        (0..40).all(|i| (with.gps[i].weight.x > 100.0 * with.gps[1].weight.x) == is_fixed(i)),
        "{with:?}"
    );
    // Without what they tell, the crowd wins.
    let untold: Vec<_> =
        gps.iter().map(|its| Sighting { sigma_m: [0.02; 2], is_told: false, ..*its }).collect();
    let without = fit(&untold, &[], &up(1.0, 2.0)).unwrap();
    assert!(off_m(&without) > 2.0, "{} m", off_m(&without));
    // Where the others tell how bad they are, it is the same.
    let bad = |i: usize| {
        if is_fixed(i) { gps[i] } else { told(i, 2.0, gps[i].enu_m - sighting(i, DVec3::ZERO).enu_m) }
    };
    let bad = fit(&(0..40).map(bad).collect::<Vec<_>>(), &[], &up(1.0, 2.0)).unwrap();
    assert!(off_m(&bad) < 0.1, "{} m", off_m(&bad));
}

#[test]
fn receivers_that_praise_themselves_are_not_believed() {
    // All say 1 cm and are off by 3 m: they count as if they had told nothing.
    let gps: Vec<_> = (0..40).map(|i| told(i, 0.01, noise(i, 3.0))).collect();
    let praised = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
    let untold: Vec<_> = gps.iter().map(|its| Sighting { is_told: false, ..*its }).collect();
    let plain = fit(&untold, &[], &up(1.0, 2.0)).unwrap();
    assert!(
        (praised.gps[20].weight / plain.gps[20].weight - 1.0).abs().max_element() < 0.2,
        "{:?}",
        praised.gps[20]
    );
    assert!((praised.uncertainty.horizontal_m / plain.uncertainty.horizontal_m - 1.0).abs() < 0.2);
    // Three are too few to judge: they must not bend the fit to themselves.
    let few: Vec<_> = (0..40)
        .map(|i| if i < 3 { told(i, 0.01, DVec3::new(30.0, 0.0, 0.0)) } else { sighting(i, noise(i, 0.5)) })
        .collect();
    let few = fit(&few, &[], &up(1.0, 2.0)).unwrap();
    assert!(off_m(&few) < 0.5 && few.gps[..3].iter().all(|its| !its.agrees), "{} m", off_m(&few));
    // One that tells nothing among those that do is judged by them.
    let one: Vec<_> = (0..40)
        .map(
            |i| if i == 7 { sighting(i, DVec3::new(500.0, 0.0, 0.0)) } else { told(i, 0.02, noise(i, 0.02)) },
        )
        .collect();
    let one = fit(&one, &[], &up(1.0, 2.0)).unwrap();
    assert!(!one.gps[7].agrees && one.residuals.unwrap().agreeing >= 38, "{:?}", one.residuals);
}

#[test]
fn accuracies_of_any_size_keep_a_fit_finite() {
    for sigma_m in [1e-9, 1e3] {
        let gps: Vec<_> = (0..40).map(|i| told(i, sigma_m, noise(i, 1.0))).collect();
        let fit = fit(&gps, &[], &up(1.0, 2.0)).unwrap();
        assert!(
            fit.similarity.translation.is_finite() && (fit.similarity.scale / TRUTH.scale - 1.0).abs() < 0.1
        );
    }
}
