//! A drone whose photographs told no place sends its model to a site whose frame is known.

use cosurf_scene::Dataset;
use glam::{DQuat, DVec3};

use super::*;
use crate::gate::Similarity;
use crate::gate::tests::local;
use crate::testing::QUICK;

const NAMES: [&str; 2] = ["agent-1", "agent-2"];

#[test]
fn a_model_without_a_place_is_laid_on_the_one_that_has_one() {
    let folder = tempfile::tempdir().unwrap();
    let network = MemoryNetwork::new(7, BAD_WEATHER);
    let there = Similarity {
        scale: 0.1,
        rotation: DQuat::from_rotation_z(2.0),
        translation: DVec3::new(60.0, -80.0, 20.0),
    };
    let right = local(3.0, 20);
    let models = [local(-3.0, 10), there.model(&right)];
    let mut drones = vec![
        Drone::new(&network, NAMES[0], 1, &models[0]),
        Drone::without_place(&network, NAMES[1], 1, &models[1]),
    ];
    let merge = MergeSettings { refine: true, ..QUICK };
    assert!(merge.vouched, "the frame of the site is known");
    let mut ground = open_with(&network, folder.path(), fleet(&NAMES), merge);
    let events = simulate(&network, &mut ground, &mut drones, |events, _| events.iter().any(is_merged));
    let record = Merging::read(folder.path()).unwrap();
    assert!(record.kept_out.is_empty(), "{events:?}");
    let moved: Vec<&str> =
        record.fitted.iter().filter(|its| its.by.is_some()).map(|its| &*its.device).collect();
    assert_eq!(moved, ["agent-2"], "{record:?}");
    // Its cameras are where they were before it got a frame of its own, up to what rounding for the upload adds.
    let cameras = Dataset::cameras(folder.path()).unwrap();
    for camera in &right.cameras {
        let eye = camera.cam_from_world.center();
        let off_m = cameras.iter().map(|its| its.cam_from_world.center().distance(eye)).fold(9e9, f64::min);
        assert!(off_m < 0.2, "{eye} is {off_m} m from any camera");
    }
}
