//! Models of a site far from the world's origin.

use cosurf_engine::Renderer;
use cosurf_link::{FirstLayer, ModelStore, body_frame, body_to_model, model_to_body, plain_importance};
use cosurf_scene::{LocalFrame, Splats, metrics};
use glam::DVec3;

use super::*;
use crate::testing::{QUICK, above, model_at};

/// Where the origin of a site near the world's origin would lie in UTM.
const UTM: DVec3 = DVec3::new(500_000.0, 5_200_000.0, 0.0);
/// The origin of the site's models: the cameras are 10 m above the ground. Another device has chosen another one.
const ORIGINS: [DVec3; 3] = [
    DVec3::new(500_000.0, 5_200_000.0, 10.0),
    DVec3::new(500_000.0, 5_200_000.0, 10.0),
    DVec3::new(501_000.0, 5_200_000.0, 0.0),
];
const NAMES: [&str; 3] = ["agent-1", "agent-2", "agent-3"];

/// Merges three models whose ground lies at `place` in the world, each sent relative to one of `origins`. Returns the
/// body of the global model and the frame of `global.ply`.
fn merged(place: DVec3, origins: [DVec3; 3]) -> (Vec<u8>, DVec3) {
    let (network, folder) = (MemoryNetwork::new(4, Faults::NONE), tempfile::tempdir().unwrap());
    let site = LocalFrame::at(place);
    let drone = |i: usize| {
        let Model { mut splats, cameras } = model_at(2.0 * i as f32);
        let frame = LocalFrame::at(origins[i]);
        site.move_splats(&mut splats, &frame);
        let cameras: Vec<_> =
            cameras.iter().map(|camera| frame.local_camera(&site.world_camera(camera))).collect();
        let importance = plain_importance(&splats);
        let body = model_to_body(&splats, &cameras, &frame, FirstLayer::ByImportance(&importance)).unwrap();
        Drone::with_body(&network, NAMES[i], 1, body)
    };
    let mut drones: Vec<Drone> = (0..3).map(drone).collect();
    let mut ground = open_with(&network, folder.path(), fleet(&NAMES), QUICK);
    let delivered = |events: &[ServiceEvent], _: &[Drone]| events.contains(&ServiceEvent::Delivered);
    simulate(&network, &mut ground, &mut drones, delivered);
    let origin = ply::origin(&global_ply(folder.path())).unwrap();
    let (globals, headers) = ModelStore::open(&folder.path().join("global")).unwrap();
    (globals.get((&headers[0]).into()).unwrap().1, origin)
}

/// How much two models look alike from above, dB.
fn alike(one: &Splats, other: &Splats) -> f64 {
    let mut renderers = [one, other].map(|splats| Renderer::new(splats, 1));
    let psnr = |x: f64| {
        let [one, other] = renderers.each_mut().map(|renderer| renderer.render(&above(x)).rgb);
        metrics::psnr(&one, &other)
    };
    [0.0, 2.0, 4.0].map(psnr).into_iter().fold(f64::MAX, f64::min)
}

#[test]
fn a_site_in_utm_merges_like_one_at_the_origin() {
    let (near, near_origin) = merged(DVec3::ZERO, [DVec3::ZERO; 3]);
    let (far, far_origin) = merged(UTM, [ORIGINS[0]; 3]);
    assert_eq!((near_origin, far_origin), (DVec3::ZERO, ORIGINS[0]));
    assert_eq!(body_frame(&far).unwrap(), LocalFrame::at(ORIGINS[0]));
    let frame = LocalFrame::at(UTM);
    let [near, far] =
        [body_to_model(&near, &LocalFrame::WORLD), body_to_model(&far, &frame)].map(Result::unwrap);
    let few = near.splats.len() / 20;
    assert!(
        near.splats.len().abs_diff(far.splats.len()) <= few,
        "{} {}",
        near.splats.len(),
        far.splats.len()
    );
    let alike = alike(&near.splats, &far.splats);
    assert!(alike > 35.0, "{alike} dB");
    let center = far.cameras[0].cam_from_world.center();
    assert!(center.distance(near.cameras[0].cam_from_world.center()) < 1e-6, "{center}");
}

/// Most devices decide the origin, and a model that was sent relative to another one lies where it belongs.
#[test]
fn models_with_other_origins_lie_where_they_belong() {
    let ((one, _), (mixed, origin)) = (merged(UTM, [ORIGINS[0]; 3]), merged(UTM, ORIGINS));
    assert_eq!(origin, ORIGINS[0]);
    let frame = LocalFrame::at(origin);
    let [one, mixed] = [one, mixed].map(|body| body_to_model(&body, &frame).unwrap().splats);
    let site = LocalFrame::at(UTM);
    let [one, mixed] = [one, mixed].map(|mut splats| {
        frame.move_splats(&mut splats, &site);
        splats
    });
    let alike = alike(&one, &mixed);
    assert!(alike > 35.0, "{alike} dB");
}
