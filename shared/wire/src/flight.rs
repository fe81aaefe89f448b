//! Messages about flights: the cameras that a device announces, its pledge to send a model of them, and the list of the
//! pledges that an aggregator has confirmed.
//!
//! A device announces its flight once ([`FlightCameras`]); the broker keeps the message for devices that connect later. So
//! the announcement may be old, or a recorded one that somebody repeats. Where keys are in use, it counts only with the
//! word of the aggregator: the device pledges to the aggregator's present session that the flight is its newest
//! ([`FlightPledge`]), and the aggregator tells each device, for that device's present session, which pledges it has
//! ([`ConfirmedFlights`]).

use serde::{Deserialize, Serialize};

use crate::body::{CAMERA_BYTES, CameraRecord};
use crate::hash::BodyHash;
use crate::id::{DeviceId, FrameId};

/// Largest number of cameras in a [`FlightCameras`]. The message is then smaller than 16 KiB, the limit on
/// messages that a device sends over a serial line.
pub const FLIGHT_CAMERAS_MAX: usize = 160;
/// Largest number of flights in a [`ConfirmedFlights`]. The message is then smaller than 16 KiB, too.
pub const CONFIRMED_FLIGHTS_MAX: usize = 128;
/// Size in bytes of the largest encoding of a flight in a [`ConfirmedFlights`].
pub const CONFIRMED_FLIGHT_BYTES_MAX: usize = 1 + crate::id::MAX_ID_BYTES + 32;

/// The cameras of a device's flight. They tell the other devices which places the device observes. Before
/// an upload, each device can then drop the splats that another device owns
/// ([`crate::ModelKind::Compressed`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FlightCameras<'a> {
    /// The device that sends the message.
    pub device: DeviceId,
    /// The world frame of the cameras.
    pub frame: FrameId,
    /// The encoded cameras, [`CAMERA_BYTES`] each. A device with more than [`FLIGHT_CAMERAS_MAX`] cameras
    /// sends that many of them, evenly spaced in its list.
    pub cameras: &'a [u8],
}

impl FlightCameras<'_> {
    /// Decodes the cameras.
    pub fn records(&self) -> impl ExactSizeIterator<Item = CameraRecord> {
        self.cameras.as_chunks().0.iter().map(CameraRecord::decode)
    }

    /// Whether `cameras` holds a whole number of valid cameras, at most [`FLIGHT_CAMERAS_MAX`].
    pub(crate) fn is_sane(&self) -> bool {
        self.cameras.len() <= FLIGHT_CAMERAS_MAX * CAMERA_BYTES
            && self.cameras.len().is_multiple_of(CAMERA_BYTES)
            && self.records().all(|camera| camera.is_sane())
    }
}

/// A device's pledge to its aggregator: it will send a model of the flight with these cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FlightPledge {
    /// The device that sends the message.
    pub device: DeviceId,
    /// Session of the aggregator that the pledge is made to, from the seal of its [`ConfirmedFlights`].
    pub session: u64,
    /// Hash of [`FlightCameras::cameras`].
    pub cameras_blake3: BodyHash,
}

/// The flights that an aggregator has confirmed, or a part of their list: the newest pledge of each device. Flights that
/// are not listed do not count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConfirmedFlights<'a> {
    /// The device that the message is for.
    pub device: DeviceId,
    /// Session of that device that the message is for, from its [`crate::State`].
    pub session: u64,
    /// Index of the first flight of this part in the whole list.
    pub first: u32,
    /// Number of flights in the whole list.
    pub total: u32,
    /// The encoded flights of this part, at most [`CONFIRMED_FLIGHTS_MAX`], one after the other: each is the device and the
    /// hash of its cameras. See [`Self::encode_flight`].
    pub flights: &'a [u8],
}

impl ConfirmedFlights<'_> {
    /// Encodes a flight for the list. Returns the written bytes.
    pub fn encode_flight(
        device: DeviceId,
        cameras_blake3: BodyHash,
        out: &mut [u8; CONFIRMED_FLIGHT_BYTES_MAX],
    ) -> &[u8] {
        // Cannot fail: a test encodes the longest name.
        postcard::to_slice(&(device, cameras_blake3), out).map_or(&[], |written| written)
    }

    /// Decodes the flights of this part: devices, and the hashes of their cameras.
    pub fn records(&self) -> impl Iterator<Item = (DeviceId, BodyHash)> {
        let mut rest = self.flights;
        core::iter::from_fn(move || {
            let (record, others) = postcard::take_from_bytes(rest).ok()?;
            rest = others;
            Some(record)
        })
    }

    /// Whether `flights` holds whole flights, at most [`CONFIRMED_FLIGHTS_MAX`], and the list has room for them.
    pub(crate) fn is_sane(&self) -> bool {
        let (mut rest, mut count) = (self.flights, 0);
        while !rest.is_empty() {
            let record: Result<((DeviceId, BodyHash), _), _> = postcard::take_from_bytes(rest);
            let Ok((_, others)) = record else { return false };
            (rest, count) = (others, count + 1);
        }
        count <= CONFIRMED_FLIGHTS_MAX as u32
            && self.first.checked_add(count).is_some_and(|end| end <= self.total)
    }
}
