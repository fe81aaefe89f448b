//! The incoming messages of a node. Invalid messages are dropped and reported as [`NodeEvent::Ignored`].

use cosurf_wire::{FlightCameras, Message, State, Topic, WireError};

use super::births::Notice;
use super::event::NodeEvent;
use super::state::Node;
use crate::body::camera;
use crate::identity::Role;
use crate::inbox::InboxEvent;
use crate::transport::TransportEvent;
use crate::trust::Credentials;
use crate::uploader::UploadEvent;

impl Node {
    pub(super) fn receive(&mut self, event: TransportEvent) {
        match event {
            TransportEvent::Connected => {
                self.is_connected = true;
                self.birth = Some(self.identity.state_message(true));
                self.is_flight_due = true;
                let now = self.now;
                self.uploaders.iter_mut().for_each(|uploader| uploader.on_connected(now));
                self.events.push_back(NodeEvent::Connected);
            }
            TransportEvent::Disconnected { attempt, reason } => {
                self.is_connected = false;
                self.events.push_back(NodeEvent::Disconnected { attempt, reason });
            }
            TransportEvent::Incoming { topic, payload } => {
                if let Err(reason) = self.receive_message(&topic, &payload) {
                    self.events.push_back(NodeEvent::Ignored { topic, reason });
                }
            }
        }
    }

    /// Handles one message. An error is the reason why the message is dropped.
    fn receive_message(&mut self, topic: &str, payload: &[u8]) -> Result<(), String> {
        let (site, topic) = Topic::parse(topic).map_err(|error| error.to_string())?;
        if site != self.identity.site {
            return Err(format!("the message belongs to site {site}"));
        }
        if payload.is_empty() {
            // A message without payload only tells that its publisher has deleted a retained message.
            return Ok(());
        }
        let is_header = matches!(
            topic,
            Topic::LocalHeader { .. } | Topic::GlobalHeader { .. } | Topic::TileHeader { .. }
        );
        let message = match Message::decode(payload) {
            Ok(message) => message,
            Err(error) => {
                let is_refusable = is_header && error != WireError::Damaged;
                let event = is_refusable.then(|| self.inbox.on_bad_header(&topic)).flatten();
                self.report_inbox(event);
                return Err(error.to_string());
            }
        };
        match (topic, &message) {
            (Topic::State { device }, Message::State(state)) if state.device == device => {
                self.receive_state(*state);
            }
            (Topic::Flight { device }, Message::Flight(flight)) if flight.device == device => {
                self.receive_flight(flight)?;
            }
            (
                Topic::LocalHeader { .. } | Topic::GlobalHeader { .. } | Topic::TileHeader { .. },
                Message::Header(header),
            ) => {
                let event = self.inbox.on_header(self.now, &topic, *header);
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
            _ => return Err("the message does not match its topic".to_owned()),
        }
        Ok(())
    }

    /// Reports the flight of another device. A node with a list of trusted keys drops flights, because they
    /// are not signed.
    fn receive_flight(&mut self, flight: &FlightCameras<'_>) -> Result<(), String> {
        let Credentials { frame, trusted, .. } = self.inbox.credentials();
        if flight.device == self.identity.device || self.identity.role != Role::Device {
            return Ok(());
        }
        if trusted.is_some() {
            return Err("flights are not signed, and a list of trusted keys is set".to_owned());
        }
        if flight.frame != *frame {
            return Err("the flight is in another world frame".to_owned());
        }
        let cameras = flight.records().map(|record| camera(&record)).collect();
        self.events.push_back(NodeEvent::Flight(flight.device, cameras));
        Ok(())
    }

    fn receive_state(&mut self, state: State) {
        match self.births.record(&state, self.devices_max) {
            Notice::Outdated => return,
            Notice::SameName => self.events.push_back(NodeEvent::SameName(state.device)),
            Notice::TooManyDevices => {
                let (device, devices_max) = (state.device, self.devices_max);
                self.events.push_back(NodeEvent::TooManyDevices { device, devices_max });
            }
            Notice::Valid => {}
        }
        self.events.push_back(NodeEvent::State(state));
    }

    fn receive_reply(&mut self, topic: &Topic, message: &Message<'_>) {
        for uploader in &mut self.uploaders {
            let Some(event) = uploader.on_reply(self.now, topic, message) else { continue };
            let (key, progress) = (uploader.key(), uploader.progress());
            self.events.push_back(match event {
                UploadEvent::Progress => NodeEvent::Progress(key, progress),
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
            Some(InboxEvent::Receiving(header)) => self.events.push_back(NodeEvent::Receiving(header)),
            Some(InboxEvent::Known(header)) => self.events.push_back(NodeEvent::Known(header)),
            Some(InboxEvent::Refused(key, reason)) => {
                self.events.push_back(NodeEvent::Refused { key, reason });
            }
            Some(InboxEvent::BadChunk(..)) | None => {}
        }
    }
}
