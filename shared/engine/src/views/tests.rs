#![allow(clippy::unwrap_used)]
use cosurf_scene::{Pose, ply};
use glam::{DVec2, DVec3};

use super::*;
use crate::budget::PAIRS_PER_SPLAT;

/// Straight down from a height of 10 m.
fn above(x: f64) -> Camera {
    Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, 0.0, 10.0), DVec3::new(x, 0.0, 0.0), DVec3::Y),
        focal_px: DVec2::splat(54.0),
        center_px: DVec2::new(32.0, 24.0),
        size_px: [64, 48],
    }
}

/// Ground 800 m long and 10 m wide: flat opaque splats, half a metre apart, each with a colour of its own.
fn ground() -> Splats {
    let mut splats = Splats::with_capacity(0, 0);
    for i in 0..1600u16 {
        for j in 0..20u16 {
            let [x, y] = [f32::from(i) * 0.5 - 200.0, f32::from(j) * 0.5 - 5.0];
            let color = [(1.3 * x).sin(), (0.9 * y).cos(), (0.4 * x * y).sin()];
            splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.2, -1.2, -5.0], 4.0, &color);
        }
    }
    splats
}

fn cameras() -> Vec<Camera> {
    (0..9).map(|i| above(80.0 * f64::from(i) - 100.0)).collect()
}

fn within(limit_bytes: u64) -> ViewMemory {
    ViewMemory { limit_bytes, held_bytes: || 0, made_bytes: 0, made_bytes_per_pixel: 48 }
}

/// The pictures of all cameras, and how many cameras had room together, most at first.
fn pictures(views: &mut Views, cameras: &[Camera]) -> Result<(Vec<Rendering>, Vec<usize>), ViewError> {
    views.expect(cameras.to_vec());
    let mut together = Vec::new();
    let mut picture = |camera| {
        let picture = views.render(camera)?;
        together.push(match views.loaded.as_ref().map(|loaded| &loaded.room) {
            Some(Room::Cameras(cameras)) => cameras.len(),
            _ => 0,
        });
        Ok(picture)
    };
    let pictures = cameras.iter().map(&mut picture).collect::<Result<_, ViewError>>()?;
    Ok((pictures, together))
}

#[test]
fn pictures_in_little_memory_have_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    let model = ground();
    ply::write(&path, &model, &LocalFrame::WORLD).unwrap();
    let open = |place| Views::open(path.clone(), &LocalFrame::WORLD, place, 2).unwrap();
    let cameras = cameras();
    let (whole, _) = pictures(&mut open(Place::On(DeviceChoice::Cpu)), &cameras).unwrap();
    assert!(whole.iter().all(|picture| picture.alpha.iter().any(|alpha| *alpha > 0.9)));
    let Err(ViewError::TooLittleMemory { needed_bytes, splats, .. }) =
        pictures(&mut open(Place::Within(within(1))), &cameras)
    else {
        panic!("a byte is not enough");
    };
    assert!(splats > 100 && splats < model.len() / 4, "{splats} of {}", model.len());
    let viewing = Viewing { splats: model.len(), sh_degree: 0, size_px: [64, 48] };
    let limit = Limit { memory: within(0), held_bytes: 0, viewing };
    let for_all = limit.bytes(model.len(), PAIRS_PER_SPLAT * model.len());
    assert!(needed_bytes < for_all, "{needed_bytes} {for_all}");
    let mut together = Vec::new();
    for limit_bytes in [needed_bytes + (64 << 10), (needed_bytes + for_all) / 2, for_all] {
        let views = &mut open(Place::Within(within(limit_bytes)));
        let (pictures, room) = pictures(views, &cameras).unwrap();
        assert_eq!(pictures, whole, "{limit_bytes} of {for_all}");
        together.push((room[0], views.loaded.as_ref().unwrap().renderer.splats() == model.len()));
    }
    assert_eq!(
        together,
        [(1, false), (9, false), (0, true)],
        "cameras together, and whether the model is whole"
    );
}

#[test]
fn a_picture_with_more_pairs_than_usual_is_counted_before_it_is_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    // Each of these splats covers the whole picture.
    let mut wide = Splats::with_capacity(0, 0);
    (0..400u16).for_each(|i| {
        let depth = -0.01 * f32::from(i);
        wide.push([0.0, 0.0, depth], [1.0, 0.0, 0.0, 0.0], [4.0, 4.0, -5.0], -3.0, &[0.0; 3]);
    });
    ply::write(&path, &wide, &LocalFrame::WORLD).unwrap();
    let camera = Camera { size_px: [640, 480], center_px: DVec2::new(320.0, 240.0), ..above(0.0) };
    let viewing = Viewing { splats: wide.len(), sh_degree: 0, size_px: camera.size_px };
    let limit = Limit { memory: within(0), held_bytes: 0, viewing };
    let usual_bytes = limit.bytes(wide.len(), viewing.usual_pairs());
    let open =
        |bytes| Views::open(path.clone(), &LocalFrame::WORLD, Place::Within(within(bytes)), 2).unwrap();
    let Err(ViewError::TooLittleMemory { needed_bytes, .. }) = open(usual_bytes).render(&camera) else {
        panic!("its pairs alone need more");
    };
    assert!(needed_bytes > usual_bytes, "{needed_bytes} {usual_bytes}");
    assert!(open(needed_bytes).render(&camera).is_ok());
    // A later picture that does not fit is told at the first.
    let mut views = open(usual_bytes);
    views.expect(vec![above(0.0), camera]);
    assert!(matches!(views.render(&above(0.0)), Err(ViewError::TooLittleMemory { .. })));
    assert!(open(usual_bytes).render(&above(0.0)).is_ok());
}
