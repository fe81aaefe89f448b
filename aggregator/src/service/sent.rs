//! A global model as the devices get it, on the disk: in tiles, or whole. A tile that has not changed keeps its number, so
//! a device that has it does not fetch it again.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use cosurf_link::body::body_hash;
use cosurf_link::{Damaged, Manifest, ModelKey, ModelStore, Offer, Receiver, TileEntry, body_to_model};
use cosurf_scene::{LocalFrame, Splats};
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, ModelId, ModelKind};
use glam::DVec3;

use super::error::ServiceError;
use super::folder::sent_tiles;

/// A folder with the newest revision of one global model.
#[derive(Debug)]
pub(super) struct Sent {
    store: ModelStore,
    newest: Option<(ModelHeader, Form)>,
}

/// How a revision is sent.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Form {
    Whole,
    Tiles(Manifest),
}

/// The numbers of a new revision.
#[derive(Clone, Copy, Debug)]
pub(super) struct Revision {
    /// The device that sends it.
    pub(super) device: DeviceId,
    pub(super) number: ModelId,
    /// Number of pictures that the model was trained on.
    pub(super) views: u32,
    /// If the content has not changed, the old revision stays, unless its number is lower than this one.
    pub(super) beyond: Option<ModelId>,
}

/// The bytes of a tile.
#[derive(Debug)]
pub(super) enum TileBytes<'a> {
    /// They are here.
    Here(Vec<u8>),
    /// They are in a store, and are read only if the tile is new.
    In(&'a ModelStore, ModelKey, BodyHash),
}

impl TileBytes<'_> {
    fn hash(&self) -> BodyHash {
        match self {
            Self::Here(body) => body_hash(body),
            Self::In(.., hash) => *hash,
        }
    }

    fn read(self) -> Result<Vec<u8>, ServiceError> {
        match self {
            Self::Here(body) => Ok(body),
            Self::In(store, key, _) => Ok(store.get(key)?.1),
        }
    }
}

/// The tiles that devices get of the newest revision, for a reader beside the service.
#[derive(Debug)]
pub(crate) struct SentTiles {
    store: ModelStore,
    device: DeviceId,
    manifest: Manifest,
}

impl SentTiles {
    /// Those in the folder of a service; `None` if the newest revision is sent whole.
    pub(crate) fn read(folder: &Path) -> Option<Self> {
        let store = ModelStore::beside(&sent_tiles(folder));
        let revisions = store.keys().ok()?.into_iter().filter(|key| !key.model.is_tile());
        let header = store.header(revisions.max_by_key(|key| key.model)?).ok()?;
        match Sent::read(&store, &header)? {
            Form::Tiles(manifest) => Some(Self { store, device: header.device, manifest }),
            Form::Whole => None,
        }
    }

    /// Number of splats of each tile, and opposite corners of the box around them, in the world.
    pub(crate) fn boxes(&self) -> impl Iterator<Item = (usize, [DVec3; 2])> {
        self.manifest.tiles.iter().map(|tile| {
            let corner = |at: [f32; 3]| self.manifest.origin + DVec3::from_array(at.map(f64::from));
            (tile.splats as usize, [tile.bounds.min, tile.bounds.max].map(corner))
        })
    }

    /// The splats of a tile in a frame; `None` if there is no such tile.
    pub(crate) fn splats(&self, index: usize, frame: &LocalFrame) -> Result<Option<Splats>, ServiceError> {
        let Some(tile) = self.manifest.tiles.get(index) else { return Ok(None) };
        let (_, body) = self.store.get(ModelKey { device: self.device, model: tile.model })?;
        Ok(Some(body_to_model(&body, frame)?.splats))
    }
}

impl Sent {
    /// Opens or creates the folder. `tell` gets the files that were set aside. A revision that has not all of its tiles
    /// counts as missing.
    pub(super) fn open(folder: &Path, tell: impl FnMut(Damaged)) -> Result<Self, ServiceError> {
        let (store, headers) = ModelStore::open_telling(folder, tell)?;
        let revisions = headers.into_iter().filter(|header| !header.model.is_tile());
        let newest = revisions.max_by_key(|header| header.model);
        let read = newest.and_then(|header| Some((header, Self::read(&store, &header)?)));
        if let (Some(header), None) = (newest, &read) {
            store.put_aside(header.into())?;
        }
        Ok(Self { store, newest: read })
    }

    /// How a revision is sent; `None` if its file is damaged or a tile is missing.
    fn read(store: &ModelStore, header: &ModelHeader) -> Option<Form> {
        if header.kind != ModelKind::Manifest {
            return Some(Form::Whole);
        }
        let manifest = Manifest::decode(&store.get(header.into()).ok()?.1).ok()?;
        let has = |tile: &TileEntry| store.has(ModelKey { device: header.device, model: tile.model });
        manifest.tiles.iter().all(has).then_some(Form::Tiles(manifest))
    }

    pub(super) fn store(&self) -> &ModelStore {
        &self.store
    }

    /// The newest revision: the header of its manifest or of the whole model.
    pub(super) fn newest(&self) -> Option<(&ModelHeader, &Form)> {
        self.newest.as_ref().map(|(header, form)| (header, form))
    }

    /// Number of the newest revision.
    pub(super) fn number(&self) -> Option<ModelId> {
        self.newest().map(|(header, _)| header.model)
    }

    /// Writes a revision in tiles, whose bodies have such an origin. Returns whether it has a new number.
    pub(super) fn keep_tiles(
        &mut self,
        revision: Revision,
        tiles: Vec<TileBytes<'_>>,
        receivers: Vec<Receiver>,
        origin: DVec3,
    ) -> Result<bool, ServiceError> {
        let known: HashMap<BodyHash, TileEntry> = match &self.newest {
            Some((_, Form::Tiles(old))) => old.tiles.iter().map(|tile| (tile.blake3, *tile)).collect(),
            _ => HashMap::new(),
        };
        let mut entries = Vec::with_capacity(tiles.len());
        for (index, tile) in tiles.into_iter().enumerate() {
            if let Some(entry) = known.get(&tile.hash()) {
                entries.push(*entry);
                continue;
            }
            let number = ModelId::of_tile(revision.number, index);
            let offer = Offer::from_body(revision.device, number, ModelKind::Global, 0, tile.read()?)?;
            self.store.put(&offer.header, &offer.body)?;
            let ModelHeader { model, blake3, splats, body_bytes, bounds, .. } = offer.header;
            entries.push(TileEntry { model, blake3, splats, body_bytes, bounds });
        }
        let manifest = Manifest { tiles: entries, receivers, origin };
        let is_same = |form: &Form| matches!(form, Form::Tiles(old) if *old == manifest);
        if self.stays(revision, is_same) {
            return Ok(false);
        }
        let offer = Offer::of_manifest(revision.device, revision.number, revision.views, &manifest)?;
        self.replace(offer, Form::Tiles(manifest))?;
        Ok(true)
    }

    /// Writes a revision that is sent whole. Returns whether it has a new number.
    pub(super) fn keep_whole(&mut self, revision: Revision, body: Vec<u8>) -> Result<bool, ServiceError> {
        let Revision { device, number, views, .. } = revision;
        let offer = Offer::from_body(device, number, ModelKind::Global, views, body)?;
        let has_its_bytes =
            self.newest.as_ref().is_some_and(|(header, _)| header.blake3 == offer.header.blake3);
        if self.stays(revision, |form| *form == Form::Whole && has_its_bytes) {
            return Ok(false);
        }
        self.replace(offer, Form::Whole)?;
        Ok(true)
    }

    /// Removes everything: the newest revision is not sent from this folder.
    pub(super) fn clear(&mut self) -> Result<(), ServiceError> {
        self.newest = None;
        self.remove_old()
    }

    fn stays(&self, revision: Revision, is_same: impl FnOnce(&Form) -> bool) -> bool {
        let newest = self.newest.as_ref();
        newest.is_some_and(|(header, form)| Some(header.model) >= revision.beyond && is_same(form))
    }

    /// Writes the header last, then removes what the revision does not need.
    fn replace(&mut self, offer: Offer, form: Form) -> Result<(), ServiceError> {
        self.store.put(&offer.header, &offer.body)?;
        self.newest = Some((offer.header, form));
        self.remove_old()
    }

    fn remove_old(&self) -> Result<(), ServiceError> {
        let tiles = match &self.newest {
            Some((_, Form::Tiles(manifest))) => &manifest.tiles[..],
            _ => &[],
        };
        let numbers = tiles.iter().map(|tile| tile.model);
        let needed: BTreeSet<ModelId> = numbers.chain(self.number()).collect();
        for key in self.store.keys()? {
            if !needed.contains(&key.model) {
                self.store.remove(key)?;
            }
        }
        Ok(())
    }
}
