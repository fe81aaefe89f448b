use cosurf_scene::Pose;
use glam::DVec2;

use super::observer::COUNTED_MAX;
use super::*;

/// A camera over the ground point `(x, y)`, 10 m up, that looks straight down on 10 × 10 m. `focal_px` is also the side
/// of the picture.
fn above(x: f64, y: f64, focal_px: f64) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 10.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(focal_px),
        center_px: DVec2::splat(0.5 * focal_px),
        size_px: [focal_px as u32; 2],
    }
}

/// Cameras over the middle of the ground, 20 cm apart.
fn cameras(count: usize, focal_px: f64) -> Vec<Camera> {
    (0..count).map(|i| above(0.2 * i as f64, 0.0, focal_px)).collect()
}

/// Flat ground of 6 × 6 m around the origin.
fn ground() -> Splats {
    let mut splats = Splats::with_capacity(0, 0);
    level(&mut splats, 3.0, 0.0);
    splats
}

/// That ground with a level as [`level`] adds it, and the indices of the splats of that level.
fn ground_and_level(half: f32, z: f32) -> (Splats, Vec<u32>) {
    let mut model = ground();
    let first = model.len() as u32;
    level(&mut model, half, z);
    let added = (first..model.len() as u32).collect();
    (model, added)
}

/// Adds a flat opaque square with this half width at the height `z`.
fn level(splats: &mut Splats, half: f32, z: f32) {
    let steps = (2.0 * half / 0.2) as usize;
    for i in 0..steps * steps {
        let [x, y] = [i % steps, i / steps].map(|step| (step as f32 + 0.5) * 0.2 - half);
        splats.push([x, y, z], [1.0, 0.0, 0.0, 0.0], [-1.8, -1.8, -6.0], 6.0, &[0.0; 3]);
    }
}

/// Observers that know only the cameras of each model.
fn announced(flights: &[Vec<Camera>]) -> Observers {
    let mut observers = Observers::default();
    flights.iter().for_each(|cameras| observers.announce(cameras));
    observers
}

/// Observers that know the models, each with its weight.
fn known(models: &[(Splats, Vec<Camera>, f64)]) -> Observers {
    let trusts: Vec<Trust> =
        models.iter().map(|(.., weight)| Trust { weight: *weight, ..Trust::FULL }).collect();
    trusted(models, &trusts)
}

/// Observers that know the models and believe them so far.
fn trusted(models: &[(Splats, Vec<Camera>, f64)], trusts: &[Trust]) -> Observers {
    let mut observers = Observers::default();
    for ((splats, cameras, _), trust) in models.iter().zip(trusts) {
        observers.add(splats, cameras, *trust, &Device::Cpu, 1).expect("the CPU never fails");
    }
    observers
}

/// Share of the ground that each of the first two models loses.
fn lost(observers: &Observers) -> [f64; 2] {
    let ground = ground();
    [0, 1].map(|own| Compression::plan(&ground, own, observers).removed.len() as f64 / ground.len() as f64)
}

#[test]
fn larger_pictures_win_over_more_cameras() {
    let flights = [cameras(2, 320.0), cameras(12, 64.0)];
    assert_eq!(lost(&announced(&flights)), [0.0, 1.0]);
    let models = flights.map(|cameras| (ground(), cameras, 1.0));
    assert_eq!(lost(&known(&models)), [0.0, 1.0]);
}

#[test]
fn a_model_with_a_low_weight_leaves_its_ground_to_others() {
    let with = |weight| {
        let models = [(ground(), cameras(4, 100.0), weight), (ground(), cameras(4, 90.0), 1.0)];
        lost(&known(&models))
    };
    assert_eq!(with(1.0), [0.0, 1.0]);
    assert_eq!(with(0.5), [1.0, 0.0]);
}

#[test]
fn many_more_cameras_do_not_outweigh_better_ones() {
    let spread = |count: usize, focal_px: f64| -> Vec<Camera> {
        (0..count).map(|i| above(0.2 * (i % 7) as f64, 0.2 * (i / 7) as f64, focal_px)).collect()
    };
    let models = [spread(42, 100.0), spread(COUNTED_MAX, 105.0)].map(|cameras| (ground(), cameras, 1.0));
    assert_eq!(lost(&known(&models)), [1.0, 0.0]);
}

/// A model with larger pictures, in which a part of the ground lies 2 m lower.
#[test]
fn a_model_that_looks_through_a_place_does_not_own_it() {
    let mut sunken = ground();
    let is_inside = |mean: &[f32; 3]| mean[..2].iter().all(|at| at.abs() < 2.0);
    sunken.means.iter_mut().filter(|mean| is_inside(mean)).for_each(|mean| mean[2] -= 2.0);
    let models = [(ground(), cameras(4, 60.0), 1.0), (sunken, cameras(4, 100.0), 1.0)];
    let lost = Compression::plan(&ground(), 0, &known(&models)).removed;
    let means = ground().means;
    let inner = |i: &&u32| means[**i as usize][..2].iter().all(|at| at.abs() < 1.0);
    assert_eq!(lost.iter().filter(inner).count(), 0, "ground that the other model does not show is lost");
    assert!(lost.len() > 300, "{} are lost: the other model has larger pictures", lost.len());
}

/// A model has splats in mid-air, although its own cameras see the ground below them. It loses them only if cameras of another
/// model see that ground too.
#[test]
fn only_other_models_refute_what_a_model_shows() {
    let mut in_air = Splats::with_capacity(0, 0);
    level(&mut in_air, 0.5, 5.0);
    let lost_beside_one_at = |x: f32| {
        let mut other = ground();
        other.means.iter_mut().for_each(|mean| mean[0] += x);
        let cameras_of_other = (0..4).map(|i| above(f64::from(x) + 0.2 * f64::from(i), 0.0, 100.0)).collect();
        let models = [(ground(), cameras(4, 100.0), 1.0), (other, cameras_of_other, 1.0)];
        Compression::plan(&in_air, 0, &known(&models)).removed.len()
    };
    assert_eq!(lost_beside_one_at(50.0), 0);
    assert_eq!(lost_beside_one_at(0.0), in_air.len());
}

#[test]
fn finer_pixels_than_were_checked_do_not_count() {
    let models = [400.0, 100.0].map(|focal_px| (ground(), cameras(4, focal_px), 1.0));
    // All cameras are 10 m away, so 100 px are 100 pixels on a square metre.
    let with = |pixels_max| lost(&trusted(&models, &[Trust { pixels_max, ..Trust::FULL }, Trust::FULL]));
    assert_eq!(with(f64::INFINITY), [0.0, 1.0]);
    assert_eq!(with(110.0), [0.0, 1.0]);
    assert_eq!(with(60.0), [1.0, 0.0]);
}

#[test]
fn a_model_whose_cameras_show_nothing_leaves_its_ground_to_others() {
    let with = |more: Vec<Camera>| {
        let cameras_of_first = [cameras(4, 100.0), more].concat();
        lost(&known(&[(ground(), cameras_of_first, 1.0), (ground(), cameras(4, 90.0), 1.0)]))
    };
    assert_eq!(with(Vec::new()), [0.0, 1.0]);
    assert_eq!(with((0..4).map(|i| above(50.0 + f64::from(i), 0.0, 100.0)).collect()), [1.0, 0.0]);
}

/// Flat ground of which only every n-th splat at `x` above 0 is there.
fn thinned(every: usize) -> Splats {
    let all = ground();
    let is_gone = |i: &u32| all.means[*i as usize][0] > 0.0 && !(*i as usize).is_multiple_of(every);
    all.without(&(0..all.len() as u32).filter(is_gone).collect::<Vec<_>>())
}

#[test]
fn a_model_with_few_splats_leaves_its_ground_to_others() {
    // What observations are worth is the fourth power of the focal length, and the square of the density.
    let of_first = |every| {
        let models = [
            (thinned(every), cameras(4, 100.0), 1.0),
            (ground(), cameras(4, 100.0 * 0.7f64.powf(0.25)), 1.0),
        ];
        let observers = known(&models);
        let lost = Compression::plan(&ground(), 0, &observers).removed;
        let is_thin = |i: &&u32| ground().means[**i as usize][0] > 1.0;
        [lost.iter().filter(is_thin).count(), lost.len()]
    };
    assert_eq!(of_first(1), [0, 0]);
    let [thin, all] = of_first(2);
    assert!(thin > 200 && all < 500, "{thin} of {all} lie where it has few splats");
}

#[test]
fn splats_below_the_ground_prove_nothing() {
    // Four cameras look down, and one looks below the edge of the ground.
    let cam_from_world = Pose::look_at(DVec3::new(-10.0, 0.0, 3.0), DVec3::new(0.0, 0.0, 0.0), DVec3::Z);
    let flat = Camera { cam_from_world, ..above(0.0, 0.0, 100.0) };
    let cameras = [cameras(4, 100.0), vec![flat]].concat();
    let proving = |depth: f32| {
        let mut heaped = ground();
        let visible = heaped.len();
        level(&mut heaped, 2.0, -depth);
        let observations = Observations::of(&heaped, &cameras, &Device::Cpu, 1).expect("the CPU never fails");
        let proving = observations.proving(&heaped);
        let of_ground = proving.iter().filter(|i| **i < visible).count();
        [
            of_ground as f64 / visible as f64,
            (proving.len() - of_ground) as f64 / (heaped.len() - visible) as f64,
        ]
    };
    for depth in [2.0, 0.4] {
        let [of_ground, of_heap] = proving(depth);
        assert!(of_ground > 0.98 && of_heap < 0.05, "{of_ground} and {of_heap} with splats {depth} m deep");
    }
}

/// A model of half of the ground that claims the cameras over the other half too.
#[test]
fn a_model_with_claimed_cameras_leaves_its_own_ground_to_others() {
    let over = |x: f64| (0..4).map(move |i| above(x, 0.2 * f64::from(i), 100.0));
    let all: Vec<Camera> = over(-6.0).chain(over(6.0)).collect();
    let mut wide = Splats::with_capacity(0, 0);
    for x in [-6.0, 0.0, 6.0] {
        let mut part = ground();
        part.means.iter_mut().for_each(|mean| mean[0] += x);
        wide.extend(&part);
    }
    // It has hardly any splats at `x` above 0, but one large splat that its cameras see there.
    let is_right = |i: &u32| wide.means[*i as usize][0] > 0.0;
    let mut claimant = wide.without(&(0..wide.len() as u32).filter(is_right).collect::<Vec<_>>());
    claimant.push([6.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [1.5, 1.5, -6.0], 6.0, &[0.0; 3]);
    let honest: Vec<Camera> = all.iter().map(|camera| camera.resized([90; 2])).collect();
    let with = |claimed: &[Camera]| {
        let models = [(claimant.clone(), claimed.to_vec(), 1.0), (wide.clone(), honest.clone(), 1.0)];
        let left: Vec<u32> = Compression::plan(&wide, 1, &known(&models)).removed;
        left.iter().filter(|i| wide.means[**i as usize][0] < -4.0).count()
    };
    assert!(with(&all[..4]) > 100, "larger pictures of its own ground count");
    assert_eq!(with(&all), 0, "half of its cameras claim what it does not show");
}

#[test]
fn a_model_does_not_own_ground_that_it_shows_hidden() {
    let mut roofed = ground();
    level(&mut roofed, 1.0, 4.0);
    let models = [(roofed, cameras(4, 200.0), 1.0), (ground(), cameras(4, 100.0), 1.0)];
    let ground = ground();
    let removed = Compression::plan(&ground, 1, &known(&models)).removed;
    // The roof is 2 m wide and 6 m below the cameras, so it hides 3.3 m of the ground.
    let is_below = |i: usize, half: f32| ground.means[i][..2].iter().all(|at| at.abs() < half);
    assert!(removed.iter().all(|i| !is_below(*i as usize, 1.2)), "ground below the roof is kept");
    let outside = (0..ground.len()).filter(|i| !is_below(*i, 2.2));
    assert!(outside.clone().count() > 100);
    assert!(outside.clone().all(|i| removed.contains(&(i as u32))), "ground beside the roof is left");
    let [_, all] = lost(&announced(&[cameras(4, 200.0), cameras(4, 100.0)]));
    assert_eq!(all, 1.0, "the cameras alone do not tell what is hidden");
}

#[test]
fn a_pose_counts_once() {
    let repeated = vec![above(0.0, 0.0, 300.0); 6];
    assert_eq!(lost(&announced(&[repeated.clone(), cameras(2, 100.0)])), [1.0, 0.0]);
    let mut moved = repeated;
    moved[1] = above(0.2, 0.0, 300.0);
    assert_eq!(lost(&announced(&[moved, cameras(2, 100.0)])), [0.0, 1.0]);
    // Copies that hardly differ are one view, if the model tells how far away the ground is.
    let copies: Vec<Camera> = (0..6).map(|i| above(1e-9 * f64::from(i), 0.0, 300.0)).collect();
    let models = [copies, cameras(2, 100.0)].map(|cameras| (ground(), cameras, 1.0));
    assert_eq!(lost(&known(&models)), [1.0, 0.0]);
    // The same view at another size is the same view.
    let resized = [100, 80, 60].map(|side| above(0.0, 0.0, 300.0).resized([side; 2])).to_vec();
    assert_eq!(lost(&announced(&[resized, cameras(2, 50.0)])), [1.0, 0.0]);
}

/// The models that keep their ground, of models whose cameras have these focal lengths.
fn keepers(focals_px: &[f64]) -> Vec<usize> {
    let models: Vec<_> = focals_px.iter().map(|focal_px| (ground(), cameras(4, *focal_px), 1.0)).collect();
    let observers = known(&models);
    let is_kept = |own: &usize| Compression::plan(&ground(), *own, &observers).removed.is_empty();
    (0..models.len()).filter(is_kept).collect()
}

#[test]
fn of_many_models_one_keeps_its_ground() {
    assert_eq!(keepers(&[100.0]), [0]);
    assert_eq!(keepers(&[100.0, 101.0]), [1]);
    assert_eq!(keepers(&[100.0, 102.0, 99.0, 101.0, 98.0]), [1]);
}

#[test]
fn of_equal_observations_the_first_models_ground_is_kept() {
    assert_eq!(keepers(&[100.0; 2]), [0]);
    assert_eq!(keepers(&[99.0, 100.0, 100.0]), [1]);
}

#[test]
fn oblique_pictures_are_worth_less() {
    let oblique = |i: usize| {
        let eye = DVec3::new(8.0, 0.01 * i as f64, 6.0);
        let cam_from_world = Pose::look_at(eye, DVec3::ZERO, DVec3::Z);
        Camera { cam_from_world, ..above(0.0, 0.0, 120.0) }
    };
    let from_the_side: Vec<Camera> = (0..4).map(oblique).collect();
    let flights = [cameras(4, 100.0), from_the_side];
    let middle = |observers: &Observers| {
        let mut center = Splats::with_capacity(0, 0);
        center.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], [-1.8, -1.8, -6.0], 6.0, &[0.0; 3]);
        [0, 1].map(|own| Compression::plan(&center, own, observers).removed.len())
    };
    assert_eq!(middle(&announced(&flights)), [1, 0], "the cameras alone do not tell the slope");
    assert_eq!(middle(&known(&flights.map(|cameras| (ground(), cameras, 1.0)))), [0, 1]);
}

#[test]
fn the_standing_of_a_view_is_its_models_share_of_the_best() {
    let models = [(ground(), cameras(4, 100.0), 1.0), (ground(), cameras(4, 200.0), 1.0)];
    let observers = known(&models);
    let near = |standings: Vec<f64>, right: f64| {
        assert!(standings.iter().all(|standing| (standing - right).abs() < 0.05), "{standings:?}");
    };
    near(observers.standings(0), 1.0 / 16.0);
    near(observers.standings(1), 1.0);
}

/// Splats below the ground, which no camera of their own model sees, are lost, alone or beside other models. What lies at
/// the edge of the pictures, or on the ground, stays.
#[test]
fn splats_that_the_surface_hides_from_all_cameras_are_lost() {
    let (model, hidden) = ground_and_level(0.4, -4.0);
    let alone = known(&[(model.clone(), cameras(4, 100.0), 1.0)]);
    assert_eq!(Compression::plan(&model, 0, &alone).removed, hidden);
    let beside = known(&[(model.clone(), cameras(4, 100.0), 1.0), (ground(), cameras(4, 90.0), 1.0)]);
    assert_eq!(Compression::plan(&model, 0, &beside).removed, hidden);
    let by_cameras_alone = announced(&[cameras(4, 100.0)]);
    assert!(Compression::plan(&model, 0, &by_cameras_alone).removed.is_empty());
}

/// A tenth deeper than the surface, as splats are that make up the border of a site.
#[test]
fn splats_just_behind_the_surface_are_lost_only_where_others_look() {
    let (model, behind) = ground_and_level(0.4, -1.0);
    let lost = |other: Option<Vec<Camera>>| {
        let other = other.map(|cameras| (ground(), cameras, 1.0));
        let models =
            std::iter::once((model.clone(), cameras(4, 100.0), 1.0)).chain(other).collect::<Vec<_>>();
        Compression::plan(&model, 0, &known(&models)).removed
    };
    assert_eq!(lost(Some(cameras(4, 90.0))), behind);
    assert!(lost(None).is_empty());
    let beside = (0..4).map(|i| above(30.0 + 0.2 * f64::from(i), 0.0, 90.0)).collect();
    assert!(lost(Some(beside)).is_empty());
}

#[test]
fn splats_outside_the_models_pictures_are_lost_where_others_see_a_surface_above_them() {
    let away = |mut splats: Splats| {
        splats.means.iter_mut().for_each(|mean| mean[0] += 30.0);
        splats
    };
    let over_away = || (0..4).map(|i| above(30.0 + 0.2 * f64::from(i), 0.0, 90.0)).collect();
    let other = (away(ground()), over_away(), 1.0);
    let lost = |others: &[(Splats, Vec<Camera>, f64)]| {
        let mut model = ground();
        let (own, mut small) = (model.len(), Splats::with_capacity(0, 0));
        level(&mut small, 0.4, -4.0);
        model.extend(&away(small));
        let models = [&[(model.clone(), cameras(4, 100.0), 1.0)], others].concat();
        let removed = Compression::plan(&model, 0, &known(&models)).removed;
        removed.iter().filter(|i| **i as usize >= own).count()
    };
    assert_eq!(lost(std::slice::from_ref(&other)), 16);
    assert_eq!(lost(&[]), 0, "nobody looks there");
}

/// In mid-air, each before a single camera of another model, which can own nothing.
#[test]
fn splats_that_other_cameras_look_through_are_lost() {
    let (model, floating) = ground_and_level(0.2, 6.0);
    assert!(!floating.is_empty());
    // The model's own cameras look down beside them.
    let own: Vec<Camera> = (0..4).map(|i| above(-3.0 + 0.1 * f64::from(i), 0.0, 100.0)).collect();
    let lost = |models: &[(Splats, Vec<Camera>, f64)]| Compression::plan(&model, 0, &known(models)).removed;
    let with_other = lost(&[(model.clone(), own.clone(), 1.0), (ground(), vec![above(0.0, 0.0, 90.0)], 1.0)]);
    assert!(floating.iter().all(|splat| with_other.contains(splat)), "{with_other:?}");
    let alone = lost(&[(model.clone(), own, 1.0)]);
    assert!(floating.iter().all(|splat| !alone.contains(splat)), "{alone:?}");
}
