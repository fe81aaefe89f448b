//! The global model that a device receives, and what the device keeps of it: whole, or the tiles that the manifest names
//! for the device.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;
use std::path::{Path, PathBuf};

use cosurf_scene::{SceneError, files, ply};
use cosurf_wire::{BodyHash, DeviceId, ModelHeader, ModelId, ModelKind};

use crate::body::BodyFault;
use crate::codec::{body_frame, body_to_model};
use crate::key::ModelKey;
use crate::manifest::Manifest;
use crate::node::Node;
use crate::store::{Damaged, ModelStore, StoreError};

/// The folder of a device's global models, and the newest of them as a PLY file for viewers.
#[derive(Debug)]
pub struct Received {
    device: DeviceId,
    store: ModelStore,
    ply: PathBuf,
    /// What is on disk.
    stored: BTreeMap<ModelKey, ModelHeader>,
    /// The newest manifest that lists the device, with the device's tiles in it.
    manifest: Option<(ModelHeader, Vec<ModelKey>)>,
    /// The newest revision that has become complete since the folder was opened: the header of its manifest or of the
    /// whole model.
    complete: Option<ModelHeader>,
    /// Files that were set aside as the folder was opened, and are not told yet.
    damaged: VecDeque<Damaged>,
}

/// A revision of the global model of which a device has all that is meant for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Complete {
    /// Number of the revision.
    pub revision: ModelId,
    /// Number of splats that the device has of it.
    pub splats: usize,
}

/// Why a global model is not kept.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// A file could not be written or read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The PLY file could not be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A body is invalid.
    #[error(transparent)]
    Body(#[from] BodyFault),
}

impl Received {
    /// Opens the folder of received models. Also returns their headers, for [`Node::new`]. `ply` is the file for
    /// viewers. Files that cannot be used are set aside; [`Self::take_damaged`] tells them.
    pub fn open(
        device: DeviceId,
        folder: &Path,
        ply: PathBuf,
    ) -> Result<(Self, Vec<ModelHeader>), StoreError> {
        let mut damaged = VecDeque::new();
        let (store, headers) = ModelStore::open_telling(folder, |file| damaged.push_back(file))?;
        if let Some(kept) = files::set_aside_unless_file(&ply)? {
            damaged.push_back(Damaged {
                key: None,
                kept,
                reason: format!("{} is not a file", ply.display()),
            });
        }
        let stored = headers.iter().map(|header| (ModelKey::from(header), *header)).collect();
        Ok((Self { device, store, ply, stored, manifest: None, complete: None, damaged }, headers))
    }

    /// A file that was set aside as the folder was opened; each is returned once. Its model is received again if the
    /// aggregator still offers it.
    pub fn take_damaged(&mut self) -> Option<Damaged> {
        self.damaged.pop_front()
    }

    /// The folder of received models.
    pub fn store(&self) -> &ModelStore {
        &self.store
    }

    /// The newest revision that has become complete since the folder was opened: the header of its manifest or of the
    /// whole model.
    pub fn newest(&self) -> Option<ModelHeader> {
        self.complete
    }

    /// The newest revision that was complete when the folder was opened.
    pub fn newest_at_start(&self) -> Result<Option<ModelHeader>, StoreError> {
        let revisions = self.stored.values().filter(|header| !header.model.is_tile());
        let mut revisions: Vec<&ModelHeader> = revisions.collect();
        revisions.sort_by_key(|header| std::cmp::Reverse(header.model));
        for header in revisions {
            if header.kind != ModelKind::Manifest {
                return Ok(Some(*header));
            }
            let Ok((_, body)) = self.store.get(ModelKey::from(header)) else { continue };
            let Ok(manifest) = Manifest::decode(&body) else { continue };
            let key = |model| ModelKey { device: header.device, model };
            let mut tiles = manifest.of(self.device);
            if manifest.lists(self.device) && tiles.all(|tile| self.stored.contains_key(&key(tile.model))) {
                return Ok(Some(*header));
            }
        }
        Ok(None)
    }

    /// The revision of the newest manifest.
    pub fn revision(&self) -> Option<ModelId> {
        self.manifest.as_ref().map(|(header, _)| header.model)
    }

    /// Keeps a model that has arrived ([`crate::NodeEvent::Store`]), and tells the node. Returns the revision that it
    /// completes.
    pub fn take(
        &mut self,
        node: &mut Node,
        header: ModelHeader,
        body: &[u8],
    ) -> Result<Option<Complete>, ReceiveError> {
        let key = ModelKey::from(header);
        let kept = self.keep(node, header, body);
        match kept {
            Ok(_) => node.stored(key),
            Err(_) => node.store_failed(key),
        }
        kept
    }

    /// Notes that a model on disk is offered again ([`crate::NodeEvent::Known`]). Returns the revision that the device
    /// has. Of the offer, only the key and the hash are known to be right; the rest may be a stranger's.
    pub fn known(&mut self, node: &mut Node, offered: ModelHeader) -> Result<Option<Complete>, ReceiveError> {
        let header = self.store.header(ModelKey::from(offered))?;
        match header.kind {
            ModelKind::Manifest => {
                let (header, body) = self.store.get(ModelKey::from(header))?;
                self.begin(node, header, &Manifest::decode(&body)?)
            }
            _ if header.model.is_tile() => Ok(None),
            _ => {
                if self.complete != Some(header) {
                    // What became of the PLY file since an earlier run is not known.
                    let (_, body) = self.store.get(ModelKey::from(header))?;
                    self.write_ply(&body)?;
                }
                Ok(Some(self.finish_whole(node, header)))
            }
        }
    }

    fn keep(
        &mut self,
        node: &mut Node,
        header: ModelHeader,
        body: &[u8],
    ) -> Result<Option<Complete>, ReceiveError> {
        let key = ModelKey::from(header);
        if header.kind != ModelKind::Manifest && !key.model.is_tile() {
            self.write_ply(body)?;
            self.store.put(&header, body)?;
            return Ok(Some(self.finish_whole(node, header)));
        }
        self.store.put(&header, body)?;
        self.stored.insert(key, header);
        match header.kind {
            ModelKind::Manifest => self.begin(node, header, &Manifest::decode(body)?),
            _ => self.finish(),
        }
    }

    /// Writes a whole model for viewers.
    fn write_ply(&self, body: &[u8]) -> Result<(), ReceiveError> {
        let frame = body_frame(body)?;
        Ok(ply::write(&self.ply, &body_to_model(body, &frame)?.splats, &frame)?)
    }

    /// Notes that a whole model is complete. Tiles of an older revision that are still on their way must not replace it.
    fn finish_whole(&mut self, node: &mut Node, header: ModelHeader) -> Complete {
        self.manifest = None;
        node.expect_tiles(BTreeMap::new());
        self.complete = Some(header);
        Complete { revision: header.model, splats: header.splats as usize }
    }

    /// Begins to receive the tiles of a manifest. A manifest that does not list the device was made before the aggregator
    /// had a model of the device, so a later one follows.
    fn begin(
        &mut self,
        node: &mut Node,
        header: ModelHeader,
        manifest: &Manifest,
    ) -> Result<Option<Complete>, ReceiveError> {
        if !manifest.lists(self.device) {
            return Ok(None);
        }
        let key = |model| ModelKey { device: header.device, model };
        let wanted: BTreeMap<ModelKey, BodyHash> =
            manifest.of(self.device).map(|tile| (key(tile.model), tile.blake3)).collect();
        self.manifest = Some((header, wanted.keys().copied().collect()));
        node.expect_tiles(wanted);
        self.finish()
    }

    /// If all tiles are there, writes the PLY file and removes what is not needed any more.
    fn finish(&mut self) -> Result<Option<Complete>, ReceiveError> {
        let Some((manifest, keys)) = &self.manifest else { return Ok(None) };
        let tiles: Vec<ModelHeader> = keys.iter().filter_map(|key| self.stored.get(key).copied()).collect();
        if tiles.len() < keys.len() {
            return Ok(None);
        }
        let splats = tiles.iter().map(|tile| tile.splats as usize).sum();
        let complete = Complete { revision: manifest.model, splats };
        if self.complete == Some(*manifest) {
            return Ok(Some(complete));
        }
        if let Some(first) = tiles.first() {
            let frame = body_frame(&self.store.get(ModelKey::from(first))?.1)?;
            let load = |tile: &ModelHeader| {
                let (_, body) = self.store.get(ModelKey::from(tile)).map_err(io::Error::other)?;
                Ok(body_to_model(&body, &frame).map_err(io::Error::other)?.splats)
            };
            ply::write_parts(&self.ply, splats, u32::from(first.sh_degree), &frame, tiles.iter().map(load))?;
        }
        let needed: BTreeSet<ModelKey> = keys.iter().copied().chain([ModelKey::from(manifest)]).collect();
        let is_old = |header: &ModelHeader| header.kind == ModelKind::Manifest || header.model.is_tile();
        let old: Vec<ModelKey> = self
            .stored
            .iter()
            .filter(|(key, its)| is_old(its) && !needed.contains(key))
            .map(|(key, _)| *key)
            .collect();
        for key in old {
            self.store.remove(key)?;
            self.stored.remove(&key);
        }
        self.complete = self.manifest.as_ref().map(|(header, _)| *header);
        Ok(Some(complete))
    }
}
