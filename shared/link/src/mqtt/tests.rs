//! The client against brokers that misbehave.
#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::AtomicU32;

use cosurf_wire::{DeviceId, SiteId, Topic};

use super::*;
use crate::identity::{Identity, Role};

/// Publishes that a broker of this sort swallows before it begins to acknowledge.
struct Swallower {
    address: BrokerAddress,
    swallowed: Arc<AtomicU32>,
}

impl Swallower {
    /// The first connection gets no acknowledgement of what it publishes, for ever; later ones do.
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let swallowed = Arc::new(AtomicU32::new(0));
        let count = Arc::clone(&swallowed);
        std::thread::spawn(move || {
            for (visit, stream) in listener.incoming().enumerate() {
                let count = Arc::clone(&count);
                std::thread::spawn(move || serve(stream.unwrap(), (visit == 0).then_some(&*count)));
            }
        });
        let address = BrokerAddress { host: "127.0.0.1".to_owned(), port, is_tls: false };
        Self { address, swallowed }
    }
}

/// As much of MQTT 5 as the client needs to believe in a broker.
fn serve(mut stream: TcpStream, swallow: Option<&AtomicU32>) {
    while let Some((kind, body)) = packet(&mut stream) {
        let answer: Vec<u8> = match kind >> 4 {
            1 => vec![0x20, 3, 0, 0, 0],
            8 => vec![0x90, 5, body[0], body[1], 0, 1, 1],
            12 => vec![0xD0, 0],
            3 => {
                let topic = usize::from(u16::from_be_bytes([body[0], body[1]]));
                match swallow {
                    Some(count) => {
                        count.fetch_add(1, Ordering::Relaxed);
                        continue;
                    }
                    None => vec![0x40, 2, body[topic + 2], body[topic + 3]],
                }
            }
            _ => continue,
        };
        if stream.write_all(&answer).is_err() {
            return;
        }
    }
}

fn packet(stream: &mut TcpStream) -> Option<(u8, Vec<u8>)> {
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

/// A client whose broker takes publishes and never acknowledges them would wait for ever.
#[test]
fn a_stuck_client_is_thrown_away_and_a_new_one_works() {
    let broker = Swallower::start();
    let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
    let identity = Identity { site, device, session: 1, role: Role::Device };
    let config = MqttConfig { broker: broker.address.clone(), identity, tls: None };
    let mut transport = MqttTransport::start(config);
    let patience = Duration::from_secs(20);
    assert_eq!(transport.poll(patience), Some(TransportEvent::Connected));
    let topic = Topic::State { device }.to_text(&site);
    transport.publish(&Outgoing { topic, payload: vec![1], retain: false }).unwrap();
    let event = transport.poll(patience);
    assert!(
        matches!(&event, Some(TransportEvent::Disconnected { reason, .. }) if reason.contains("no acknowledgement")),
        "{event:?}"
    );
    assert!(broker.swallowed.load(Ordering::Relaxed) > 0, "nothing was published");
    assert_eq!(transport.poll(patience), Some(TransportEvent::Connected));
}
