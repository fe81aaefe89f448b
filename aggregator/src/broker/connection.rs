//! One client's connection: its socket, its buffers, and how far it has come.

use std::io::ErrorKind;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{Buf, BytesMut};
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, ConnectReturnCode, Disconnect, DisconnectReasonCode, Packet, Publish,
};

use super::memory::{Budget, Charge};
use super::packet::{self, Hello, Version};
use super::router::hello::KEEP_ALIVE_S_MAX;
use super::socket::Socket;

/// A new client must send CONNECT within this time, however many bytes have arrived.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a connection that ends may take to get the farewell.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(3);
/// A client that accepts no bytes for this long is disconnected.
const WRITE_TIMEOUT: Duration = Duration::from_secs(30);
/// A client that misses messages and has accepted no bytes for this long is disconnected.
pub(super) const STALL_TIMEOUT: Duration = Duration::from_secs(5);
/// A client of MQTT 3.1.1 cannot be told a keep-alive. Without one it may be silent for this long.
const SILENCE_MAX: Duration = Duration::from_secs(3600);
/// Limit on the bytes of CONNECT.
const CONNECT_BYTES_MAX: usize = 16 << 10;
/// Bytes of messages that are collected before they are written.
const BATCH_BYTES: usize = 32 << 10;
/// What a connection takes without its buffers, bytes.
const CONNECTION_BYTES: usize = 1024;
/// Refuses a client that speaks neither MQTT 5 nor MQTT 3.1.1: a CONNACK of MQTT 3.1.1 with the code "unacceptable
/// protocol version".
const REFUSAL: [u8; 4] = [0x20, 0x02, 0x00, 0x01];

/// Where a client comes in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Door {
    /// For everybody.
    Front,
    /// For parts of this program.
    House,
}

/// How far a connection has come.
pub(super) enum Stage {
    /// CONNECT has not arrived.
    Greeting,
    /// The password is being verified.
    Verifying(Box<Hello>),
    /// The client is connected.
    Open {
        version: Version,
        /// Longest time without a byte from the client.
        silence: Duration,
    },
    /// Nothing more is read. The connection ends once the farewell is sent, or at this time.
    Closing(Instant),
}

/// One client's connection.
pub(super) struct Connection {
    pub(super) socket: Socket,
    pub(super) door: Door,
    pub(super) address: IpAddr,
    pub(super) stage: Stage,
    pub(super) opened: Instant,
    /// When the client has last published or acknowledged a message.
    pub(super) useful: Instant,
    /// A message that waits for room at a part of this program, at the latest until the time.
    pub(super) blocked: Option<(Publish, Instant)>,
    /// False once reading would block, until the socket is readable again.
    pub(super) is_readable: bool,
    is_writable: bool,
    heard: Instant,
    written: Instant,
    input: BytesMut,
    output: BytesMut,
    charge: Charge,
}

impl Connection {
    pub(super) fn new(
        socket: Socket,
        door: Door,
        address: IpAddr,
        now: Instant,
        budget: &Arc<Budget>,
    ) -> Self {
        let charge = Charge::new(budget, CONNECTION_BYTES + socket.bytes());
        Self {
            socket,
            door,
            address,
            stage: Stage::Greeting,
            opened: now,
            useful: now,
            blocked: None,
            is_readable: true,
            is_writable: true,
            heard: now,
            written: now,
            input: BytesMut::new(),
            output: BytesMut::new(),
            charge,
        }
    }

    /// Whether the client is connected.
    pub(super) fn is_open(&self) -> bool {
        matches!(self.stage, Stage::Open { .. })
    }

    /// Whether the client's packets wait for something.
    pub(super) fn is_paused(&self) -> bool {
        self.blocked.is_some() || matches!(self.stage, Stage::Verifying(_))
    }

    /// Whether there may be a packet to handle.
    pub(super) fn has_input(&self) -> bool {
        self.is_readable || !self.input.is_empty()
    }

    pub(super) fn set_writable(&mut self) {
        self.is_writable = true;
    }

    /// Reads once, by way of `scratch`. False if the client has gone.
    pub(super) fn read(&mut self, now: Instant, scratch: &mut [u8]) -> bool {
        match self.socket.read(scratch) {
            Ok(0) => return false,
            Ok(bytes) => {
                self.heard = now;
                if !matches!(self.stage, Stage::Closing(_)) {
                    self.input.extend_from_slice(&scratch[..bytes]);
                }
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => self.is_readable = false,
            Err(_) => return false,
        }
        true
    }

    /// Removes the next whole packet from the bytes that have arrived.
    pub(super) fn next_packet(&mut self, bytes_max: usize) -> Result<Option<BytesMut>, DisconnectReasonCode> {
        let bytes_max = if self.is_open() { bytes_max } else { CONNECT_BYTES_MAX };
        let whole = packet::packet_bytes(&self.input, bytes_max)?;
        Ok(whole.filter(|bytes| *bytes <= self.input.len()).map(|bytes| {
            let packet = BytesMut::from(&self.input[..bytes]);
            self.input.advance(bytes);
            packet
        }))
    }

    /// Frees buffers that are not needed, and charges the rest.
    pub(super) fn weigh(&mut self) {
        for buffer in [&mut self.input, &mut self.output] {
            if buffer.is_empty() {
                *buffer = BytesMut::new();
            } else if buffer.capacity() > 4 * buffer.len() + 1024 {
                *buffer = BytesMut::from(&buffer[..]);
            }
        }
        let buffers = self.input.capacity() + self.output.capacity();
        self.charge.resize(CONNECTION_BYTES + self.socket.bytes() + buffers);
    }

    /// Writes until the socket takes no more or `next` has nothing more. `next` adds packets to the buffer, about as
    /// many bytes as it is told. False if the client has gone.
    pub(super) fn write(&mut self, now: Instant, mut next: impl FnMut(usize, &mut BytesMut)) -> bool {
        while self.is_writable {
            if self.output.is_empty() {
                next(BATCH_BYTES, &mut self.output);
            }
            let written = match self.output.is_empty() {
                true => self.socket.flush().map(|()| 0),
                false => self.socket.write(&self.output),
            };
            match written {
                Ok(0) if self.output.is_empty() => break,
                Ok(0) => return false,
                Ok(bytes) => {
                    self.output.advance(bytes);
                    self.written = now;
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => self.is_writable = false,
                Err(_) => return false,
            }
        }
        // Nothing waits: the time until the next bytes are taken begins with them.
        if self.output.is_empty() && self.is_writable {
            self.written = now;
        }
        true
    }

    /// Whether all bytes are sent.
    pub(super) fn is_flushed(&self) -> bool {
        self.output.is_empty() && self.is_writable
    }

    /// Begins to serve the client.
    pub(super) fn open(&mut self, version: Version, keep_alive_s: u16) {
        // MQTT limits silence to 1.5 times the keep-alive.
        let limit = |seconds: u16| Duration::from_millis(1500) * u32::from(seconds);
        let silence = match (version, keep_alive_s) {
            (Version::V3, 0) => SILENCE_MAX,
            (Version::V3, seconds) => limit(seconds),
            (Version::V5, 0) => limit(KEEP_ALIVE_S_MAX),
            (Version::V5, seconds) => limit(seconds.min(KEEP_ALIVE_S_MAX)),
        };
        self.stage = Stage::Open { version, silence };
    }

    /// Answers CONNECT with a refusal.
    pub(super) fn refuse(&mut self, now: Instant, version: Option<Version>, code: ConnectReturnCode) {
        match version {
            Some(version) => {
                let ack = ConnAck { session_present: false, code, properties: None };
                packet::write(&Packet::ConnAck(ack), version, &mut self.output);
            }
            None => self.output.extend_from_slice(&REFUSAL),
        }
        self.stage = Stage::Closing(now + FAREWELL_TIMEOUT);
    }

    /// Ends the connection, with DISCONNECT if the client is connected.
    pub(super) fn close(&mut self, now: Instant, reason_code: DisconnectReasonCode) {
        if let Stage::Open { version, .. } = self.stage {
            let farewell = Packet::Disconnect(Disconnect { reason_code, properties: None });
            packet::write(&farewell, version, &mut self.output);
        }
        self.input = BytesMut::new();
        self.blocked = None;
        self.stage = Stage::Closing(now + FAREWELL_TIMEOUT);
    }

    /// The reason to end the connection now, if there is one. `missed` is the number of messages that the client has
    /// missed.
    pub(super) fn fault(&self, now: Instant, missed: u64) -> Option<Fault> {
        let since = |moment: Instant| now.saturating_duration_since(moment);
        match &self.stage {
            Stage::Greeting if since(self.opened) >= CONNECT_TIMEOUT => Some(Fault::Gone),
            Stage::Closing(until) if now >= *until => Some(Fault::Gone),
            Stage::Open { .. } if missed > 0 && since(self.written.max(self.useful)) >= STALL_TIMEOUT => {
                Some(Fault::Slow)
            }
            Stage::Open { .. } if !self.is_flushed() && since(self.written) >= WRITE_TIMEOUT => {
                Some(Fault::Slow)
            }
            Stage::Open { silence, .. } if since(self.heard) >= *silence => Some(Fault::Silent),
            _ => None,
        }
    }

    pub(super) fn deregister(&mut self, registry: &mio::Registry) {
        self.socket.deregister(registry);
    }
}

/// Why a connection must end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// There is nobody to tell.
    Gone,
    /// The client takes its messages too slowly.
    Slow,
    /// The client was silent for longer than its keep-alive.
    Silent,
}
