//! A client that writes and reads the bytes of MQTT 5 itself, so that it may do what well-behaved clients do not.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

pub(crate) use cosurf_tests::mqtt::{AN_HOUR, Hello, connect, publish, subscribe};

/// Time after which a wait for a packet has failed.
const PATIENCE: Duration = Duration::from_secs(20);

/// A client's connection.
pub(crate) struct Raw {
    stream: TcpStream,
}

impl Raw {
    /// Opens a socket and sends nothing.
    pub(crate) fn silent(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_nodelay(true).unwrap();
        Self { stream }
    }

    /// Connects, and returns the reason code of CONNACK too.
    pub(crate) fn hello(address: SocketAddr, hello: &Hello) -> (Self, u8) {
        let mut raw = Self::silent(address);
        raw.send(&connect(hello));
        let (kind, body) = raw.packet().unwrap_or((0, vec![0, 0xFF]));
        assert!(kind == 0x20 || kind == 0, "{kind:#x} is no CONNACK");
        (raw, body[1])
    }

    /// Whether the broker had a session of the client: connects, and returns that.
    pub(crate) fn resume(address: SocketAddr, hello: &Hello) -> (Self, bool) {
        let mut raw = Self::silent(address);
        raw.send(&connect(hello));
        let (kind, body) = raw.packet().unwrap();
        assert_eq!((kind, body[1]), (0x20, 0));
        (raw, body[0] == 1)
    }

    /// Connects under a client id.
    pub(crate) fn connect(address: SocketAddr, id: &str) -> Self {
        let (raw, code) = Self::hello(address, &Hello { id, ..Hello::default() });
        assert_eq!(code, 0, "{id} is refused");
        raw
    }

    pub(crate) fn send(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).unwrap();
    }

    /// Sends bytes, unless the broker has closed the connection; returns whether they were sent.
    pub(crate) fn try_send(&mut self, bytes: &[u8]) -> bool {
        self.stream.write_all(bytes).is_ok()
    }

    /// Stops sending when the broker does not read for so long.
    pub(crate) fn give_up_after(&self, time: Duration) {
        self.stream.set_write_timeout(Some(time)).unwrap();
        self.stream.set_read_timeout(Some(time)).unwrap();
    }

    /// The next packet: its first byte and its body; `None` at the end of the connection.
    pub(crate) fn packet(&mut self) -> Option<(u8, Vec<u8>)> {
        let (kind, mut length, mut shift) = (self.byte()?, 0, 0);
        loop {
            let byte = self.byte()?;
            length |= usize::from(byte & 0x7F) << shift;
            shift += 7;
            if byte & 0x80 == 0 {
                break;
            }
        }
        let mut body = vec![0; length];
        self.stream.read_exact(&mut body).ok()?;
        Some((kind, body))
    }

    fn byte(&mut self) -> Option<u8> {
        let mut byte = [0];
        match self.stream.read_exact(&mut byte) {
            Ok(()) => Some(byte[0]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                panic!("the broker says nothing for {PATIENCE:?}")
            }
            Err(_) => None,
        }
    }

    /// Publishes with QoS 1, and returns the reason code of the acknowledgement. Other packets are dropped.
    pub(crate) fn publish(&mut self, topic: &str, payload: &[u8], retain: bool) -> u8 {
        self.send(&publish(topic, payload, 1, retain, &[]));
        loop {
            match self.packet().unwrap() {
                (0x40, body) => return body.get(2).copied().unwrap_or(0),
                (0xE0, body) => panic!("disconnected: {body:?}"),
                _ => {}
            }
        }
    }

    /// Subscribes with QoS 1 and waits for the answer, whose reason code it returns.
    pub(crate) fn subscribe(&mut self, filter: &str) -> u8 {
        self.send(&subscribe(filter));
        loop {
            if let (0x90, body) = self.packet().unwrap() {
                return body[3];
            }
        }
    }

    /// The next message: topic and payload. It is acknowledged if it has QoS 1.
    pub(crate) fn message(&mut self) -> (String, Vec<u8>) {
        loop {
            let (kind, body) = self.packet().unwrap();
            assert_ne!(kind, 0xE0, "disconnected: {body:?}");
            if kind >> 4 != 3 {
                continue;
            }
            let length = usize::from(u16::from_be_bytes([body[0], body[1]]));
            let topic = String::from_utf8(body[2..2 + length].to_vec()).unwrap();
            let mut rest = &body[2 + length..];
            if kind & 6 != 0 {
                self.send(&[0x40, 2, rest[0], rest[1]]);
                rest = &rest[2..];
            }
            let properties = usize::from(rest[0]);
            return (topic, rest[1 + properties..].to_vec());
        }
    }

    /// Whether no packet comes for so long.
    pub(crate) fn is_silent_for(&mut self, time: Duration) -> bool {
        self.stream.set_read_timeout(Some(time)).unwrap();
        let read = self.stream.peek(&mut [0]);
        self.stream.set_read_timeout(Some(PATIENCE)).unwrap();
        read.is_err()
    }

    /// Waits for DISCONNECT, and returns its reason code.
    pub(crate) fn farewell(&mut self) -> u8 {
        loop {
            if let (0xE0, body) = self.packet().expect("the connection ends without a reason") {
                return body[0];
            }
        }
    }
}
