//! The list of the tiles of a global model that is too large for its receivers. Each tile is a model of its own. The
//! aggregator decides which tiles each device gets: those with ground that the device observed.

use std::collections::BTreeSet;

use cosurf_wire::body::Bounds;
use cosurf_wire::{BodyHash, DeviceId, ModelId};
use serde::{Deserialize, Serialize};

use crate::body::BodyFault;

/// The tiles of a revision of a global model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The tiles. A tile that has not changed keeps its number.
    pub tiles: Vec<TileEntry>,
    /// Which tiles each device gets. A device that is not listed gets its tiles with a later revision.
    pub receivers: Vec<Receiver>,
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
        let (manifest, rest): (Self, _) = postcard::take_from_bytes(body).map_err(|_| BodyFault::Manifest)?;
        if rest.is_empty() && manifest.is_sound() { Ok(manifest) } else { Err(BodyFault::Manifest) }
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
        postcard::to_stdvec(self).expect("numbers and lists have bytes")
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

    /// Whether all numbers are those of tiles, each once, and each receiver is listed once, with places that exist, each once.
    /// An edge writes a file for each place, so a list of repeated places would fill its disk.
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
        let mut long = manifest().encode();
        long.push(0);
        assert_eq!(Manifest::decode(&long), Err(BodyFault::Manifest));
        assert_eq!(Manifest::decode(&long[..20]), Err(BodyFault::Manifest));
    }
}
