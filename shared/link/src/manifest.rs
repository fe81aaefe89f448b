//! The list of the tiles of a global model that is too large for its receivers. Each tile is a model of its own. The
//! aggregator decides which tiles each device gets: those with ground that the device observed.

use std::collections::BTreeSet;

use cosurf_wire::body::{Bounds, ORIGIN_BYTES, decode_origin, encode_origin};
use cosurf_wire::{BodyHash, DeviceId, ModelId};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::body::BodyFault;

/// The tiles of a revision of a global model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The tiles. A tile that has not changed keeps its number.
    pub tiles: Vec<TileEntry>,
    /// Which tiles each device gets. A device that is not listed gets its tiles with a later revision.
    pub receivers: Vec<Receiver>,
    /// The world position that the boxes of the tiles are relative to, as the bodies of the tiles are. It ends the encoded
    /// list, unless it is zero.
    #[serde(skip)]
    pub origin: DVec3,
}

/// A tile of a global model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileEntry {
    /// Number of the tile, see [`ModelId::of_tile`].
    pub model: ModelId,
    /// Hash of its body.
    pub blake3: BodyHash,
    /// Number of splats.
    pub splats: u32,
    /// Size of its body, bytes.
    pub body_bytes: u64,
    /// Box that contains the means of all its splats.
    pub bounds: Bounds,
}

/// The tiles that a device gets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receiver {
    /// The device.
    pub device: DeviceId,
    /// Places of its tiles in [`Manifest::tiles`].
    pub tiles: Vec<u32>,
}

impl Manifest {
    /// Decodes a body.
    pub fn decode(body: &[u8]) -> Result<Self, BodyFault> {
        let (mut manifest, rest): (Self, _) =
            postcard::take_from_bytes(body).map_err(|_| BodyFault::Manifest)?;
        let is_whole = match <&[u8; ORIGIN_BYTES]>::try_from(rest) {
            Ok(origin) => {
                manifest.origin = DVec3::from_array(decode_origin(origin)?);
                manifest.origin != DVec3::ZERO
            }
            Err(_) => rest.is_empty(),
        };
        if is_whole && manifest.is_sound() { Ok(manifest) } else { Err(BodyFault::Manifest) }
    }

    /// The tiles that `device` gets.
    pub fn of(&self, device: DeviceId) -> impl Iterator<Item = &TileEntry> {
        let its = self.receivers.iter().filter(move |receiver| receiver.device == device);
        its.flat_map(|receiver| &receiver.tiles).map(|place| &self.tiles[*place as usize])
    }

    /// Whether the manifest tells which tiles `device` gets, even if there are none.
    pub fn lists(&self, device: DeviceId) -> bool {
        self.receivers.iter().any(|receiver| receiver.device == device)
    }

    /// Encodes the list as a body.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut bytes = postcard::to_stdvec(self).expect("numbers and lists have bytes");
        if self.origin != DVec3::ZERO {
            bytes.extend(encode_origin(self.origin.to_array()));
        }
        bytes
    }

    /// Number of splats of all tiles.
    pub(crate) fn splats(&self) -> u64 {
        self.tiles.iter().map(|tile| u64::from(tile.splats)).sum()
    }

    /// Box that contains the means of all splats.
    pub(crate) fn bounds(&self) -> Bounds {
        let all = self.tiles.iter().map(|tile| tile.bounds);
        let joined = all.reduce(|a, b| Bounds {
            min: std::array::from_fn(|i| a.min[i].min(b.min[i])),
            max: std::array::from_fn(|i| a.max[i].max(b.max[i])),
        });
        joined.unwrap_or(Bounds { min: [0.0; 3], max: [0.0; 3] })
    }

    /// Whether all numbers are those of tiles, each once, and each receiver is listed once, with places that exist, each
    /// once. An edge writes a file for each place, so a list of repeated places would fill its disk.
    fn is_sound(&self) -> bool {
        let numbers: BTreeSet<ModelId> = self.tiles.iter().map(|tile| tile.model).collect();
        let devices: BTreeSet<DeviceId> = self.receivers.iter().map(|receiver| receiver.device).collect();
        let is_sound = |receiver: &Receiver| {
            let places: BTreeSet<u32> = receiver.tiles.iter().copied().collect();
            places.len() == receiver.tiles.len()
                && places.last().is_none_or(|last| (*last as usize) < self.tiles.len())
        };
        numbers.len() == self.tiles.len()
            && numbers.iter().all(|number| number.is_tile())
            && devices.len() == self.receivers.len()
            && self.receivers.iter().all(is_sound)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn manifest() -> Manifest {
        let tile = |index: usize| TileEntry {
            model: ModelId::of_tile(ModelId(7), index),
            blake3: BodyHash([index as u8; 32]),
            splats: 1000,
            body_bytes: 9000,
            bounds: Bounds { min: [index as f32; 3], max: [index as f32 + 1.0; 3] },
        };
        let receiver = |name: &str, tiles: &[u32]| Receiver {
            device: DeviceId::new(name).unwrap(),
            tiles: tiles.into(),
        };
        Manifest {
            tiles: (0..3).map(tile).collect(),
            receivers: vec![receiver("a", &[0, 2]), receiver("b", &[])],
            origin: DVec3::ZERO,
        }
    }

    #[test]
    fn a_manifest_comes_back_and_tells_each_device_its_tiles() {
        let decoded = Manifest::decode(&manifest().encode()).unwrap();
        assert_eq!(decoded, manifest());
        let of =
            |name: &str| decoded.of(DeviceId::new(name).unwrap()).map(|tile| tile.model).collect::<Vec<_>>();
        assert_eq!(of("a"), [0, 2].map(|index| ModelId::of_tile(ModelId(7), index)));
        assert!(of("b").is_empty() && of("c").is_empty());
        let lists = |name: &str| decoded.lists(DeviceId::new(name).unwrap());
        assert!(lists("b") && !lists("c"));
        assert_eq!((decoded.splats(), decoded.bounds().max), (3000, [3.0; 3]));
    }

    #[test]
    fn a_manifest_that_contradicts_itself_is_refused() {
        let change: [fn(&mut Manifest); 5] = [
            |manifest| manifest.receivers[0].tiles.push(3),
            |manifest| manifest.receivers[0].tiles.push(0),
            |manifest| manifest.receivers[1].device = manifest.receivers[0].device,
            |manifest| manifest.tiles[1].model = manifest.tiles[0].model,
            |manifest| manifest.tiles[1].model = ModelId(7),
        ];
        for change in change {
            let mut changed = manifest();
            change(&mut changed);
            assert_eq!(Manifest::decode(&changed.encode()), Err(BodyFault::Manifest));
        }
        let far = Manifest { origin: DVec3::new(5e5, 5e6, 0.0), ..manifest() };
        assert_eq!(Manifest::decode(&far.encode()).unwrap(), far);
        let nowhere = Manifest { origin: DVec3::splat(1e9), ..manifest() };
        assert!(Manifest::decode(&nowhere.encode()).is_err());
        let mut long = manifest().encode();
        long.push(0);
        assert_eq!(Manifest::decode(&long), Err(BodyFault::Manifest));
        assert_eq!(Manifest::decode(&long[..20]), Err(BodyFault::Manifest));
    }
}
