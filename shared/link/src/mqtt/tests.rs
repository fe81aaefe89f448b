//! The client with a broker that does not acknowledge messages, and the parsing of addresses.
#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use cosurf_wire::{DeviceId, ModelId, SiteId, Topic};

use super::*;
use crate::identity::{Identity, Role};

/// A broker that does not acknowledge the messages of its first connection.
struct SilentBroker {
    address: BrokerAddress,
    /// Number of messages that the broker received and did not acknowledge.
    unacknowledged: Arc<AtomicU32>,
}

impl SilentBroker {
    /// Starts the broker on a free port.
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let unacknowledged = Arc::new(AtomicU32::new(0));
        let count = Arc::clone(&unacknowledged);
        std::thread::spawn(move || {
            for (connection, stream) in listener.incoming().enumerate() {
                let count = Arc::clone(&count);
                std::thread::spawn(move || serve(stream.unwrap(), (connection == 0).then_some(&*count)));
            }
        });
        let address = BrokerAddress::plain("127.0.0.1", port);
        Self { address, unacknowledged }
    }
}

/// Serves the part of MQTT 5 that the client needs. If `unacknowledged` is given, published messages are
/// counted in it and not acknowledged.
fn serve(mut stream: TcpStream, unacknowledged: Option<&AtomicU32>) {
    while let Some((kind, body)) = read_packet(&mut stream) {
        let answer: Vec<u8> = match kind >> 4 {
            1 => vec![0x20, 3, 0, 0, 0],
            8 => vec![0x90, 5, body[0], body[1], 0, 1, 1],
            12 => vec![0xD0, 0],
            3 => match unacknowledged {
                Some(count) => {
                    count.fetch_add(1, Ordering::Relaxed);
                    continue;
                }
                None => acknowledgement(&body),
            },
            _ => continue,
        };
        if stream.write_all(&answer).is_err() {
            return;
        }
    }
}

fn read_packet(stream: &mut TcpStream) -> Option<(u8, Vec<u8>)> {
    let mut byte = [0];
    stream.read_exact(&mut byte).ok()?;
    let (kind, mut length, mut shift) = (byte[0], 0, 0);
    loop {
        stream.read_exact(&mut byte).ok()?;
        length |= usize::from(byte[0] & 0x7F) << shift;
        shift += 7;
        if byte[0] & 0x80 == 0 {
            break;
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).ok()?;
    Some((kind, body))
}

/// Without the watchdog, a client whose messages are never acknowledged would wait for ever.
#[test]
fn a_client_without_acknowledgements_is_replaced() {
    let broker = SilentBroker::start();
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let identity = Identity { site, device, session: 1, role: Role::Device };
    let config = MqttConfig { broker: broker.address.clone(), identity, will: None, tls: None, login: None };
    let mut transport = MqttTransport::start(config);
    let timeout = Duration::from_secs(20);
    assert_eq!(transport.poll(timeout), Some(TransportEvent::Connected));
    let topic = Topic::State { device }.to_text(&site);
    transport.publish(&Outgoing { topic, payload: vec![1], retain: false }).unwrap();
    let event = transport.poll(timeout);
    assert!(
        matches!(&event, Some(TransportEvent::Disconnected { reason, .. }) if reason.contains("no acknowledgement")),
        "{event:?}"
    );
    assert!(broker.unacknowledged.load(Ordering::Relaxed) > 0, "nothing was published");
    assert_eq!(transport.poll(timeout), Some(TransportEvent::Connected));
}

/// Sends messages to a client without a pause until it has gone.
fn flood(mut stream: TcpStream) {
    let _ = read_packet(&mut stream);
    let _ = stream.write_all(&[0x20, 3, 0, 0, 0]);
    let Some((_, body)) = read_packet(&mut stream) else { return };
    let _ = stream.write_all(&[0x90, 5, body[0], body[1], 0, 1, 1]);
    while stream.write_all(&[0x30, 4, 0, 1, b't', 0]).is_ok() {
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A drone that connects, and where its connections arrive.
fn drone() -> (TcpListener, MqttTransport) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let broker = BrokerAddress::plain("127.0.0.1", listener.local_addr().unwrap().port());
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let identity = Identity { site, device, session: 1, role: Role::Device };
    let config = MqttConfig { broker, identity, will: None, tls: None, login: None };
    (listener, MqttTransport::start(config))
}

/// A message of that drone.
fn state(payload: u8) -> Outgoing {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let topic = Topic::State { device }.to_text(&site);
    Outgoing { topic, payload: vec![payload], retain: false }
}

/// The PUBACK for a message with this body.
fn acknowledgement(body: &[u8]) -> Vec<u8> {
    let topic = usize::from(u16::from_be_bytes([body[0], body[1]]));
    vec![0x40, 2, body[topic + 2], body[topic + 3]]
}

/// A drone's connection to a broker that serves only it.
fn drone_served_by(serve: fn(TcpStream)) -> MqttTransport {
    let (listener, transport) = drone();
    std::thread::spawn(move || serve(listener.accept().unwrap().0));
    transport
}

/// A stranger who never stops talking does not keep a client from ending.
#[test]
fn a_client_ends_although_messages_come_without_a_pause() {
    let mut transport = drone_served_by(flood);
    let timeout = Duration::from_secs(20);
    assert_eq!(transport.poll(timeout), Some(TransportEvent::Connected));
    assert!(matches!(transport.poll(timeout), Some(TransportEvent::Incoming { .. })));
    let (say, ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        drop(transport);
        say.send(()).unwrap();
    });
    assert!(ended.recv_timeout(Duration::from_secs(10)).is_ok(), "the client does not end");
}

#[test]
fn an_address_is_written_as_a_url_that_reads_back() {
    for (text, url) in [
        ("host", "mqtt://host:1883"),
        ("10.0.0.2:7", "mqtt://10.0.0.2:7"),
        ("mqtts://host/", "mqtts://host:8883"),
        ("mqtt://[::1]:7", "mqtt://[::1]:7"),
        ("wss://host", "wss://host:443/mqtt"),
        ("ws://[::1]:9001/", "ws://[::1]:9001/"),
        ("ws://host/a/b?c", "ws://host:80/a/b?c"),
    ] {
        let address: BrokerAddress = text.parse().unwrap();
        assert_eq!(String::from(address.clone()), url);
        assert_eq!(url.parse(), Ok(address));
    }
    for text in ["mqtt://host/path", "http://host", "ws://host/a b", "user@host", "mqtt://", "host:70000"] {
        assert!(text.parse::<BrokerAddress>().is_err(), "{text}");
    }
}

/// On a slow line, what the broker has kept for a session comes before the grant of its subscriptions.
#[test]
fn a_client_with_a_session_publishes_before_its_subscriptions_are_granted_again() {
    for (has_session, is_ready) in [(1, true), (0, false)] {
        let (listener, mut transport) = drone();
        let (mut stream, _) = listener.accept().unwrap();
        assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 1);
        stream.write_all(&[0x20, 3, has_session, 0, 0]).unwrap();
        assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 8, "it subscribes in any case");
        let event = transport.poll(Duration::from_millis(if is_ready { 20_000 } else { 300 }));
        assert_eq!(event, is_ready.then_some(TransportEvent::Connected));
        let published = transport.publish(&state(1));
        if is_ready {
            published.unwrap();
            assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 3);
        }
    }
}

/// On a slow line that breaks each second, a subscription at each connection would take the time of other messages.
#[test]
fn a_client_that_is_soon_back_in_its_session_does_not_subscribe_again() {
    let (listener, mut transport) = drone();
    let mut published = 0;
    // Twice in its session, once in another one.
    for (has_session, subscribes) in [(0, true), (1, false), (1, false), (0, true)] {
        let (mut stream, _) = listener.accept().unwrap();
        assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 1);
        stream.write_all(&[0x20, 3, has_session, 0, 0]).unwrap();
        if subscribes {
            let (kind, body) = read_packet(&mut stream).unwrap();
            assert_eq!(kind >> 4, 8);
            stream.write_all(&[0x90, 5, body[0], body[1], 0, 1, 1]).unwrap();
        }
        let is_up = |event| matches!(event, TransportEvent::Connected | TransportEvent::Resumed { .. });
        while !is_up(transport.poll(Duration::from_secs(20)).expect("no connection")) {}
        published += 1;
        transport.publish(&state(published)).unwrap();
        let (kind, body) = read_packet(&mut stream).unwrap();
        assert_eq!(kind >> 4, 3, "a message, and no subscription before it");
        stream.write_all(&acknowledgement(&body)).unwrap();
        while transport.client.pending() > 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        if published == 3 {
            // A broker that was restarted may have an older session, without them.
            assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 8, "after a while it subscribes again");
        }
    }
}

/// The broker has what it acknowledged. Of the rest, a client tells which chunks may be lost, if the session was kept.
#[test]
fn a_client_that_is_back_in_its_session_tells_which_chunks_may_be_lost() {
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let chunks = [0, 1, 2].map(|index| Topic::LocalChunk { device, model: ModelId(1), index }.to_text(&site));
    let lost = chunks[1..].iter().map(|topic| topic.as_str().to_owned()).collect();
    for (keeps_session, event) in
        [(true, TransportEvent::Resumed { lost }), (false, TransportEvent::Connected)]
    {
        let (listener, mut transport) = drone();
        let begin = |has_session: bool| {
            let (mut stream, _) = listener.accept().unwrap();
            assert_eq!(read_packet(&mut stream).unwrap().0 >> 4, 1);
            stream.write_all(&[0x20, 3, has_session.into(), 0, 0]).unwrap();
            if !has_session {
                let (_, body) = read_packet(&mut stream).unwrap();
                stream.write_all(&[0x90, 5, body[0], body[1], 0, 1, 1]).unwrap();
            }
            stream
        };
        let mut stream = begin(false);
        assert_eq!(transport.poll(Duration::from_secs(20)), Some(TransportEvent::Connected));
        for topic in chunks.clone() {
            transport.publish(&Outgoing { topic, payload: vec![7], retain: false }).unwrap();
        }
        let (_, body) = read_packet(&mut stream).unwrap();
        stream.write_all(&acknowledgement(&body)).unwrap();
        while transport.client.acknowledged() == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        drop(stream);
        let broken = transport.poll(Duration::from_secs(20));
        assert!(matches!(broken, Some(TransportEvent::Disconnected { .. })), "{broken:?}");
        let _stream = begin(keeps_session);
        assert_eq!(transport.poll(Duration::from_secs(20)), Some(event));
    }
}

/// Serves each connection up to the grant of its subscriptions, and ends it after `life`. Returns the number of connections
/// within `time`, and what the client tells.
fn connections_that_end_after(life: Duration, time: Duration) -> (u32, Vec<TransportEvent>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = BrokerAddress::plain("127.0.0.1", listener.local_addr().unwrap().port());
    let count = Arc::new(AtomicU32::new(0));
    let counted = Arc::clone(&count);
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            counted.fetch_add(1, Ordering::Relaxed);
            let mut stream = stream.unwrap();
            read_packet(&mut stream).unwrap();
            stream.write_all(&[0x20, 3, 0, 0, 0]).unwrap();
            let (_, body) = read_packet(&mut stream).unwrap();
            stream.write_all(&[0x90, 5, body[0], body[1], 0, 1, 1]).unwrap();
            std::thread::sleep(life);
        }
    });
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let identity = Identity { site, device, session: 1, role: Role::Device };
    let mut transport =
        MqttTransport::start(MqttConfig { broker: address, identity, will: None, tls: None, login: None });
    let end = std::time::Instant::now() + time;
    let left = || end.checked_duration_since(std::time::Instant::now());
    let told = std::iter::from_fn(|| transport.poll(left()?)).collect();
    (count.load(Ordering::Relaxed), told)
}

/// As of two programs of one name, whose broker ends the older connection of each without a reason.
#[test]
fn connections_that_break_at_once_get_rarer_and_the_reason_is_told() {
    let (count, told) = connections_that_end_after(Duration::ZERO, Duration::from_secs(2));
    assert!((4..=7).contains(&count), "{count} connections: {told:?}");
    let lost = |event: &TransportEvent| match event {
        TransportEvent::Disconnected { attempt, reason } => Some((*attempt, reason.contains("same name"))),
        _ => None,
    };
    let lost: Vec<_> = told.iter().filter_map(lost).collect();
    assert!(lost.iter().zip(1..).all(|(&(attempt, _), number)| attempt == number), "{lost:?}");
    assert!(!lost[0].1 && lost[2..].iter().all(|&(_, is_told)| is_told), "{lost:?}");
}

/// A line that breaks again and again is used again at once.
#[test]
fn connections_that_last_a_moment_do_not_get_rarer() {
    let (count, told) = connections_that_end_after(Duration::from_millis(200), Duration::from_secs(2));
    assert!(count >= 6, "{count} connections: {told:?}");
    let is_first = |event: &TransportEvent| match event {
        TransportEvent::Disconnected { attempt, reason } => {
            *attempt == 1 && reason.ends_with("connection lost")
        }
        _ => true,
    };
    assert!(told.iter().all(is_first), "{told:?}");
}

/// Breaks twice within the first message: a message that the line cannot carry keeps back all that follow.
#[test]
fn a_client_drops_a_session_whose_first_message_never_gets_through() {
    let (listener, _transport) = drone();
    let message = [0x32, 8, 0, 1, b't', 0, 7, 0, b'x', b'y'];
    // Then a connection over which the message arrives, and a first one that breaks again.
    for (i, (sent, is_anew)) in [(5, false), (5, false), (10, true), (5, false)].into_iter().enumerate() {
        let (mut stream, _) = listener.accept().unwrap();
        let (_, hello) = read_packet(&mut stream).unwrap();
        assert_eq!(hello[7] & 2 != 0, is_anew, "connection {i}");
        stream.write_all(&[0x20, 3, u8::from(!is_anew), 0, 0]).unwrap();
        read_packet(&mut stream).unwrap();
        stream.write_all(&message[..sent]).unwrap();
        std::thread::sleep(Duration::from_millis(200));
    }
}

/// Serves a client whose session the broker has kept: a request for chunks comes first, and another one after the
/// acknowledgement of the client's first message.
fn serve_kept_session(mut stream: TcpStream) {
    let want = |number: u8| {
        let topic = b"gs/v1/site/drone/dn/want";
        let mut packet = vec![0x30, topic.len() as u8 + 4, 0, topic.len() as u8];
        packet.extend_from_slice(topic);
        packet.extend([0, number]);
        packet
    };
    while let Some((kind, body)) = read_packet(&mut stream) {
        let answer = match kind >> 4 {
            1 => [vec![0x20, 3, 1, 0, 0], want(1)].concat(),
            3 => [acknowledgement(&body), want(2)].concat(),
            _ => continue,
        };
        if stream.write_all(&answer).is_err() {
            return;
        }
    }
}

/// A request from before the break does not know of the chunks that arrived after it.
#[test]
fn requests_that_a_broker_kept_while_the_client_was_away_are_dropped() {
    let mut transport = drone_served_by(serve_kept_session);
    let timeout = Duration::from_secs(20);
    assert_eq!(transport.poll(timeout), Some(TransportEvent::Connected));
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let topic = Topic::State { device }.to_text(&site);
    transport.publish(&Outgoing { topic, payload: vec![1], retain: false }).unwrap();
    let event = transport.poll(timeout);
    assert!(matches!(&event, Some(TransportEvent::Incoming { payload, .. }) if payload == &[2]), "{event:?}");
}
