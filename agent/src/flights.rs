//! Decides which splats a device drops before the upload, because they lie on ground that another device owns
//! (CoSurfGS, "Local Model Compression", done on the device). Of this ground, the device sends only the base, from
//! which its model still teaches in the merge.
//!
//! Every device announces its *flight*, the cameras of its pictures, before it trains. The broker retains the
//! announcements, so a device that has finished training receives the flights of all other devices. If the flight of
//! another device has not arrived, this device drops no splats in favour of that device, so the same ground may be sent
//! twice. No ground is lost if every device that has announced a flight also sends a model.
//!
//! The broker may keep an old announcement, and anybody may repeat a recorded one. So a device with a list of trusted keys
//! counts only the flights that its aggregator has confirmed for this session.

use std::collections::BTreeMap;

use cosurf_engine::{Compression, Observers};
use cosurf_link::select_flight_cameras;
use cosurf_scene::{Camera, LocalFrame, Splats};
use cosurf_wire::{BodyHash, DeviceId};
use tracing::warn;

/// The flights of a site that have arrived at this device, and this device's own flight.
#[derive(Clone, Debug)]
pub struct Flights {
    own: DeviceId,
    own_cameras: Vec<Camera>,
    devices_max: usize,
    others: BTreeMap<DeviceId, Flight>,
    /// The flights that the aggregator has confirmed; `None` if all count.
    confirmed: Option<BTreeMap<DeviceId, BodyHash>>,
}

/// The flight of another device.
#[derive(Clone, Debug)]
struct Flight {
    cameras: Vec<Camera>,
    /// Hash of the encoded cameras.
    cameras_blake3: BodyHash,
}

impl Flights {
    /// Starts with the flight of this device, `own`. `cameras` are the world cameras of all its pictures; if there are too
    /// many for an announcement, evenly spaced ones are kept. `devices_max` is the limit on devices, this one included. If
    /// `only_confirmed`, other flights count only once they are confirmed.
    pub fn new(own: DeviceId, cameras: &[Camera], devices_max: usize, only_confirmed: bool) -> Self {
        Self {
            own,
            own_cameras: select_flight_cameras(cameras),
            devices_max,
            others: BTreeMap::new(),
            confirmed: only_confirmed.then(BTreeMap::new),
        }
    }

    /// Adds the flight of another device, or replaces that device's earlier flight. Ignores a flight of this device,
    /// and flights of new devices beyond the limit on devices. Returns whether this is news.
    pub fn insert(&mut self, device: DeviceId, cameras: Vec<Camera>, cameras_blake3: BodyHash) -> bool {
        let (before, known) = (self.others.get(&device), self.others.len() + 1);
        if device == self.own || before.is_some_and(|before| before.cameras_blake3 == cameras_blake3) {
            return false;
        }
        if before.is_none() && known >= self.devices_max {
            warn!("the flight of {device} is ignored: {known} are known; raise `flights_max`");
            return false;
        }
        self.others.insert(device, Flight { cameras, cameras_blake3 });
        true
    }

    /// Replaces the list of the flights that the aggregator has confirmed.
    pub fn confirm(&mut self, confirmed: BTreeMap<DeviceId, BodyHash>) {
        self.confirmed = self.confirmed.is_some().then_some(confirmed);
    }

    /// Number of other devices whose flights count.
    pub fn others(&self) -> usize {
        self.counted().count()
    }

    /// Number of other devices whose flights are known and do not count, because the aggregator has not confirmed them.
    pub fn unconfirmed(&self) -> usize {
        self.others.len() - self.others()
    }

    /// The flights of other devices that count.
    fn counted(&self) -> impl Iterator<Item = (&DeviceId, &Flight)> {
        let is_confirmed = |device: &DeviceId, flight: &Flight| match &self.confirmed {
            Some(confirmed) => confirmed.get(device) == Some(&flight.cameras_blake3),
            None => true,
        };
        self.others.iter().filter(move |(device, flight)| is_confirmed(device, flight))
    }

    /// Finds the splats of this device's model, which is in `frame`, that lie on ground that another device owns; these are
    /// to be dropped.
    pub fn compression(&self, splats: &Splats, frame: &LocalFrame) -> Compression {
        let mut flights: BTreeMap<&DeviceId, &[Camera]> =
            self.counted().map(|(device, flight)| (device, &flight.cameras[..])).collect();
        flights.insert(&self.own, &self.own_cameras);
        let own = flights.keys().position(|device| **device == self.own).unwrap_or(0);
        let mut observers = Observers::default();
        for cameras in flights.values() {
            let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.local_camera(camera)).collect();
            observers.announce(&cameras);
        }
        Compression::plan(splats, own, &observers)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Pose;
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    const HASH: BodyHash = BodyHash([1; 32]);

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
        let removed = flights.compression(&splats, &LocalFrame::WORLD).removed;
        splats.without(&removed).means.iter().map(|mean| mean[0]).collect()
    }

    #[test]
    fn only_confirmed_flights_count_if_so_asked() {
        let [west, east] =
            [[-10.0, -7.0, -4.0, -1.0, 2.0], [10.0, 7.0, 4.0, 1.0, -2.0]].map(|xs| xs.map(above));
        let mut flights = Flights::new(device("west"), &west, 9, true);
        flights.insert(device("east"), east.to_vec(), HASH);
        let all = ground().len();
        assert_eq!((kept(&flights).len(), flights.others(), flights.unconfirmed()), (all, 0, 1));
        flights.confirm(BTreeMap::from([(device("east"), BodyHash([2; 32])), (device("third"), HASH)]));
        assert_eq!((kept(&flights).len(), flights.unconfirmed()), (all, 1), "another flight is confirmed");
        flights.confirm(BTreeMap::from([(device("east"), HASH)]));
        assert!(kept(&flights).len() < all && flights.others() == 1);
        flights.confirm(BTreeMap::new());
        assert_eq!(kept(&flights).len(), all, "it is withdrawn");
    }

    #[test]
    fn shared_ground_has_one_owner_and_all_ground_has_an_owner() {
        let [west, east] =
            [[-10.0, -7.0, -4.0, -1.0, 2.0], [10.0, 7.0, 4.0, 1.0, -2.0]].map(|xs| xs.map(above).to_vec());
        let mut flights = Flights::new(device("west"), &west, 2, false);
        assert_eq!(kept(&flights).len(), ground().len(), "no other flight is known");
        flights.insert(device("west"), east.clone(), HASH);
        assert_eq!(flights.others(), 0, "a flight under the own name is ignored");
        flights.insert(device("east"), east.clone(), HASH);
        flights.insert(device("third"), east.clone(), HASH);
        assert_eq!(flights.others(), 1, "the limit is two devices");
        let from_west = kept(&flights);
        let mut flights = Flights::new(device("east"), &east, 2, false);
        flights.insert(device("west"), west, HASH);
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
