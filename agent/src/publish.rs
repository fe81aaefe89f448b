//! Publishes the agent's model: uploads it in chunks until the aggregator has stored it. Then receives the global model
//! and stores it.
//!
//! The agent can be killed at any moment and goes on when it is started again. The number and the hash of the published
//! model are on disk before the upload starts, and a global model is on disk before it is acknowledged.

mod offer;
mod publication;

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Result, bail};
use cosurf_contract::AgentEvent;
use cosurf_link::{
    Complete, InboxLimits, ModelKey, Node, NodeEvent, Offer, ReceiveError, Received, Transport,
    UploadProgress,
};
use cosurf_scene::Camera;
use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{BodyHash, DeviceId, ModelKind, RefusalReason, WireError};
use tracing::info_span;

use crate::flights::Flights;
use crate::status::StatusTeller;
use offer::{offer, renumber};

pub use publication::{Publication, Sharing};

/// So many times as long as for flights, the agent waits for the aggregator to confirm them.
const PATIENCE: u32 = 3;
/// So many times as long as for one flight, the agent waits for all flights, counted from the first connection. Somebody
/// who announces flights without end does not keep it from sending its model.
const WAITS_MAX: u32 = 5;
/// Longest wait for a message, after which the loops below check the time again.
const POLL_TIMEOUT: Duration = Duration::from_millis(200);

/// Uploads the model. Returns once the aggregator has acknowledged it and, if the publication waits for a global model,
/// a global model is stored or is too large to be received. `now` is the time since an arbitrary moment. Fails if the
/// aggregator refuses the model for good, or if a file cannot be read or written. But if the global model cannot be
/// written, this is reported to `on_event` and tried again later.
pub fn publish<T: Transport>(
    publication: &Publication,
    transport: &mut T,
    now: impl Fn() -> Duration,
    on_event: impl FnMut(AgentEvent),
) -> Result<()> {
    let _span = info_span!("publish").entered();
    let mut publisher = Publisher::start(publication, on_event)?;
    loop {
        publisher.upload_when_flights_are_known(now())?;
        if publisher.is_done() {
            break;
        }
        if let Some(event) = publisher.node.step(transport, &now, POLL_TIMEOUT) {
            publisher.handle(event, now())?;
        }
        publisher.tell_status(transport, now());
    }
    publication.status.iter().for_each(|board| board.finish());
    let end = now() + publication.flush_time;
    while now() < end {
        publisher.tell_status(transport, now());
        publisher.node.step(transport, &now, POLL_TIMEOUT);
    }
    Ok(())
}

/// Path of the newest global model in the agent's folder `out`.
pub fn global_ply(out: &Path) -> PathBuf {
    out.join("global.ply")
}

/// Folder of the global models that have arrived, in the agent's folder `out`.
pub fn global_models(out: &Path) -> PathBuf {
    out.join("global")
}

/// The state of one call of [`publish`].
struct Publisher<'a, F> {
    publication: &'a Publication<'a>,
    node: Node,
    received: Received,
    upload: Upload<'a>,
    /// Whether the global model that the aggregator offers is stored, by this run or by an earlier one, or is too large
    /// to be received.
    is_global_settled: bool,
    /// Tells how far the agent is, if that is asked for.
    teller: Option<StatusTeller>,
    /// Whether it was told that another participant has another version.
    is_version_told: bool,
    on_event: F,
}

/// The stages of the upload, in order.
enum Upload<'a> {
    /// The flights of the other devices are being collected. They decide which splats are sent.
    Collecting(Box<FlightCollector<'a>>),
    /// The model is being sent.
    Sending { bytes_total: u64 },
    /// The aggregator has stored the model. It is kept, since the aggregator may lose it.
    Acknowledged { bytes_total: u64 },
}

impl<'a, F: FnMut(AgentEvent)> Publisher<'a, F> {
    fn start(publication: &'a Publication<'a>, on_event: F) -> Result<Self> {
        let out = publication.out;
        let (received, known) =
            Received::open(publication.identity.device, &global_models(out), global_ply(out))?;
        let limits = InboxLimits {
            body_bytes_max: publication.inbox_bytes,
            total_bytes_max: publication.inbox_bytes,
            models_max: 2,
            stored_max: 4096,
        };
        let mut node = Node::new(publication.identity, limits, &known);
        node.set_credentials(publication.credentials.clone());
        node.keep_arrived(&global_models(out))?;
        let upload = match publication.sharing {
            Some(sharing) => {
                node.announce_flight(sharing.flight);
                let is_careful = publication.credentials.trusted.is_some();
                let own = publication.identity.device;
                Upload::Collecting(Box::new(FlightCollector::new(sharing, own, is_careful)))
            }
            None => {
                let Publication { splats, base, .. } = *publication;
                start_upload(&mut node, offer(publication, splats, base, ModelKind::Local)?)
            }
        };
        let mut publisher = Self {
            publication,
            node,
            received,
            upload,
            is_global_settled: false,
            teller: publication.status.map(|board| StatusTeller::new(board, publication.identity)),
            is_version_told: false,
            on_event,
        };
        while let Some(damaged) = publisher.received.take_damaged() {
            publisher.retrying(format!("a global model is received again: {damaged}"), 1);
        }
        Ok(publisher)
    }

    fn tell_status<T: Transport>(&mut self, transport: &mut T, now: Duration) {
        if let Some(teller) = &mut self.teller {
            teller.tell(transport, now);
        }
    }

    fn is_done(&self) -> bool {
        matches!(self.upload, Upload::Acknowledged { .. })
            && (self.is_global_settled || !self.publication.wait_global)
    }

    /// Once all flights are known, drops the splats of ground that other devices observed better, and starts the
    /// upload. Does nothing before that, or if the upload has started.
    fn upload_when_flights_are_known(&mut self, now: Duration) -> Result<()> {
        let Upload::Collecting(collector) = &self.upload else { return Ok(()) };
        if !collector.is_complete(now) {
            return Ok(());
        }
        let Publication { frame, splats, base, .. } = *self.publication;
        let removed = collector.flights.compression(splats, frame).removed;
        let (others, unconfirmed) = (collector.flights.others(), collector.flights.unconfirmed());
        (self.on_event)(AgentEvent::Compressed {
            removed: removed.len(),
            of: splats.len(),
            others,
            unconfirmed,
        });
        let kind = if removed.is_empty() { ModelKind::Local } else { ModelKind::Compressed };
        let (splats, base) = match base.map(|base| base.thinned(splats, &removed)) {
            Some((splats, base)) => (splats, Some(base)),
            None => (splats.without(&removed), None),
        };
        let offer = offer(self.publication, &splats, base.as_ref(), kind)?;
        self.upload = start_upload(&mut self.node, offer);
        Ok(())
    }

    fn handle(&mut self, event: NodeEvent, now: Duration) -> Result<()> {
        match event {
            NodeEvent::Disconnected { attempt, reason } => {
                self.teller.iter_mut().for_each(|teller| teller.on_connection(false));
                self.retrying(reason, attempt);
            }
            NodeEvent::Connected => {
                self.teller.iter_mut().for_each(|teller| teller.on_connection(true));
                if let Upload::Collecting(collector) = &mut self.upload {
                    collector.on_connected(now);
                }
            }
            NodeEvent::Flight { device, cameras, cameras_blake3 } => {
                if let Upload::Collecting(collector) = &mut self.upload {
                    collector.on_flight(device, cameras, cameras_blake3, now);
                }
            }
            NodeEvent::ConfirmedFlights(confirmed) => {
                if let Upload::Collecting(collector) = &mut self.upload {
                    collector.flights.confirm(confirmed);
                }
            }
            NodeEvent::Progress(_, progress) => {
                if let Upload::Sending { bytes_total } = self.upload {
                    let UploadProgress { bytes_arrived, bytes_sent, .. } = progress;
                    (self.on_event)(AgentEvent::Publishing { bytes_arrived, bytes_sent, bytes_total });
                }
            }
            NodeEvent::Uploaded(_, progress) => {
                if let Upload::Sending { bytes_total } = self.upload {
                    self.upload = Upload::Acknowledged { bytes_total };
                }
                (self.on_event)(AgentEvent::Acknowledged { bytes_sent: progress.bytes_sent });
            }
            NodeEvent::AskedAgain { key, .. } => {
                if let Upload::Acknowledged { bytes_total } = self.upload {
                    self.upload = Upload::Sending { bytes_total };
                }
                self.retrying(
                    format!("the aggregator has lost model {} and asks for it again", key.model),
                    1,
                );
            }
            NodeEvent::UploadRefused { key, reason, .. } => self.on_refused(key, reason)?,
            // An earlier run received this global model and wrote it to disk.
            NodeEvent::Known(header) if !self.is_global_settled => {
                let known = self.received.known(&mut self.node, header);
                self.on_received(known);
            }
            NodeEvent::Store { header, body } => {
                let kept = self.received.take(&mut self.node, header, &body);
                self.on_received(kept);
            }
            NodeEvent::Refused { key, reason: RefusalReason::TooLarge } => self.on_global_too_large(key),
            NodeEvent::Refused { key, reason: RefusalReason::Replayed } => {
                let reason = "a later one is in the folder `global`; if that was received before `trusted` was set, \
                              remove the folder";
                let reason = reason.to_owned();
                (self.on_event)(AgentEvent::GlobalRefused { revision: key.model, reason });
            }
            NodeEvent::Denied(reason) => self.retrying(reason, 1),
            NodeEvent::Unanswered { offers, .. } => self.on_unanswered(offers),
            NodeEvent::OtherVersion { version, .. } if !self.is_version_told => {
                self.is_version_told = true;
                self.retrying(WireError::UnknownVersion(version).to_string(), 1);
            }
            _ => {}
        }
        Ok(())
    }

    fn on_refused(&mut self, key: ModelKey, reason: RefusalReason) -> Result<()> {
        if matches!(reason, RefusalReason::NumberTaken | RefusalReason::Replayed)
            && let Some(model) = self.node.renumber(key)
        {
            renumber(self.publication.out, model)?;
            let number = key.model;
            self.retrying(format!("{reason}, {number}: the model is sent as number {model}"), 1);
            return Ok(());
        }
        if !reason.is_temporary() {
            bail!("the aggregator refuses model {}: {reason}", key.model);
        }
        self.retrying(format!("the aggregator does not take the model yet: {reason}"), 1);
        Ok(())
    }

    fn on_received(&mut self, received: Result<Option<Complete>, ReceiveError>) {
        match received {
            Ok(Some(Complete { revision, splats })) => {
                self.is_global_settled = true;
                let verified = self.publication.credentials.trusted.is_some();
                (self.on_event)(AgentEvent::GlobalReceived { revision, splats, verified });
            }
            Ok(None) => {}
            Err(error) => self.retrying(format!("the global model was not stored: {error}"), 1),
        }
    }

    /// Tells that the aggregator does not reply. It is silent to devices whose key it does not know.
    fn on_unanswered(&mut self, offers: u32) {
        let mut reason = "the aggregator does not reply: check that it runs".to_owned();
        if self.publication.credentials.key.is_some() || self.publication.credentials.trusted.is_some() {
            let forged = self.node.forged();
            reason += &format!(
                ", that the keys fit: this device's line in its `trusted`, its own line in ours ({forged} messages were \
                 ignored because no listed key had signed them), and that this device's clock was not ahead before: the \
                 aggregator's log tells that"
            );
        } else {
            reason += "; if it has a list of keys, set `key`";
        }
        self.retrying(reason, offers);
    }

    /// Tells that a global model does not fit, and does not wait for it: a later revision would hardly be smaller.
    fn on_global_too_large(&mut self, key: ModelKey) {
        if !self.is_global_settled {
            self.is_global_settled = true;
            // Of a tile, the number of the model that it belongs to is told.
            let revision = self.received.revision().filter(|_| key.model.is_tile()).unwrap_or(key.model);
            let limit = format_bytes(self.publication.inbox_bytes);
            let reason = format!("it takes more than {limit}, half of the memory limit; raise --memory");
            (self.on_event)(AgentEvent::GlobalRefused { revision, reason });
        }
    }

    fn retrying(&mut self, reason: String, attempt: u32) {
        (self.on_event)(AgentEvent::Retrying { reason, attempt });
    }
}

fn start_upload<'a>(node: &mut Node, offer: Offer) -> Upload<'a> {
    let bytes_total = offer.header.body_bytes;
    node.upload(offer);
    Upload::Sending { bytes_total }
}

/// Collects the flights of other devices until none has arrived for [`Sharing::quiet`], or [`PATIENCE`] times as long if some
/// are not confirmed.
struct FlightCollector<'a> {
    sharing: Sharing<'a>,
    flights: Flights,
    /// Time of the first connection; `None` before it.
    connected_at: Option<Duration>,
    /// Time of the first connection or, if later, of the latest flight that arrived; `None` before the first
    /// connection.
    quiet_since: Option<Duration>,
}

impl<'a> FlightCollector<'a> {
    /// If `only_confirmed`, flights count only once the aggregator has confirmed them.
    fn new(sharing: Sharing<'a>, own: DeviceId, only_confirmed: bool) -> Self {
        let flights = Flights::new(own, sharing.flight, sharing.flights_max, only_confirmed);
        Self { sharing, flights, connected_at: None, quiet_since: None }
    }

    fn on_connected(&mut self, now: Duration) {
        self.connected_at.get_or_insert(now);
        self.quiet_since.get_or_insert(now);
    }

    fn on_flight(&mut self, device: DeviceId, cameras: Vec<Camera>, cameras_blake3: BodyHash, now: Duration) {
        if self.flights.insert(device, cameras, cameras_blake3) {
            self.quiet_since = Some(now);
        }
    }

    fn is_complete(&self, now: Duration) -> bool {
        let quiet = match self.flights.unconfirmed() {
            0 => self.sharing.quiet,
            _ => self.sharing.quiet * PATIENCE,
        };
        let is_quiet = self.quiet_since.is_some_and(|since| now >= since + quiet);
        is_quiet || self.connected_at.is_some_and(|at| now >= at + self.sharing.quiet * WAITS_MAX)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::cell::RefCell;

    use cosurf_link::{Credentials, Faults, Identity, MemoryNetwork, MemoryTransport, Role};
    use cosurf_scene::{LocalFrame, Splats};
    use cosurf_wire::{ModelId, SiteId, TileId};

    use super::*;

    /// An aggregator that offers a global model of 2,000 splats.
    struct Ground {
        network: MemoryNetwork,
        transport: MemoryTransport,
        node: Node,
        /// Numbers of the models that it has stored.
        stored: Vec<u64>,
    }

    fn identity(name: &str, session: u64, role: Role) -> Identity {
        let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new(name).unwrap());
        Identity { site, device, session, role }
    }

    fn splats(count: usize) -> Splats {
        let mut splats = Splats::with_capacity(count, 0);
        let mut push = |i: usize| splats.push([i as f32; 3], [1.0, 0.0, 0.0, 0.0], [0.0; 3], 1.0, &[0.5; 3]);
        (0..count).for_each(&mut push);
        splats
    }

    impl Ground {
        fn new() -> Self {
            let network = MemoryNetwork::new(1, Faults::NONE);
            let identity = identity("ground", 1, Role::Aggregator);
            let limits = InboxLimits {
                body_bytes_max: 1 << 20,
                total_bytes_max: 1 << 20,
                models_max: 2,
                stored_max: 9,
            };
            let mut node = Node::new(identity, limits, &[]);
            let device = identity.device;
            let global = Offer::new(device, ModelId(1), ModelKind::Global, 0, &splats(2000), &[]).unwrap();
            node.broadcast(TileId::WHOLE, global, &[]);
            Self { transport: network.join(&identity), network, node, stored: Vec::new() }
        }

        /// Runs the aggregator for 5 ms. Returns the time.
        fn pass(&mut self) -> Duration {
            let now = self.network.now();
            assert!(now < Duration::from_secs(60), "the agent waits forever");
            if let Some(NodeEvent::Store { header, .. }) =
                self.node.step(&mut self.transport, || now, Duration::ZERO)
            {
                self.stored.push(header.model.0);
                self.node.stored((&header).into());
            }
            self.network.advance(now + Duration::from_millis(5));
            now
        }

        /// Publishes a model from the folder `out`. Returns the agent's events.
        fn publish(&mut self, out: &Path, splats: &Splats, inbox_bytes: u64) -> Vec<AgentEvent> {
            let identity = identity("agent-1", 1 + self.stored.len() as u64, Role::Device);
            let mut transport = self.network.join(&identity);
            let publication = Publication {
                identity,
                frame: &LocalFrame::WORLD,
                is_placed: true,
                splats,
                cameras: &[],
                base: None,
                sharing: None,
                credentials: &Credentials::default(),
                out,
                wait_global: true,
                inbox_bytes,
                flush_time: Duration::from_millis(100),
                status: None,
            };
            let mut events = Vec::new();
            let ground = RefCell::new(self);
            let now = || ground.borrow_mut().pass();
            publish(&publication, &mut transport, now, |event| events.push(event)).unwrap();
            ground.borrow_mut().network.leave(transport);
            events
        }
    }

    /// Publishes a small model. Returns the events.
    fn published(inbox_bytes: u64) -> Vec<AgentEvent> {
        let out = tempfile::tempdir().unwrap();
        let events = Ground::new().publish(out.path(), &splats(10), inbox_bytes);
        assert_eq!(global_ply(out.path()).exists(), inbox_bytes > 100_000);
        events
    }

    /// A drone that has lost its folder begins with number 1 again. The aggregator has other models under the first numbers.
    #[test]
    fn a_model_whose_number_is_taken_gets_the_next_free_one() {
        let mut ground = Ground::new();
        let old = tempfile::tempdir().unwrap();
        for count in [10, 11, 12] {
            ground.publish(old.path(), &splats(count), 1 << 20);
        }
        assert_eq!(ground.stored, [1, 2, 3]);
        let new = tempfile::tempdir().unwrap();
        let events = ground.publish(new.path(), &splats(20), 1 << 20);
        assert_eq!(ground.stored, [1, 2, 3, 4]);
        let told = |event: &AgentEvent| matches!(event, AgentEvent::Retrying { reason, .. } if reason.contains("as number 4"));
        assert!(events.iter().any(told), "{events:?}");
        assert!(events.iter().any(|event| matches!(event, AgentEvent::GlobalReceived { .. })), "{events:?}");
        // It keeps that number, and goes on from there.
        ground.publish(new.path(), &splats(20), 1 << 20);
        assert_eq!(ground.stored, [1, 2, 3, 4]);
        ground.publish(new.path(), &splats(21), 1 << 20);
        assert_eq!(ground.stored, [1, 2, 3, 4, 5]);
    }

    /// Somebody repeats a flight, or announces new ones without end: the agent sends its model all the same.
    #[test]
    fn attack_11_flights_without_end_do_not_keep_a_model_back() {
        let second = Duration::from_secs;
        let device = |name: &str| DeviceId::new(name).unwrap();
        let sharing = Sharing { flight: &[], quiet: second(2), flights_max: 4 };
        let waits = |only_confirmed, hash: fn(u64) -> u8| {
            let mut collector = FlightCollector::new(sharing, device("own"), only_confirmed);
            collector.on_connected(second(1));
            (1..1000)
                .find(|&now| {
                    let hash = BodyHash([hash(now); 32]);
                    collector.on_flight(device("other"), Vec::new(), hash, second(now));
                    collector.is_complete(second(now))
                })
                .unwrap()
        };
        assert_eq!(waits(false, |_| 1), 3, "a repeated flight is no news");
        assert_eq!(waits(true, |_| 1), 7, "one that is not confirmed is waited for, but not for ever");
        assert_eq!(waits(false, |now| now as u8), 11, "new ones every second");
    }

    #[test]
    fn a_global_model_that_does_not_fit_is_told_and_not_waited_for() {
        let events = published(60_000);
        let told = events.iter().filter_map(|event| match event {
            AgentEvent::GlobalRefused { revision, reason } => Some((revision.0, reason.clone())),
            _ => None,
        });
        let told: Vec<(u64, String)> = told.collect();
        assert_eq!(told.len(), 1, "{events:?}");
        assert!(told[0].0 == 1 && told[0].1.contains("raise --memory"), "{told:?}");
        assert!(events.iter().any(|event| matches!(event, AgentEvent::Acknowledged { .. })));
    }

    /// Without keys, anybody may have made a global model. The agent takes it, and says so.
    #[test]
    fn attack_12_a_global_model_without_keys_is_told_as_unverified() {
        let events = published(1 << 20);
        let is_unverified =
            |event: &AgentEvent| matches!(event, AgentEvent::GlobalReceived { verified: false, .. });
        assert!(events.iter().any(is_unverified), "{events:?}");
    }

    #[test]
    fn a_global_model_that_fits_is_received() {
        let events = published(1 << 20);
        assert!(events.iter().any(|event| matches!(event, AgentEvent::GlobalReceived { .. })), "{events:?}");
        assert!(!events.iter().any(|event| matches!(event, AgentEvent::GlobalRefused { .. })));
    }
}
