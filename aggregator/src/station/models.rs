//! The models that the page of a running site shows: the newest revision, and the one before that which a browser shows. They
//! are read when a browser asks, one at a time, and kept until a browser asks for others.

use std::path::Path;
use std::sync::Arc;

use axum::body::Bytes;
use cosurf_link::{ModelKey, ModelStore};
use cosurf_scene::{LocalFrame, spz};
use tokio::sync::Mutex;
use tokio::task::spawn_blocking;

use super::board::Board;
use crate::service::{SentTiles, contributions, global_store, record_of};
use crate::viewer::{FIRST_SPLATS, Room, Walkable, WalkableError};

/// What reading a model may take, and how large it may be as SPZ, bytes.
const READING_BYTES: u64 = 96 << 20;
const FILE_BYTES: usize = 28 << 20;
const ROOM: Room = Room {
    memory_bytes: Some(READING_BYTES),
    file_bytes: Some(FILE_BYTES),
    splats: None,
    first_splats: Some(FIRST_SPLATS),
};
/// A model with more splats, or one that does not fit, is shown in tiles if devices get it in tiles: a page loads those near the
/// camera, and of the whole as many splats as fit and at most so many, the most important ones.
const UNTILED_SPLATS_MAX: usize = 1_000_000;
const BASE_SPLATS_MAX: usize = 400_000;
/// For states, maps, events and connections.
const OTHER_BYTES: u64 = 8 << 20;
/// Limit on the memory of the page of a running site, bytes: a model that is being read, the two that are shown, and the
/// rest.
pub const PAGE_BYTES: u64 = READING_BYTES + 2 * FILE_BYTES as u64 + OTHER_BYTES;

/// A model as it is served.
#[derive(Clone, Debug)]
pub(super) struct Served {
    revision: u64,
    pub(super) scene: Bytes,
    /// Its most important splats, if it has many.
    pub(super) first: Option<Bytes>,
    pub(super) spz: Bytes,
    /// The tiles of a large model, and the frame that they are shown in.
    tiles: Option<Arc<(SentTiles, LocalFrame)>>,
}

/// The models of a running site. Clones share them.
#[derive(Clone, Debug, Default)]
pub(super) struct Models(Arc<Mutex<Pair>>);

#[derive(Debug, Default)]
struct Pair {
    newest: Option<Served>,
    before: Option<Served>,
}

impl Models {
    /// The newest revision; `None` if there is none, or if it cannot be shown.
    pub(super) async fn newest(&self, board: &Board) -> Option<Served> {
        let revision = board.revision()?;
        // Held while the model is read, so that one model is read at a time, and once.
        let mut pair = self.0.lock().await;
        if pair.newest.as_ref().is_none_or(|known| known.revision != revision) {
            pair.newest = None;
            let folder = board.folder().to_owned();
            pair.newest = read(board, revision, move || newest_of(&folder, revision)).await;
        }
        pair.newest.clone()
    }

    /// A tile of a revision as SPZ; `None` if it is not the newest one, or has no such tile.
    pub(super) async fn tile(&self, revision: u64, index: usize) -> Option<Bytes> {
        // Held until the tile is encoded: it takes its memory from what reading a model may take.
        let pair = self.0.lock().await;
        let newest = pair.newest.as_ref().filter(|known| known.revision == revision)?;
        let tiles = newest.tiles.clone()?;
        let encode = move || {
            let (tiles, frame) = &*tiles;
            spz::to_bytes(&tiles.splats(index, frame).ok()??)
        };
        spawn_blocking(encode).await.ok()?.map(Bytes::from)
    }

    /// The revision before the one that a page shows; `None` if there is no model now, if the service keeps none before, or if
    /// it cannot be shown.
    pub(super) async fn before(&self, board: &Board, shown: u64) -> Option<Served> {
        let store = global_store(board.folder());
        let key = key_before(&store, board.revision()?.min(shown))?;
        let mut pair = self.0.lock().await;
        if pair.before.as_ref().is_none_or(|known| known.revision != key.model.0) {
            pair.before = None;
            let folder = board.folder().to_owned();
            pair.before = read(board, key.model.0, move || {
                let record = record_of(&folder, key.model.0);
                let devices = record.map_or_else(Vec::new, |record| record.contributions(&folder));
                Ok((Walkable::stored(&store, key, &folder, ROOM)?.with_devices(devices), None))
            })
            .await;
        }
        pair.before.clone()
    }
}

/// The newest revision in the folder of a service, and its tiles if it is shown in tiles.
fn newest_of(folder: &Path, revision: u64) -> Result<(Walkable, Option<SentTiles>), WalkableError> {
    let splats_of = |tiles: &SentTiles| tiles.boxes().map(|(splats, _)| splats).sum::<usize>();
    let tiles = SentTiles::read(folder);
    let base = Room { splats: Some(BASE_SPLATS_MAX), ..ROOM };
    let is_large = tiles.as_ref().is_some_and(|tiles| splats_of(tiles) > UNTILED_SPLATS_MAX);
    let mut model = Walkable::read(folder, if is_large { base } else { ROOM })?;
    let [shown, all] = model.shown();
    // Between two revisions they may be of the other one.
    let tiles = tiles.filter(|tiles| shown < all && splats_of(tiles) == all);
    if tiles.is_some() && shown > BASE_SPLATS_MAX {
        model = Walkable::read(folder, base)?; // it almost fits, and must leave room for tiles
    }
    let model = model.with_devices(contributions(folder)).with_revision(revision);
    Ok(match tiles {
        Some(tiles) => (model.with_tiles(revision, tiles.boxes()), Some(tiles)),
        None => (model, None),
    })
}

/// The newest of the stored revisions that are older than this one.
fn key_before(store: &Path, revision: u64) -> Option<ModelKey> {
    let keys = ModelStore::beside(store).keys().ok()?;
    keys.into_iter().filter(|key| !key.model.is_tile() && key.model.0 < revision).max_by_key(|key| key.model)
}

/// Reads a model on a thread of its own. The log tells why a model cannot be shown.
async fn read(
    board: &Board,
    revision: u64,
    what: impl FnOnce() -> Result<(Walkable, Option<SentTiles>), WalkableError> + Send + 'static,
) -> Option<Served> {
    let model = spawn_blocking(what).await.ok()?;
    let (model, tiles) = model
        .inspect_err(|error| board.note_line(&format!("revision {revision} is not shown: {error}")))
        .ok()?;
    let (scene, first) = (Bytes::from(model.scene_json()), model.first().map(Bytes::copy_from_slice));
    let tiles = tiles.map(|tiles| Arc::new((tiles, *model.frame())));
    Some(Served { revision, scene, first, spz: model.into_spz().into(), tiles })
}
