//! Decides which splats a device drops before the upload, because they lie on ground that another device owns
//! (CoSurfGS, "Local Model Compression", done on the device). Of this ground, the device sends only the base, from
//! which its model still teaches in the merge.
//!
//! Every device announces its *flight*, the cameras of its pictures, before it trains. The broker retains the
//! announcements, so a device that has finished training receives the flights of all other devices. If the flight of
//! another device has not arrived, this device drops no splats in favour of that device, so the same ground may be sent
//! twice. No ground is lost if every device that has announced a flight also sends a model.

use std::collections::BTreeMap;

use cosurf_engine::{Compression, Observers};
use cosurf_link::select_flight_cameras;
use cosurf_scene::{Camera, Splats};
use cosurf_wire::DeviceId;
use tracing::warn;

/// The flights of a site that have arrived at this device, and this device's own flight.
#[derive(Clone, Debug)]
pub struct Flights {
    own: DeviceId,
    devices_max: usize,
    cameras: BTreeMap<DeviceId, Vec<Camera>>,
}

impl Flights {
    /// Starts with the flight of this device, `own`. `cameras` are the cameras of all its pictures; if there are too
    /// many for an announcement, evenly spaced ones are kept. `devices_max` is the limit on devices, this one included.
    pub fn new(own: DeviceId, cameras: &[Camera], devices_max: usize) -> Self {
        Self { own, devices_max, cameras: BTreeMap::from([(own, select_flight_cameras(cameras))]) }
    }

    /// Adds the flight of another device, or replaces that device's earlier flight. Ignores a flight of this device,
    /// and flights of new devices beyond the limit on devices.
    pub fn insert(&mut self, device: DeviceId, cameras: Vec<Camera>) {
        let is_known = self.cameras.contains_key(&device);
        if device == self.own {
            return;
        }
        if is_known || self.cameras.len() < self.devices_max {
            self.cameras.insert(device, cameras);
        } else {
            warn!("the flight of {device} is ignored: {} are known; raise `flights_max`", self.cameras.len());
        }
    }

    /// Number of other devices whose flights are known.
    pub fn others(&self) -> usize {
        self.cameras.len() - 1
    }

    /// Finds the splats of this device's model that lie on ground that another device owns; these are to be dropped.
    pub fn compression(&self, splats: &Splats) -> Compression {
        let own = self.cameras.keys().position(|device| *device == self.own).unwrap_or(0);
        let mut observers = Observers::default();
        self.cameras.values().for_each(|cameras| observers.announce(cameras));
        Compression::plan(splats, own, &observers)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Pose;
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    /// A camera 10 m above (x, 0, 0) that looks down on 8 × 8 m of ground.
    fn above(x: f64) -> Camera {
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        Camera {
            cam_from_world: Pose { rotation, translation: -(rotation * DVec3::new(x, 0.0, 10.0)) },
            focal_px: DVec2::splat(40.0),
            center_px: DVec2::splat(16.0),
            size_px: [32, 32],
        }
    }

    /// A model of flat ground at z = 0, with x from -16 to 16 m and y from -4 to 4 m.
    fn ground() -> Splats {
        let mut splats = Splats::with_capacity(0, 0);
        for i in 0..64 * 16 {
            let [x, y] = [(i % 64) as f32 * 0.5 - 15.75, (i / 64) as f32 * 0.5 - 3.75];
            splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.0, -1.0, -5.0], 4.0, &[0.3, 0.2, 0.1]);
        }
        splats
    }

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    fn kept(flights: &Flights) -> Vec<f32> {
        let splats = ground();
        let removed = flights.compression(&splats).removed;
        splats.without(&removed).means.iter().map(|mean| mean[0]).collect()
    }

    #[test]
    fn shared_ground_has_one_owner_and_all_ground_has_an_owner() {
        let [west, east] =
            [[-10.0, -7.0, -4.0, -1.0, 2.0], [10.0, 7.0, 4.0, 1.0, -2.0]].map(|xs| xs.map(above).to_vec());
        let mut flights = Flights::new(device("west"), &west, 2);
        assert_eq!(kept(&flights).len(), ground().len(), "no other flight is known");
        flights.insert(device("west"), east.clone());
        assert_eq!(flights.others(), 0, "a flight under the own name is ignored");
        flights.insert(device("east"), east.clone());
        flights.insert(device("third"), east.clone());
        assert_eq!(flights.others(), 1, "the limit is two devices");
        let from_west = kept(&flights);
        let mut flights = Flights::new(device("east"), &east, 2);
        flights.insert(device("west"), west);
        let from_east = kept(&flights);
        for mean in ground().means {
            let owners =
                usize::from(from_west.contains(&mean[0])) + usize::from(from_east.contains(&mean[0]));
            assert!(owners >= 1, "a hole at {}", mean[0]);
        }
        assert!(
            from_west.len() + from_east.len() < ground().len() * 7 / 4,
            "{} and {} splats are kept",
            from_west.len(),
            from_east.len()
        );
    }
}
