//! What other devices have photographed, and what is left to them before the own model is sent (CoSurfGS, "Local Model
//! Compression", on the device).
//!
//! Every device tells what it has photographed before it trains, and the broker keeps that; who has trained hears all of
//! it. Of a device that was not heard nothing is left out: its ground is sent twice, never by nobody, as long as whoever
//! tells a flight sends a model in the end.

use std::collections::BTreeMap;

use anyhow::Result;
use cosurf_engine::{Compression, Device, ModelCameras};
use cosurf_link::select_flight_cameras;
use cosurf_scene::{Camera, Splats};
use cosurf_wire::DeviceId;

/// Devices of which flights are kept.
const DEVICES_MAX: usize = 256;

/// The flights of a site, as far as they are known.
#[derive(Clone, Debug)]
pub struct Flights {
    own: DeviceId,
    cameras: BTreeMap<DeviceId, Vec<Camera>>,
}

impl Flights {
    /// Knows of `own`, which has these cameras, only.
    pub fn new(own: DeviceId, cameras: &[Camera]) -> Self {
        Self { own, cameras: BTreeMap::from([(own, select_flight_cameras(cameras))]) }
    }

    /// Another device tells its flight, or another one than before.
    pub fn note(&mut self, device: DeviceId, cameras: Vec<Camera>) {
        let is_known = self.cameras.contains_key(&device);
        if device != self.own && (is_known || self.cameras.len() < DEVICES_MAX) {
            self.cameras.insert(device, cameras);
        }
    }

    /// How many others are known.
    pub fn others(&self) -> usize {
        self.cameras.len() - 1
    }

    /// What of the own model is left to others; `cameras` are its own at the size that it was trained at, `threads` (at
    /// least 1) compute.
    pub fn compression(&self, splats: &Splats, cameras: &[Camera], threads: usize) -> Result<Compression> {
        let own = self.cameras.keys().position(|device| *device == self.own).unwrap_or(0);
        let all: Vec<Vec<Camera>> = self.cameras.values().cloned().collect();
        Ok(Compression::plan(splats, cameras, &ModelCameras { cameras: &all, own }, &Device::Cpu, threads)?)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::Pose;
    use glam::{DQuat, DVec2, DVec3};

    use super::*;

    /// Looks down on 8 × 8 m.
    fn above(x: f64) -> Camera {
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        Camera {
            cam_from_world: Pose { rotation, translation: -(rotation * DVec3::new(x, 0.0, 10.0)) },
            focal_px: DVec2::splat(40.0),
            center_px: DVec2::splat(16.0),
            size_px: [32, 32],
        }
    }

    /// Flat ground from -16 to 16 m.
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

    fn kept(flights: &Flights, cameras: &[Camera]) -> Vec<f32> {
        let splats = ground();
        let removed = flights.compression(&splats, cameras, 1).unwrap().removed;
        splats.without(&removed).means.iter().map(|mean| mean[0]).collect()
    }

    #[test]
    fn shared_ground_is_left_to_one_and_other_ground_to_nobody() {
        let [west, east] =
            [[-10.0, -7.0, -4.0, -1.0, 2.0], [10.0, 7.0, 4.0, 1.0, -2.0]].map(|xs| xs.map(above).to_vec());
        let mut flights = Flights::new(device("west"), &west);
        assert_eq!(kept(&flights, &west).len(), ground().len(), "of nobody else is known");
        flights.note(device("west"), east.clone());
        assert_eq!(flights.others(), 0, "nobody speaks for this device but itself");
        flights.note(device("east"), east.clone());
        let its = kept(&flights, &west);
        let mut flights = Flights::new(device("east"), &east);
        flights.note(device("west"), west);
        let theirs = kept(&flights, &east);
        for mean in ground().means {
            let owners = usize::from(its.contains(&mean[0])) + usize::from(theirs.contains(&mean[0]));
            assert!(owners >= 1, "a hole at {}", mean[0]);
        }
        assert!(its.len() + theirs.len() < ground().len() * 7 / 4, "{} and {} stay", its.len(), theirs.len());
    }
}
