//! The site from above: where each device's photographs were taken and what they show of the ground. It reads the cameras
//! of the newest models, and keeps them until a newer model arrives.
//!
//! What it knows nothing about: HTTP, and how the page draws.

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_geo::{Geodetic, Georeference};
use cosurf_link::{ModelKey, ModelStore};
use cosurf_scene::{Camera, evenly_spaced};
use cosurf_wire::{DeviceId, ModelId};
use glam::{DVec2, DVec3};
use serde::Serialize;

use crate::colors::device_css;
use crate::viewer::{ground_axes, up_of};

/// Largest number of photographs of a device that the map shows.
const CAMERAS_MAX: usize = 60;
/// Largest number of devices that the map shows: with all photographs, about 4 MB of JSON.
const DEVICES_MAX: usize = 400;
/// The ground is taken to lie at this share of the height of a model's box: most of it is ground, with things above.
const GROUND_SHARE: f64 = 0.25;
/// The edge of a footprint is at most this many heights above the ground away from the camera, sideways: rays to the
/// horizon meet no ground.
const REACH_HEIGHTS: f64 = 3.0;

/// The map; the content of `/api/map`. Lengths are in world units, x east and y north if the site is georeferenced.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct SiteMap {
    /// Place of the world's origin on the earth; absent if the site is not georeferenced.
    geo: Option<Geodetic>,
    /// World directions of x, y and up on the map.
    axes: [[f64; 3]; 3],
    /// The devices with a model.
    devices: Vec<DeviceMap>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct DeviceMap {
    device: DeviceId,
    /// Its colour, as style sheets name it.
    color: String,
    /// Number of photographs; the map shows some of them.
    of_cameras: usize,
    /// The photographs: `x, y` of the camera, and then of the four corners of what it shows, in order around it.
    cameras: Vec<[f64; 10]>,
}

/// What was read of a device's newest model.
#[derive(Debug)]
struct Known {
    of_cameras: usize,
    /// Some of its cameras, in the world.
    cameras: Vec<Camera>,
    /// Opposite corners of the box of its splats, in the world.
    corners: [DVec3; 2],
}

/// What was read of the newest models; `None` for a model that cannot be read.
#[derive(Debug, Default)]
pub(super) struct Atlas(BTreeMap<DeviceId, (u64, Option<Known>)>);

impl Atlas {
    /// The map of the service in a folder, with these devices and the numbers of their newest models.
    pub(super) fn map(&mut self, folder: &Path, models: &[(DeviceId, u64)]) -> SiteMap {
        let store = ModelStore::beside(&folder.join("models"));
        let models: BTreeMap<DeviceId, u64> = models.iter().copied().take(DEVICES_MAX).collect();
        self.0.retain(|device, (model, _)| models.get(device) == Some(model));
        for (device, model) in models {
            self.0.entry(device).or_insert_with(|| (model, read(&store, device, model)));
        }
        let geo = Georeference::of_folder(folder).ok().flatten().map(|its| its.origin);
        let known = || self.0.iter().filter_map(|(device, (_, known))| Some((*device, known.as_ref()?)));
        let up = match geo {
            Some(_) => DVec3::Z,
            None => up_of(&known().flat_map(|(_, its)| its.cameras.iter().copied()).collect::<Vec<_>>()),
        };
        let (east, north) = ground_axes(up);
        let axes = [east, north, up];
        let devices = known().map(|(device, its)| its.on(device, axes)).collect();
        SiteMap { geo, axes: axes.map(|axis| axis.to_array()), devices }
    }
}

fn read(store: &ModelStore, device: DeviceId, model: u64) -> Option<Known> {
    let (header, frame, cameras) = store.cameras(ModelKey { device, model: ModelId(model) }).ok()?;
    let corner = |[x, y, z]: [f32; 3]| frame.origin() + DVec3::new(x.into(), y.into(), z.into());
    Some(Known {
        of_cameras: cameras.len(),
        cameras: evenly_spaced(&cameras, CAMERAS_MAX),
        corners: [header.bounds.min, header.bounds.max].map(corner),
    })
}

impl Known {
    /// The photographs on a map with these axes: east, north, up.
    fn on(&self, device: DeviceId, axes: [DVec3; 3]) -> DeviceMap {
        let heights = self.corners.map(|corner| corner.dot(axes[2]));
        let ground = heights[0].min(heights[1]) + GROUND_SHARE * (heights[0] - heights[1]).abs();
        let cameras = self.cameras.iter().map(|camera| outline(camera, axes, ground)).collect();
        DeviceMap { device, color: device_css(device.as_str()), of_cameras: self.of_cameras, cameras }
    }
}

/// Where a camera is on the map, and the corners of what it shows of level ground at this height.
fn outline(camera: &Camera, axes: [DVec3; 3], ground: f64) -> [f64; 10] {
    let (pose, [width, height]) = (&camera.cam_from_world, camera.size_px.map(f64::from));
    let on_map = |v: DVec3| DVec2::new(v.dot(axes[0]), v.dot(axes[1]));
    let (eye, above) = (on_map(pose.center()), pose.center().dot(axes[2]) - ground);
    let corners = [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]].map(|corner_px| {
        let ray = pose.rotation.inverse() * camera.ray(DVec2::from(corner_px));
        let (sideways, descent) = (on_map(ray), -ray.dot(axes[2]));
        let reach = REACH_HEIGHTS * above.max(0.0);
        let distance = sideways.length() * above.max(0.0) / descent.max(1e-9);
        eye + sideways.normalize_or_zero() * if descent > 0.0 { distance.min(reach) } else { reach }
    });
    let points = [eye, corners[0], corners[1], corners[2], corners[3]];
    // Centimetres are more than a map shows.
    std::array::from_fn(|i| (points[i / 2][i % 2] * 100.0).round() / 100.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::{FirstLayer, Offer, model_to_body};
    use cosurf_scene::{Base, LocalFrame, Pose};
    use cosurf_wire::ModelKind;

    use super::*;
    use crate::testing::{above, ground};

    #[test]
    fn a_camera_that_looks_down_shows_the_ground_around_it() {
        let eye = DVec3::new(10.0, 20.0, 50.0);
        let down = Pose::look_at(eye, DVec3::new(10.0, 20.0, 0.0), DVec3::Y);
        let camera = Camera {
            cam_from_world: down,
            focal_px: DVec2::splat(100.0),
            center_px: DVec2::new(50.0, 50.0),
            size_px: [100, 100],
        };
        let [x, y, corners @ ..] = outline(&camera, [DVec3::X, DVec3::Y, DVec3::Z], 0.0);
        assert_eq!([x, y], [10.0, 20.0]);
        // Half of the picture is 50 px at a focal length of 100 px, so it shows 25 m from 50 m.
        assert_eq!(corners, [-15.0, 45.0, 35.0, 45.0, 35.0, -5.0, -15.0, -5.0]);
        let ahead = Pose::look_at(eye, eye + DVec3::X, DVec3::Z);
        let far = outline(&Camera { cam_from_world: ahead, ..camera }, [DVec3::X, DVec3::Y, DVec3::Z], 0.0);
        assert!(far.iter().all(|v| v.abs() <= 20.0 + REACH_HEIGHTS * 50.0), "{far:?}");
    }

    #[test]
    fn the_map_has_the_newest_model_of_each_device_and_leaves_out_what_cannot_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = ModelStore::open(&folder.path().join("models")).unwrap();
        let device = |name: &str| DeviceId::new(name).unwrap();
        let cameras: Vec<Camera> = (0..100).map(|i| above(f64::from(i))).collect();
        let splats = ground(0.0, 20.0);
        let body =
            model_to_body(&splats, &cameras, &LocalFrame::WORLD, FirstLayer::Base(&Base::default())).unwrap();
        let offer = Offer::from_body(device("a"), ModelId(3), ModelKind::Local, 100, body).unwrap();
        store.put(&offer.header, &offer.body).unwrap();
        let map = Atlas::default().map(folder.path(), &[(device("a"), 3), (device("b"), 1)]);
        assert_eq!(map.devices.len(), 1);
        assert_eq!((map.devices[0].of_cameras, map.devices[0].cameras.len()), (100, CAMERAS_MAX));
        assert!((map.devices[0].cameras[0][0] - above(0.0).cam_from_world.center().x).abs() < 0.01);
    }
}
