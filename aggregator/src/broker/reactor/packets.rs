//! What a client's packets do.

use std::time::{Duration, Instant};

use bytes::BytesMut;
use cosurf_wire::DeviceId;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{
    ConnectReturnCode, Disconnect, DisconnectReasonCode, Packet, PingResp, PubRecReason, Publish, Subscribe,
};

use super::super::access::{Job, Verdict};
use super::super::client::User;
use super::super::connection::{Door, Stage};
use super::super::event::BrokerEvent;
use super::super::packet::{self, Hello, Version};
use super::super::router::hello::{IN_FLIGHT_MAX, name};
use super::super::router::{PACKET_BYTES_MAX, Router, Taken};
use super::Reactor;

/// Longest time that a publisher waits for a part of this program. After that, the part misses the message.
const BACKPRESSURE_MAX: Duration = Duration::from_secs(5);
/// Limit on messages of QoS 2 that a client of MQTT 3.1.1 has not released. One of MQTT 5 is told its limit.
const UNRELEASED_MAX: usize = 4096;

impl<S: Fn(BrokerEvent)> Reactor<S> {
    /// Handles the packets that have arrived, until one of them must wait. Returns whether the connection's time ended
    /// before that.
    pub(super) fn digest(&mut self, token: usize, now: Instant, until: Instant) -> bool {
        while let Some(connection) = self.connections.get_mut(&token) {
            if connection.is_paused()
                || matches!(connection.stage, Stage::Closing(_))
                || self.router.is_flooded(token)
            {
                return false;
            }
            let version = match connection.stage {
                Stage::Open { version, .. } => Some(version),
                _ => None,
            };
            match (connection.next_packet(PACKET_BYTES_MAX), version) {
                (Ok(None), _) => return false,
                (Ok(Some(packet)), None) => self.greet(token, now, &packet),
                (Ok(Some(packet)), Some(version)) => self.handle(token, now, &packet, version),
                (Err(reason), _) => self.close(token, now, reason),
            }
            if Instant::now() >= until {
                return true;
            }
        }
        false
    }

    /// Handles the first packet of a connection.
    fn greet(&mut self, token: usize, now: Instant, packet: &[u8]) {
        let Some(version) = packet::version_of(packet) else {
            return match packet.first() {
                Some(0x10) => self.refuse(token, now, None, ConnectReturnCode::UnsupportedProtocolVersion),
                _ => self.end(token, now, false),
            };
        };
        let Some(mut hello) = packet::read_hello(packet, version) else { return self.end(token, now, false) };
        let Some(connection) = self.connections.get_mut(&token) else { return };
        let login = hello.login.take();
        let verdict = match connection.door {
            Door::House => self.access.judge_house(login.as_ref()),
            Door::Front => self.access.judge(login, connection.socket.client_name().as_deref()),
        };
        match verdict {
            Verdict::Accept(user) => self.welcome(token, now, hello, user),
            Verdict::Verify { user, password, .. } if self.verifier.remembers(&user, &password) => {
                self.welcome(token, now, hello, User::Named(user.as_str().into()));
            }
            Verdict::Verify { user, password, hash } => {
                connection.stage = Stage::Verifying(Box::new(hello));
                let address = connection.address;
                if let Some(lost) = self.verifier.ask(Job { link: token, address, user, password, hash }) {
                    self.refuse(lost, now, None, ConnectReturnCode::ServerBusy);
                }
            }
            Verdict::Refuse => self.refuse(token, now, Some(version), ConnectReturnCode::NotAuthorized),
        }
    }

    /// Goes on with a connection whose password was verified.
    pub(super) fn verified(
        &mut self,
        token: usize,
        now: Instant,
        user: DeviceId,
        fingerprint: Option<blake3::Hash>,
    ) {
        if let Some(fingerprint) = fingerprint {
            let address = self.connections.get(&token).map(|connection| connection.address);
            self.verifier.remember(user, fingerprint, address);
        }
        let Some(connection) = self.connections.get_mut(&token) else { return };
        match std::mem::replace(&mut connection.stage, Stage::Greeting) {
            Stage::Verifying(hello) if fingerprint.is_some() => {
                self.welcome(token, now, *hello, User::Named(user.as_str().into()));
                self.turns.insert(token);
            }
            Stage::Verifying(hello) => {
                self.refuse(token, now, Some(hello.version), ConnectReturnCode::NotAuthorized);
            }
            stage => connection.stage = stage,
        }
    }

    /// Connects a client that may connect, if there is a place for it.
    fn welcome(&mut self, token: usize, now: Instant, hello: Hello, user: User) {
        let version = hello.version;
        if self.is_revoked(&user) {
            return self.refuse(token, now, Some(version), ConnectReturnCode::NotAuthorized);
        }
        let keep_alive_s = hello.connect.keep_alive;
        let client = match name(&hello, user, token) {
            Ok(client) => client,
            Err(code) => return self.refuse(token, now, Some(version), code),
        };
        if !self.admit(token, &client, now) {
            return self.refuse(token, now, Some(version), ConnectReturnCode::QuotaExceeded);
        }
        match self.router.connect(token, now, &client, hello) {
            Err(code) => self.refuse(token, now, Some(version), code),
            Ok(older) => {
                if let Some(connection) = self.connections.get_mut(&token) {
                    connection.open(version, keep_alive_s);
                }
                if let Some(older) = older {
                    self.close(older, now, DisconnectReasonCode::SessionTakenOver);
                }
            }
        }
    }

    /// Answers CONNECT with a refusal. `version` is that of the client, if it is known and its password is not being
    /// verified.
    fn refuse(&mut self, token: usize, now: Instant, version: Option<Version>, code: ConnectReturnCode) {
        if let Some(connection) = self.connections.get_mut(&token) {
            let version = match &connection.stage {
                Stage::Verifying(hello) => Some(hello.version),
                _ => version,
            };
            connection.refuse(now, version, code);
            self.write(token, now);
        }
    }

    /// Handles a packet of a connected client.
    fn handle(&mut self, token: usize, now: Instant, packet: &BytesMut, version: Version) {
        match packet::read(packet, version) {
            Ok(Packet::Publish(publish)) => match self.objection(token, &publish, version) {
                None => self.hand_on(token, now, publish, now + BACKPRESSURE_MAX),
                Some(reason) => self.close(token, now, reason),
            },
            Ok(Packet::PubAck(ack)) => {
                self.router.acknowledge(token, ack.pkid);
                self.note_use(token, now);
            }
            Ok(Packet::PubRec(ack)) => {
                let is_taken =
                    matches!(ack.reason, PubRecReason::Success | PubRecReason::NoMatchingSubscribers);
                self.router.release(token, ack.pkid, is_taken);
                self.note_use(token, now);
            }
            Ok(Packet::PubRel(ack)) => self.router.complete(token, ack.pkid),
            Ok(Packet::PubComp(ack)) => self.router.finish(token, ack.pkid),
            Ok(Packet::Subscribe(subscribe)) if is_identified_by_0(&subscribe) => {
                self.close(token, now, DisconnectReasonCode::ProtocolError);
            }
            Ok(Packet::Subscribe(subscribe)) => self.router.subscribe(token, now, subscribe),
            Ok(Packet::Unsubscribe(unsubscribe)) => self.router.unsubscribe(token, unsubscribe),
            Ok(Packet::PingReq(_)) => self.router.answer(token, Packet::PingResp(PingResp)),
            Ok(Packet::Disconnect(disconnect)) => self.take_leave(token, now, &disconnect),
            Ok(_) => self.close(token, now, DisconnectReasonCode::ProtocolError),
            Err(reason) => self.close(token, now, reason),
        }
    }

    /// The reason to end the connection because of a message, if there is one.
    fn objection(
        &mut self,
        token: usize,
        publish: &Publish,
        version: Version,
    ) -> Option<DisconnectReasonCode> {
        let unreleased_max = match version {
            Version::V3 => UNRELEASED_MAX,
            Version::V5 => usize::from(IN_FLIGHT_MAX),
        };
        let has_id = publish.qos == QoS::AtMostOnce || publish.pkid != 0;
        if publish.qos == QoS::ExactlyOnce && self.router.unreleased(token) >= unreleased_max {
            return Some(DisconnectReasonCode::ReceiveMaximumExceeded);
        }
        Router::objection(publish).or((!has_id).then_some(DisconnectReasonCode::ProtocolError))
    }

    /// Gives a message to the router, or keeps it until there is room for it.
    pub(super) fn hand_on(&mut self, token: usize, now: Instant, publish: Publish, until: Instant) {
        if self.router.receive(token, now, &publish, now >= until) == Taken::Queued {
            return self.note_use(token, now);
        }
        if let Some(connection) = self.connections.get_mut(&token) {
            connection.blocked = Some((publish, until));
            self.blocked.push_back(token);
        }
    }

    fn note_use(&mut self, token: usize, now: Instant) {
        if let Some(connection) = self.connections.get_mut(&token) {
            connection.useful = now;
        }
    }

    /// Handles DISCONNECT.
    fn take_leave(&mut self, token: usize, now: Instant, disconnect: &Disconnect) {
        let expiry = disconnect.properties.as_ref().and_then(|properties| properties.session_expiry_interval);
        if expiry.is_some_and(|seconds| !self.router.set_expiry(token, seconds)) {
            return self.close(token, now, DisconnectReasonCode::ProtocolError);
        }
        self.end(token, now, disconnect.reason_code == DisconnectReasonCode::NormalDisconnection);
    }
}

fn is_identified_by_0(subscribe: &Subscribe) -> bool {
    subscribe.properties.as_ref().is_some_and(|properties| properties.id == Some(0))
}
