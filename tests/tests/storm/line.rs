//! An attacker's connection: it sends any bytes, and never waits long for the broker.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use cosurf_tests::mqtt::{Hello, connect};

/// Longest wait for the broker to take bytes, or to answer CONNECT.
const WAIT: Duration = Duration::from_secs(1);

/// An attacker's connection.
pub(crate) struct Line {
    stream: TcpStream,
    /// Bytes that have arrived and are no whole packet yet.
    input: Vec<u8>,
}

impl Line {
    /// Opens a socket and sends nothing.
    pub(crate) fn silent(address: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect_timeout(&address, WAIT)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WAIT))?;
        stream.set_read_timeout(Some(WAIT))?;
        Ok(Self { stream, input: Vec::new() })
    }

    /// Connects as a client. An error if the broker refuses it.
    pub(crate) fn open(address: SocketAddr, hello: &Hello) -> io::Result<Self> {
        let mut line = Self::silent(address)?;
        line.send(&connect(hello))?;
        let mut answer = [0; 4];
        line.stream.read_exact(&mut answer)?;
        if answer[0] != 0x20 || answer[3] != 0 {
            return Err(io::Error::new(ErrorKind::ConnectionRefused, format!("CONNACK {answer:x?}")));
        }
        // The rest of CONNACK; its length takes one byte.
        line.stream.read_exact(&mut vec![0; usize::from(answer[1]) - 2])?;
        Ok(line)
    }

    pub(crate) fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.stream.write_all(bytes)
    }

    /// Drops what has arrived, so that the broker does not take the attacker for a slow client.
    pub(crate) fn discard(&mut self) -> io::Result<()> {
        self.receive()?;
        self.input.clear();
        Ok(())
    }

    /// The messages that have arrived: topic and payload. They are acknowledged.
    pub(crate) fn messages(&mut self) -> io::Result<Vec<(String, Vec<u8>)>> {
        self.receive()?;
        let mut messages = Vec::new();
        while let Some((first, body)) = self.packet() {
            if first >> 4 != 3 || body.len() < 2 {
                continue;
            }
            let (length, rest) = body.split_at(2);
            let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
            let Some((topic, mut rest)) = rest.split_at_checked(length) else { continue };
            if first & 6 != 0 && rest.len() > 2 {
                self.send(&[0x40, 2, rest[0], rest[1]])?;
                rest = &rest[2..];
            }
            let properties = usize::from(rest.first().copied().unwrap_or(0));
            let payload = rest.get(1 + properties..).unwrap_or_default();
            messages.push((String::from_utf8_lossy(topic).into_owned(), payload.to_vec()));
        }
        Ok(messages)
    }

    /// Reads what has arrived, without waiting. An error at the end of the connection.
    fn receive(&mut self) -> io::Result<()> {
        self.stream.set_nonblocking(true)?;
        let mut buffer = [0; 16 << 10];
        let outcome = loop {
            match self.stream.read(&mut buffer) {
                Ok(0) => break Err(ErrorKind::UnexpectedEof.into()),
                Ok(bytes) => self.input.extend_from_slice(&buffer[..bytes]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break Ok(()),
                Err(error) => break Err(error),
            }
        };
        self.stream.set_nonblocking(false)?;
        outcome
    }

    /// Removes the next whole packet from what has arrived: its first byte and its body.
    fn packet(&mut self) -> Option<(u8, Vec<u8>)> {
        let first = *self.input.first()?;
        let (mut length, mut at) = (0, 1);
        loop {
            let byte = *self.input.get(at)?;
            length |= usize::from(byte & 0x7F) << (7 * (at - 1));
            at += 1;
            if byte & 0x80 == 0 || at > 4 {
                break;
            }
        }
        let body = self.input.get(at..at + length)?.to_vec();
        self.input.drain(..at + length);
        Some((first, body))
    }
}
