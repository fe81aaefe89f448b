//! Sockets and threads: one thread reads from a client, another writes to it.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::BytesMut;
use rumqttc::v5::mqttbytes::v5::{
    ConnAck, Connect, ConnectReturnCode, Disconnect, DisconnectReasonCode, LastWill, Packet, PingResp,
    Publish,
};
use rumqttc::v5::mqttbytes::{Error, QoS};

use super::router::{LinkKey, PACKET_BYTES_MAX, Router, Work};

/// Pause after a failed accept.
pub(super) const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// A new client must send CONNECT within this time.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// A client that accepts no bytes for this long is disconnected.
const WRITE_TIMEOUT: Duration = Duration::from_secs(30);
/// Longest time that a publisher waits for a slow subscriber. After that, the subscriber misses the message.
const BACKPRESSURE_MAX: Duration = Duration::from_secs(5);
/// A waiting thread checks after this time whether its connection still exists.
const CHECK_EVERY: Duration = Duration::from_secs(1);
/// Limit on the bytes per read. The writer also collects messages until they have this many bytes, and
/// then writes them.
const BATCH_BYTES: usize = 128 * 1024;
/// Refuses a client that speaks another version than MQTT 5: a CONNACK of MQTT 3.1.1 with the code
/// "unacceptable protocol version".
const REFUSAL_V4: [u8; 4] = [0x20, 0x02, 0x00, 0x01];
/// DISCONNECT without a reason code, which means a graceful end. The codec of rumqttc cannot parse it.
const SHORT_DISCONNECT: [u8; 2] = [0xE0, 0x00];

/// State that all connections share.
#[derive(Debug)]
pub(super) struct Hub {
    router: Mutex<Router>,
    /// Signalled when a queue may have room again.
    space: Condvar,
}

impl Hub {
    /// See [`Router::new`].
    pub(super) fn new(clients_max: usize) -> Self {
        Self { router: Mutex::new(Router::new(clients_max)), space: Condvar::new() }
    }

    /// Locks the router, even if a thread has panicked while it held the lock: a panic leaves no half-done
    /// change in the router.
    fn router(&self) -> MutexGuard<'_, Router> {
        self.router.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn close_all(&self) {
        self.router().close_all(DisconnectReasonCode::ServerShuttingDown);
    }

    fn wait<'a>(
        &self,
        on: &Condvar,
        guard: MutexGuard<'a, Router>,
        time: Duration,
    ) -> MutexGuard<'a, Router> {
        on.wait_timeout(guard, time).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Queues a message for its subscribers once all of them have room, at the latest after
    /// [`BACKPRESSURE_MAX`]. Then acknowledges it if it has QoS 1.
    fn publish(&self, key: &LinkKey, publish: Publish) {
        let (qos, pkid) = (publish.qos, publish.pkid);
        let until = Instant::now() + BACKPRESSURE_MAX;
        let mut router = self.router();
        while router.is_blocked(key, &publish) {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || !router.is_linked(key) {
                router.give_up_on_blocking(key, &publish);
                break;
            }
            router = self.wait(&self.space, router, left.min(CHECK_EVERY));
        }
        let reason = router.publish(key, publish);
        if qos == QoS::AtLeastOnce {
            router.answer_publish(key, pkid, reason);
        }
    }
}

/// Why reading from a client has ended.
enum End {
    /// The client sent DISCONNECT and does not want its last will published.
    Graceful,
    /// The connection broke or was closed, or DISCONNECT asked the broker to publish the last will.
    Lost,
    /// The client violated the protocol.
    Offence(DisconnectReasonCode),
}

/// Serves one client until it disconnects.
pub(super) fn serve(stream: TcpStream, hub: &Arc<Hub>) {
    // Errors are ignored: if one of these calls fails, the first use of the stream fails too.
    let _ = stream.set_nodelay(true);
    let _ = stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let mut reader = Reader { stream, buffer: BytesMut::new() };
    let Some((connect, will)) = reader.read_connect() else { return };
    let keep_alive = connect.keep_alive;
    let entered = hub.router().connect(Instant::now(), connect, will);
    let (key, work) = match entered {
        Ok(entered) => entered,
        Err(code) => return reader.refuse(code),
    };
    let Ok(stream) = reader.stream.try_clone() else {
        hub.router().disconnect(Instant::now(), &key, false);
        return;
    };
    let (sender, writing_hub) = (key.clone(), Arc::clone(hub));
    let writer = std::thread::spawn(move || write(stream, &writing_hub, &sender, &work));
    // MQTT limits silence to 1.5 times the keep-alive; a keep-alive of 0 means no limit.
    let silence = (keep_alive > 0).then(|| Duration::from_millis(1500) * u32::from(keep_alive));
    let mut visit = Visit { hub, key, is_graceful: false };
    match visit.run(&mut reader, silence) {
        // The writer thread sends the reason. `visit` lives on until then, so that the router keeps the
        // client.
        Some(offence) => hub.router().close(&visit.key, offence),
        None => drop(visit),
    }
    let _ = writer.join();
}

/// One client's connection. Dropping it tells the router that the client is gone, even after a panic of
/// the codec.
struct Visit<'a> {
    hub: &'a Hub,
    key: LinkKey,
    is_graceful: bool,
}

impl Visit<'_> {
    /// Handles the client's packets until it disconnects; returns its offence if it violated the protocol.
    fn run(&mut self, reader: &mut Reader, silence: Option<Duration>) -> Option<DisconnectReasonCode> {
        let _ = reader.stream.set_read_timeout(silence);
        loop {
            match reader.packet().and_then(|packet| self.take(packet)) {
                Ok(()) => {}
                Err(End::Graceful) => {
                    self.is_graceful = true;
                    return None;
                }
                Err(End::Lost) => return None,
                Err(End::Offence(reason)) => return Some(reason),
            }
        }
    }

    fn take(&self, packet: Packet) -> Result<(), End> {
        let mut router = self.hub.router();
        while router.is_flooded(&self.key) {
            router = self.hub.wait(&self.hub.space, router, CHECK_EVERY);
        }
        match packet {
            Packet::Publish(publish) => {
                if let Some(offence) = Router::objection(&publish) {
                    return Err(End::Offence(offence));
                }
                drop(router);
                self.hub.publish(&self.key, publish);
            }
            Packet::PubAck(ack) => {
                router.acknowledge(&self.key, ack.pkid);
                self.hub.space.notify_all();
            }
            Packet::Subscribe(subscribe) => router.subscribe(&self.key, subscribe),
            Packet::Unsubscribe(unsubscribe) => router.unsubscribe(&self.key, unsubscribe),
            Packet::PingReq(_) => router.answer(&self.key, Packet::PingResp(PingResp)),
            Packet::Disconnect(Disconnect { reason_code, .. }) => {
                return Err(match reason_code {
                    DisconnectReasonCode::NormalDisconnection => End::Graceful,
                    _ => End::Lost,
                });
            }
            _ => return Err(End::Offence(DisconnectReasonCode::ProtocolError)),
        }
        Ok(())
    }
}

impl Drop for Visit<'_> {
    fn drop(&mut self) {
        let mut router = self.hub.router();
        router.disconnect(Instant::now(), &self.key, self.is_graceful);
        drop(router);
        self.hub.space.notify_all();
    }
}

/// Writes the router's packets for a connection until the connection ends. Then closes the socket, which
/// also wakes the reader.
fn write(mut stream: TcpStream, hub: &Hub, key: &LinkKey, work: &Condvar) {
    let mut buffer = BytesMut::with_capacity(BATCH_BYTES);
    let mut router = hub.router();
    loop {
        match router.take(key, BATCH_BYTES) {
            Work::Wait => router = hub.wait(work, router, CHECK_EVERY),
            Work::End(reason) => {
                drop(router);
                if let Some(reason_code) = reason {
                    buffer.clear();
                    let farewell = Disconnect { reason_code, properties: None };
                    if farewell.write(&mut buffer).is_ok() {
                        let _ = stream.write_all(&buffer);
                    }
                }
                break;
            }
            Work::Write(packets) => {
                drop(router);
                hub.space.notify_all();
                buffer.clear();
                // Encoding cannot fail: each packet is an answer of this broker or was decoded by the same
                // codec.
                packets.iter().for_each(|packet| {
                    let _ = packet.write(&mut buffer, None);
                });
                if stream.write_all(&buffer).is_err() {
                    break;
                }
                router = hub.router();
            }
        }
    }
    let _ = stream.shutdown(Shutdown::Both);
}

/// Reads packets from a socket.
struct Reader {
    stream: TcpStream,
    buffer: BytesMut,
}

impl Reader {
    /// Reads the first packet, which must be CONNECT.
    fn read_connect(&mut self) -> Option<(Connect, Option<LastWill>)> {
        let _ = self.stream.set_read_timeout(Some(CONNECT_TIMEOUT));
        match self.packet() {
            Ok(Packet::Connect(connect, will, _)) => Some((connect, will)),
            Err(End::Offence(DisconnectReasonCode::ImplementationSpecificError)) => {
                let _ = self.stream.write_all(&REFUSAL_V4);
                None
            }
            _ => None,
        }
    }

    fn refuse(&mut self, code: ConnectReturnCode) {
        let mut buffer = BytesMut::new();
        if (ConnAck { session_present: false, code, properties: None }).write(&mut buffer).is_ok() {
            let _ = self.stream.write_all(&buffer);
        }
    }

    fn packet(&mut self) -> Result<Packet, End> {
        loop {
            if self.buffer.starts_with(&SHORT_DISCONNECT) {
                return Err(End::Graceful);
            }
            match Packet::read(&mut self.buffer, Some(PACKET_BYTES_MAX)) {
                Ok(packet) => return Ok(packet),
                Err(Error::InsufficientBytes(_)) => self.fill()?,
                Err(Error::PayloadSizeLimitExceeded { .. }) => {
                    return Err(End::Offence(DisconnectReasonCode::PacketTooLarge));
                }
                Err(Error::InvalidProtocolLevel(_)) => {
                    return Err(End::Offence(DisconnectReasonCode::ImplementationSpecificError));
                }
                Err(_) => return Err(End::Offence(DisconnectReasonCode::MalformedPacket)),
            }
        }
    }

    fn fill(&mut self) -> Result<(), End> {
        let used = self.buffer.len();
        self.buffer.resize(used + BATCH_BYTES, 0);
        let read = loop {
            match self.stream.read(&mut self.buffer[used..]) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                read => break read,
            }
        };
        self.buffer.truncate(used + *read.as_ref().unwrap_or(&0));
        match read {
            Ok(0) => Err(End::Lost),
            Ok(_) => Ok(()),
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {
                Err(End::Offence(DisconnectReasonCode::KeepAliveTimeout))
            }
            Err(_) => Err(End::Lost),
        }
    }
}
