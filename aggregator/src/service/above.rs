//! Hands the global model of the aggregator above on to the devices of an edge: whole if it came whole, else each device
//! gets those of the edge's tiles in which it has ground.
//!
//! The edge numbers what its devices get. The numbers count the edge's own revisions and the models from above alike, so
//! the newest has the highest number. A revision of the edge's own is not sent to its devices for `wait`, because the next
//! model from above will replace it. If none comes, the devices get the edge's own.
//!
//! A restarted edge finds in `handed/` what its devices got from above, and in `upstream/` what came from there.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_link::{Manifest, ModelKey, ModelStore, Receiver as Listed, TileEntry, body_to_model};
use cosurf_scene::LocalFrame;
use cosurf_wire::body::Bounds;
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind};

use super::cut::observed;
use super::error::ServiceError;
use super::record::Merging;
use super::sent::{Revision, Sent, TileBytes};
use crate::gate::Similarity;

/// What the upstream link tells the service.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FromAbove {
    /// This revision of the model above was complete on the disk when the edge started.
    Had(ModelHeader),
    /// This revision of the model above is complete on the disk, and the aggregator above offers it now.
    Came(ModelHeader),
    /// The aggregator above has stored the edge's own newest revision.
    HasOwn,
    /// No model is to be expected for now: the aggregator above is out of reach, it refuses the edge's model, or its
    /// own is too large for the edge.
    Nothing,
}

/// What revisions an edge has of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Own {
    None,
    /// There are some, or were: their files may be lost.
    Some,
    /// One has a higher number than what the devices got from above.
    Newest,
}

/// The service's end of an upstream link.
#[derive(Debug)]
pub(crate) struct AboveLink {
    /// The edge's name on the site above.
    pub(super) device: DeviceId,
    /// The models from above.
    pub(super) store: ModelStore,
    pub(super) news: Receiver<FromAbove>,
}

/// What an edge knows of the aggregator above.
#[derive(Debug)]
pub(super) struct Above {
    pub(super) link: AboveLink,
    wait: Duration,
    /// The newest model from above.
    newest: Option<ModelHeader>,
    /// Number of the newest model from above that came before the edge had a model of its own. It shows nothing of the
    /// edge's ground.
    stale: Option<ModelId>,
    handing_on: Option<HandingOn>,
    /// False if the aggregator above has left the last revision of the edge without an answer.
    is_answering: bool,
    /// Until when the edge's own model waits for the next model from above.
    waits_until: Option<Duration>,
    /// Whether the aggregator above has stored the edge's last revision.
    has_own: bool,
    /// Whether it has offered the newest model again since the edge's last revision.
    is_offered_again: bool,
}

impl Above {
    pub(super) fn new(link: AboveLink, wait: Duration) -> Self {
        Self {
            link,
            wait,
            newest: None,
            stale: None,
            handing_on: None,
            is_answering: true,
            waits_until: None,
            has_own: false,
            is_offered_again: false,
        }
    }

    /// Takes what the link tells. Returns a model to hand on, and whether it is the answer to the edge's last revision. `own`
    /// tells what revisions the edge has of its own. If one is the newest, the answer to it may be the model that came last:
    /// nothing in it has changed.
    pub(super) fn take_news(&mut self, own: Own) -> Option<(ModelHeader, bool)> {
        let mut new = None;
        while let Ok(news) = self.link.news.try_recv() {
            let (header, is_answer) = match news {
                FromAbove::Had(header) => (header, false),
                FromAbove::Came(header) => (header, true),
                FromAbove::HasOwn => {
                    self.has_own = true;
                    continue;
                }
                FromAbove::Nothing => {
                    self.is_answering = false;
                    continue;
                }
            };
            if own == Own::None {
                self.stale = Some(header.model);
            } else if self.newest != Some(header) && Some(header.model) > self.stale {
                self.newest = Some(header);
                self.is_offered_again = false;
                new = Some((header, is_answer));
            } else if self.newest == Some(header) {
                self.is_offered_again |= is_answer;
            }
        }
        let is_answered = own == Own::Newest && self.has_own;
        if new.is_none() && is_answered && std::mem::take(&mut self.is_offered_again) {
            new = self.newest.map(|header| (header, true));
        }
        new
    }

    /// Whether the edge's own model must wait for the next model from above.
    pub(super) fn waits(&mut self, now: Duration) -> bool {
        (self.has_own, self.is_offered_again) = (false, false);
        if self.is_answering {
            self.waits_until.get_or_insert(now.saturating_add(self.wait));
        }
        self.is_answering
    }

    /// Returns true once, when the edge's own model has waited long enough.
    pub(super) fn has_waited(&mut self, now: Duration) -> bool {
        let is_over = |until| now >= until || !self.is_answering;
        let is_over = self.handing_on.is_none() && self.waits_until.is_some_and(is_over);
        if is_over {
            (self.waits_until, self.is_answering) = (None, false);
        }
        is_over
    }

    /// Forgets that the edge's own model waits: there is something newer, or nothing.
    pub(super) fn stop_waiting(&mut self) {
        self.waits_until = None;
    }

    /// The newest model from above.
    pub(super) fn newest(&self) -> Option<ModelHeader> {
        self.newest
    }

    /// Begins to hand a model on. `is_answer` is whether it replaces the edge's own model even if its content is that of
    /// the last one. `devices` are the newest models of the edge's devices; `others` are devices that get no tiles.
    pub(super) fn begin(
        &mut self,
        above: ModelHeader,
        is_answer: bool,
        devices: Vec<ModelHeader>,
        others: &[DeviceId],
        record: Option<&Merging>,
    ) -> Result<(), ServiceError> {
        self.handing_on = None;
        let mut handing_on = HandingOn {
            above,
            is_answer,
            tiles: Vec::new(),
            frame: LocalFrame::WORLD,
            left: VecDeque::new(),
            receivers: BTreeMap::new(),
        };
        if above.kind == ModelKind::Manifest {
            let (_, body) = self.link.store.get(above.into())?;
            let manifest = Manifest::decode(&body)?;
            handing_on.tiles = manifest.of(self.link.device).copied().collect();
            handing_on.frame = LocalFrame::at(manifest.origin);
            handing_on.receivers = others.iter().map(|device| (*device, Vec::new())).collect();
            handing_on.left = devices.into_iter().map(|header| Place::of(header, record)).collect();
        }
        self.handing_on = Some(handing_on);
        Ok(())
    }

    /// Finds the tiles of one more device in `models`. Returns true once all devices have theirs. A call takes as long as
    /// decoding one model.
    pub(super) fn advance(&mut self, models: &ModelStore) -> Result<bool, ServiceError> {
        let Some(handing_on) = &mut self.handing_on else { return Ok(false) };
        let Some(place) = handing_on.left.pop_front() else { return Ok(true) };
        let tiles = place.tiles(models, &handing_on.tiles, &handing_on.frame)?;
        handing_on.receivers.insert(place.header.device, tiles);
        Ok(false)
    }

    /// Forgets the newest model from above, which could not be read or written. The aggregator above offers it again.
    /// Returns whether that is no fault: the link has removed it from the disk, because a newer one has come.
    pub(super) fn forget_newest(&mut self) -> bool {
        self.handing_on = None;
        let Some(newest) = self.newest.take() else { return false };
        self.link.store.keys().is_ok_and(|keys| !keys.contains(&newest.into()))
    }

    /// Writes the model of which all devices have their tiles, as the devices get it. `own` is the highest number that they
    /// may have of another model, such as the edge's own newest revision, and `next` the next free number. Returns whether
    /// the devices have to be told.
    pub(super) fn finish(
        &mut self,
        handed: &mut Sent,
        device: DeviceId,
        own: Option<ModelId>,
        next: ModelId,
    ) -> Result<bool, ServiceError> {
        let Some(HandingOn { above, is_answer, tiles, frame, receivers, .. }) = self.handing_on.take() else {
            return Ok(false);
        };
        let beyond = own.filter(|_| is_answer);
        let revision = Revision { device, number: next, views: above.views, beyond };
        let origin = frame.origin();
        let AboveLink { store, .. } = &self.link;
        let is_new = match above.kind {
            ModelKind::Manifest => {
                let key = |tile: &TileEntry| ModelKey { device: above.device, model: tile.model };
                let bytes = tiles.iter().map(|tile| TileBytes::In(store, key(tile), tile.blake3)).collect();
                let listed = receivers.into_iter().map(|(device, tiles)| Listed { device, tiles });
                handed.keep_tiles(revision, bytes, listed.collect(), origin)?
            }
            _ => handed.keep_whole(revision, store.get(above.into())?.1)?,
        };
        self.is_answering |= is_answer;
        if is_new {
            self.stop_waiting();
        }
        Ok(is_new)
    }
}

/// A model from above whose tiles are being given to devices.
#[derive(Debug)]
struct HandingOn {
    above: ModelHeader,
    is_answer: bool,
    /// The edge's tiles; none if the model came whole.
    tiles: Vec<TileEntry>,
    /// The frame of the tiles.
    frame: LocalFrame,
    left: VecDeque<Place>,
    receivers: BTreeMap<DeviceId, Vec<u32>>,
}

/// How the model of a device was moved for the edge's own global model.
#[derive(Debug)]
struct Place {
    header: ModelHeader,
    by: Option<Similarity>,
    is_kept_out: bool,
}

impl Place {
    /// `record` tells what the last merge has done with the model.
    fn of(header: ModelHeader, record: Option<&Merging>) -> Self {
        let name = header.device.as_str();
        let is_its = |device: &str, model: u64| device == name && model == header.model.0;
        let is_merged =
            record.is_some_and(|record| record.inputs.iter().any(|input| is_its(&input.device, input.model)));
        let fitted = record.into_iter().flat_map(|record| &record.fitted);
        let by = fitted.filter(|fitted| is_merged && fitted.device == name).find_map(|fitted| fitted.by);
        let is_kept_out =
            record.is_some_and(|record| record.kept_out.iter().any(|out| is_its(&out.device, out.model)));
        Self { header, by, is_kept_out }
    }

    /// The tiles, which are in `frame`, in which the device has ground. None if its model was kept out of the last merge:
    /// its place is doubtful.
    fn tiles(
        &self,
        models: &ModelStore,
        tiles: &[TileEntry],
        frame: &LocalFrame,
    ) -> Result<Vec<u32>, ServiceError> {
        if self.is_kept_out {
            return Ok(Vec::new());
        }
        let model = body_to_model(&models.get(self.header.into())?.1, frame)?;
        let moved = self.by.map(|by| by.frame_from_world(frame).model(&model));
        let means = moved.unwrap_or(model).splats.means;
        let sizes: Vec<usize> = tiles.iter().map(|tile| tile.splats as usize).collect();
        Ok(observed(&sizes, &means, |mean| nearest(tiles, mean)))
    }
}

/// A splat counts for the nearest tile if its distance from the box of the tile's splats is at most this share of the
/// box's longest side: devices and the merge place the splats of one ground a little differently.
const DISTANCE_MAX: f32 = 0.25;

/// The tile of a splat.
fn nearest(tiles: &[TileEntry], mean: [f32; 3]) -> Option<usize> {
    let off = |tile: &TileEntry| {
        let Bounds { min, max } = tile.bounds;
        let outside = |i: usize| (min[i] - mean[i]).max(mean[i] - max[i]).max(0.0);
        let side = (0..3).map(|i| max[i] - min[i]).fold(0.0, f32::max);
        let distance = (0..3).map(|i| outside(i).powi(2)).sum::<f32>().sqrt();
        (distance <= DISTANCE_MAX * side).then_some(distance)
    };
    let near = tiles.iter().enumerate().filter_map(|(place, tile)| Some((place, off(tile)?)));
    near.min_by(|(_, one), (_, other)| one.total_cmp(other)).map(|(place, _)| place)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::mpsc::{Sender, channel};

    use cosurf_link::Offer;
    use cosurf_wire::BodyHash;
    use tempfile::TempDir;

    use super::*;
    use crate::testing::model;

    const WAIT: Duration = Duration::from_secs(60);

    fn above() -> (TempDir, Sender<FromAbove>, Above) {
        let folder = tempfile::tempdir().unwrap();
        let (tell, news) = channel();
        let (store, _) = ModelStore::open(folder.path()).unwrap();
        let link = AboveLink { device: DeviceId::new("edge").unwrap(), store, news };
        (folder, tell, Above::new(link, WAIT))
    }

    fn offer(number: u64) -> Offer {
        let (device, splats) = (DeviceId::new("cloud").unwrap(), model(3, 0, 1.0).splats);
        Offer::new(device, ModelId(number), ModelKind::Global, 1, &splats, &[]).unwrap()
    }

    #[test]
    fn a_model_waits_until_the_time_is_over_or_no_answer_is_to_be_expected() {
        let (folder, tell, mut above) = above();
        let s = Duration::from_secs;
        assert!(above.waits(s(10)) && !above.has_waited(s(69)));
        assert!(above.waits(s(40)), "a later model does not wait longer than the first");
        assert!(above.has_waited(s(70)) && !above.has_waited(s(71)));
        assert!(!above.waits(s(72)), "the aggregator above has not answered the last one either");
        let (own, models) = (Some(ModelId(3)), above.link.store.clone());
        let mut handed = Sent::open(&folder.path().join("handed"), drop).unwrap();
        models.put(&offer(1).header, &offer(1).body).unwrap();
        above.begin(offer(1).header, true, Vec::new(), &[], None).unwrap();
        assert!(above.advance(&models).unwrap());
        let device = DeviceId::new("aggregator").unwrap();
        assert!(above.finish(&mut handed, device, own, ModelId(4)).unwrap());
        assert_eq!(handed.number(), Some(ModelId(4)), "the edge counts what its devices get");
        assert!(above.waits(s(80)) && !above.has_waited(s(80)), "it has answered");
        tell.send(FromAbove::Nothing).unwrap();
        assert_eq!(above.take_news(Own::Some), None);
        assert!(above.has_waited(s(80)), "the aggregator above is out of reach");
    }

    #[test]
    fn a_model_from_above_is_handed_on_once_and_only_if_it_is_newer_than_the_edges_first() {
        let (_folder, tell, mut above) = above();
        let mut take = |number, own| {
            tell.send(FromAbove::Came(offer(number).header)).unwrap();
            above.take_news(own).map(|(header, _)| header.model.0)
        };
        assert_eq!(take(3, Own::None), None);
        assert_eq!(take(3, Own::Some), None, "it was merged without the edge's model");
        assert_eq!((take(4, Own::Some), take(4, Own::Some), take(5, Own::Some)), (Some(4), None, Some(5)));
    }

    #[test]
    fn the_model_that_came_last_is_the_answer_if_it_is_offered_again_after_the_edges_next() {
        let (_folder, tell, mut above) = above();
        let header = offer(4).header;
        let mut take = |news: &[FromAbove], own| {
            news.iter().for_each(|news| tell.send(*news).unwrap());
            above.take_news(own)
        };
        assert_eq!(take(&[FromAbove::Had(header)], Own::Some), Some((header, false)));
        assert_eq!(take(&[FromAbove::Came(header)], Own::Newest), None, "it does not have the edge's yet");
        assert_eq!(take(&[FromAbove::HasOwn], Own::Some), None, "the devices have nothing newer");
        assert_eq!(take(&[], Own::Newest), Some((header, true)));
        assert_eq!(take(&[], Own::Newest), None, "once");
        assert!(above.waits(Duration::ZERO));
        tell.send(FromAbove::Came(header)).unwrap();
        assert_eq!(above.take_news(Own::Newest), None, "it does not have the edge's next yet");
    }

    #[test]
    fn a_splat_counts_for_the_nearest_tile_unless_it_is_far_off() {
        let tile = |west: f32| TileEntry {
            model: ModelId::of_tile(ModelId(1), west as usize),
            blake3: BodyHash([0; 32]),
            splats: 100,
            body_bytes: 1000,
            bounds: Bounds { min: [west, 0.0, -0.1], max: [west + 8.0, 4.0, 0.1] },
        };
        let tiles = [tile(0.0), tile(10.0)];
        let of = |x: f32, z: f32| nearest(&tiles, [x, 2.0, z]);
        assert_eq!([of(1.0, 0.0), of(17.0, 0.0)], [Some(0), Some(1)]);
        assert_eq!([of(8.8, 0.0), of(9.2, 0.0), of(9.2, 1.0)], [Some(0), Some(1), Some(1)]);
        assert_eq!([of(-3.0, 0.0), of(21.0, 0.0), of(1.0, 9.0)], [None; 3]);
    }
}
