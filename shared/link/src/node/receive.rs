//! The incoming messages of a node. Invalid messages are dropped and reported as [`NodeEvent::Ignored`].

use cosurf_wire::message::{REFUSAL_BEFORE_BYTES, refusal_for_version_before};
use cosurf_wire::{
    ConfirmedFlights, DeviceId, FlightCameras, FlightPledge, Message, Plan, Reply, Sealed, State, Topic,
    VERSION, WireError,
};

use super::births::Notice;
use super::event::NodeEvent;
use super::planning::PlannedCell;
use super::state::Node;
use crate::body::{body_hash, camera};
use crate::guard::Objection;
use crate::identity::Role;
use crate::inbox::InboxEvent;
use crate::transport::{Outgoing, TransportEvent};
use crate::uploader::UploadEvent;

/// Limit on the refusals for devices of the version before that wait to be sent.
const REFUSALS_BEFORE_MAX: usize = 16;

impl Node {
    pub(super) fn receive(&mut self, event: TransportEvent) {
        match event {
            TransportEvent::Connected => {
                let now = self.now;
                self.uploaders.iter_mut().for_each(|uploader| uploader.on_connected(now));
                self.on_connected();
            }
            TransportEvent::Resumed { lost } => {
                let (now, lost) = (self.now, lost_chunks(&lost));
                self.uploaders.iter_mut().for_each(|uploader| uploader.on_resumed(now, &lost));
                self.on_connected();
            }
            TransportEvent::Disconnected { attempt, reason } => {
                self.is_connected = false;
                self.events.push_back(NodeEvent::Disconnected { attempt, reason });
            }
            TransportEvent::Denied { reason } => self.events.push_back(NodeEvent::Denied(reason)),
            TransportEvent::Incoming { topic, payload } => {
                if let Err(reason) = self.receive_message(&topic, &payload) {
                    let source = Topic::parse(&topic).ok().and_then(|(_, topic)| source_of(&topic));
                    let topic = topic.escape_debug().to_string();
                    self.events.push_back(NodeEvent::Ignored { source, topic, reason });
                }
            }
        }
    }

    fn on_connected(&mut self) {
        self.is_connected = true;
        self.birth = Some(self.identity.state_message(true));
        self.is_flight_due = true;
        let now = self.now;
        self.asking.iter_mut().for_each(|asking| asking.on_connected(now));
        self.inbox.on_connected(now);
        self.events.push_back(NodeEvent::Connected);
    }

    /// Handles one message. An error is the reason why the message is dropped.
    fn receive_message(&mut self, topic: &str, payload: &[u8]) -> Result<(), String> {
        let (site, topic) = Topic::parse(topic).map_err(|error| error.to_string())?;
        if site != self.identity.site {
            return Err(format!("the message belongs to site {site}"));
        }
        // A message without payload only tells that its publisher has deleted a retained message.
        if payload.is_empty() || self.is_own(&topic) {
            return Ok(());
        }
        if let Some(device) = source_of(&topic).filter(|device| self.revoked.contains(device)) {
            return Err(format!("{device} is revoked"));
        }
        let sealed = match Sealed::decode(payload) {
            Ok(sealed) => sealed,
            Err(WireError::UnknownVersion(version)) => {
                self.receive_other_version(&topic, version);
                return Ok(());
            }
            Err(error) => return Err(error.to_string()),
        };
        let credentials = self.inbox.credentials();
        let session = match self.guard.admit(&self.identity, credentials, &topic, &sealed) {
            Ok(session) => session,
            Err(Objection::Outdated) => return Ok(()),
            Err(Objection::OlderSession { sender, heard }) => {
                self.events.push_back(NodeEvent::OlderSession { sender, heard });
                return Ok(());
            }
            Err(objection) => {
                self.forged += 1;
                return Err(objection.to_string());
            }
        };
        let message = sealed.message;
        match (topic, &message) {
            (Topic::State { device }, Message::State(state)) if state.device == device => {
                self.receive_state(*state, session);
            }
            (Topic::Flight { device }, Message::Flight(flight)) if flight.device == device => {
                self.receive_flight(flight)?;
            }
            (
                Topic::LocalHeader { .. } | Topic::GlobalHeader { .. } | Topic::TileHeader { .. },
                Message::Header(header),
            ) => {
                let event = self.inbox.on_header(self.now, &topic, *header, session);
                if event == Some(InboxEvent::BadHeader) {
                    return Err("the header does not match its topic".to_owned());
                }
                self.report_inbox(event);
            }
            (
                Topic::LocalChunk { .. } | Topic::GlobalChunk { .. } | Topic::TileChunk { .. },
                Message::Chunk(chunk),
            ) => {
                let event = self.inbox.on_chunk(self.now, &topic, chunk);
                self.report_inbox(event);
                if let Some(InboxEvent::BadChunk(key, index)) = event {
                    return Err(format!("chunk {index} of {key} contradicts its header"));
                }
            }
            (
                Topic::LocalReply { .. } | Topic::GlobalReply { .. },
                Message::Want(_) | Message::Done(_) | Message::Refused(_),
            ) => self.receive_reply(&topic, &message),
            (Topic::GlobalReply { device, reply: Reply::Flight }, Message::FlightPledge(pledge))
                if pledge.device == device =>
            {
                self.receive_pledge(pledge, session);
            }
            (Topic::LocalReply { device, reply: Reply::Flight }, Message::ConfirmedFlights(part))
                if part.device == device =>
            {
                self.receive_confirmed(part, session);
            }
            (Topic::LocalReply { device, reply: Reply::Plan }, Message::Plan(plan))
                if plan.device == device =>
            {
                self.receive_plan(plan);
            }
            _ => return Err("the message does not match its topic".to_owned()),
        }
        Ok(())
    }

    /// Whether the node has sent the message itself. Its own sessions are of interest only where nobody signs: there, two
    /// participants may use one name.
    fn is_own(&self, topic: &Topic) -> bool {
        match topic {
            Topic::Flight { device } => *device == self.identity.device,
            Topic::State { device } => {
                *device == self.identity.device && self.inbox.credentials().trusted.is_some()
            }
            _ => false,
        }
    }

    /// Tells of another version. A device of the version before does not understand our replies, so its model is refused in
    /// its own language. A device of this version does not read that.
    fn receive_other_version(&mut self, topic: &Topic, version: u8) {
        self.events.push_back(NodeEvent::OtherVersion { source: source_of(topic), version });
        if let (Topic::LocalHeader { device, model }, Role::Aggregator) = (topic, self.identity.role)
            && version < VERSION
            && self.refusals_before.len() < REFUSALS_BEFORE_MAX
        {
            let topic = Topic::LocalReply { device: *device, reply: Reply::Refused };
            let mut out = [0; REFUSAL_BEFORE_BYTES];
            let payload = refusal_for_version_before(*device, *model, &mut out).to_vec();
            let topic = topic.to_text(&self.identity.site);
            self.refusals_before.push_back(Outgoing { topic, payload, retain: false });
        }
    }

    fn receive_flight(&mut self, flight: &FlightCameras<'_>) -> Result<(), String> {
        let frame = &self.inbox.credentials().frame;
        if self.identity.role != Role::Device {
            return Ok(());
        }
        if flight.frame != *frame {
            return Err("the flight is in another world frame".to_owned());
        }
        let cameras = flight.records().map(|record| camera(&record)).collect();
        let (device, cameras_blake3) = (flight.device, body_hash(flight.cameras));
        self.events.push_back(NodeEvent::Flight { device, cameras, cameras_blake3 });
        Ok(())
    }

    fn receive_pledge(&mut self, pledge: &FlightPledge, session: u64) {
        if self.confirms_flights() {
            let FlightPledge { device, cameras_blake3, .. } = *pledge;
            self.confirming.on_pledge(&device);
            self.events.push_back(NodeEvent::FlightPledged { device, session, cameras_blake3 });
        }
    }

    fn receive_confirmed(&mut self, part: &ConfirmedFlights<'_>, session: u64) {
        if part.device != self.identity.device || !self.pledges_flights() {
            return;
        }
        let (now, can_sign) = (self.now, self.inbox.credentials().key.is_some());
        let session = can_sign.then_some(session);
        let list = self.pledge.as_mut().and_then(|pledge| pledge.on_list(now, session, part));
        self.events.extend(list.map(NodeEvent::ConfirmedFlights));
    }

    /// Takes the answer for the present session. Where nobody signs, only this check keeps recorded answers out.
    fn receive_plan(&mut self, plan: &Plan<'_>) {
        let Some(asking) = &mut self.asking else { return };
        if plan.device != self.identity.device || plan.session != self.identity.session {
            return;
        }
        asking.on_answer();
        let corners: Vec<[f64; 2]> = plan.corners().collect();
        let (frame, vertical, margin) = (plan.frame, plan.vertical, plan.margin);
        let cell = (!corners.is_empty()).then_some(PlannedCell { vertical, corners, margin });
        self.events.push_back(NodeEvent::Plan { frame, cell });
    }

    fn receive_state(&mut self, state: State, sealed: u64) {
        if self.births.is_new_rival(&self.identity, &state) {
            self.events.push_back(NodeEvent::SameName(state.device));
        }
        match self.births.record(&state, sealed, self.devices_max) {
            Notice::Outdated => return,
            Notice::SameName => self.events.push_back(NodeEvent::SameName(state.device)),
            Notice::TooManyDevices => {
                let (device, devices_max) = (state.device, self.devices_max);
                self.events.push_back(NodeEvent::TooManyDevices { device, devices_max });
            }
            Notice::Valid => {}
        }
        if state.alive {
            let now = self.now;
            self.uploaders.iter_mut().for_each(|uploader| uploader.on_birth(now, state.device));
            self.inbox.on_birth(now, state.device);
        }
        if self.confirms_flights() {
            self.confirming.on_state(self.now, &state, self.devices_max);
        }
        if let Some(planning) = &mut self.planning
            && state.device != self.identity.device
        {
            planning.on_state(self.now, &state, self.devices_max);
        }
        self.events.push_back(NodeEvent::State(state));
    }

    fn receive_reply(&mut self, topic: &Topic, message: &Message<'_>) {
        for uploader in &mut self.uploaders {
            let Some(event) = uploader.on_reply(self.now, topic, message) else { continue };
            let (key, progress) = (uploader.key(), uploader.progress());
            self.events.push_back(match event {
                UploadEvent::Progress => NodeEvent::Progress(key, progress),
                UploadEvent::AskedAgain(by) => NodeEvent::AskedAgain { key, by },
                UploadEvent::Finished => NodeEvent::Uploaded(key, progress),
                UploadEvent::TooManyPeers(device) => {
                    NodeEvent::TooManyDevices { device, devices_max: self.devices_max }
                }
                UploadEvent::Refused(by, reason) => NodeEvent::UploadRefused { key, by, reason },
            });
        }
    }

    fn report_inbox(&mut self, event: Option<InboxEvent>) {
        match event {
            Some(InboxEvent::Receiving(header)) => {
                self.lost.found((&header).into());
                self.events.push_back(NodeEvent::Receiving(header));
            }
            Some(InboxEvent::Known(header)) => self.events.push_back(NodeEvent::Known(header)),
            Some(InboxEvent::Refused(key, reason)) => {
                self.events.push_back(NodeEvent::Refused { key, reason });
            }
            Some(InboxEvent::BadChunk(..) | InboxEvent::BadHeader) | None => {}
        }
    }
}

/// The participant that a message under `topic` comes from, or else the one that it is for.
fn source_of(topic: &Topic) -> Option<DeviceId> {
    match topic {
        Topic::State { device }
        | Topic::Flight { device }
        | Topic::Status { device }
        | Topic::LocalHeader { device, .. }
        | Topic::LocalChunk { device, .. }
        | Topic::LocalReply { device, .. }
        | Topic::TileHeader { device, .. }
        | Topic::TileChunk { device, .. }
        | Topic::GlobalReply { device, .. } => Some(*device),
        Topic::GlobalHeader { .. } | Topic::GlobalChunk { .. } => None,
    }
}

/// The topics of lost chunks, all of which this node has published.
fn lost_chunks(topics: &[String]) -> Vec<Topic> {
    topics.iter().filter_map(|topic| Topic::parse(topic).ok()).map(|(_, topic)| topic).collect()
}
