//! The socket of one client, with or without TLS. It never blocks.

use std::io::{self, ErrorKind, Read, Write};
use std::net::Shutdown;
use std::sync::Arc;

use mio::net::TcpStream;
use mio::{Interest, Registry, Token};
use rustls::{ServerConfig, ServerConnection};

use super::tls::client_name;

/// Limit on the bytes that the TLS of one connection buffers in each direction.
const TLS_BUFFER_BYTES: usize = 16 << 10;
/// What the TLS of one connection takes, bytes: the buffers, the keys and the client's certificates.
const TLS_BYTES: usize = 2 * TLS_BUFFER_BYTES + (16 << 10);

/// A client's socket.
pub(super) struct Socket {
    stream: TcpStream,
    tls: Option<Box<ServerConnection>>,
}

impl Socket {
    /// Takes an accepted connection and registers it.
    pub(super) fn new(
        mut stream: TcpStream,
        tls: Option<&Arc<ServerConfig>>,
        registry: &Registry,
        token: Token,
    ) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        let tls = tls.map(|config| ServerConnection::new(Arc::clone(config)).map_err(io::Error::other));
        let mut tls = tls.transpose()?.map(Box::new);
        if let Some(tls) = &mut tls {
            tls.set_buffer_limit(Some(TLS_BUFFER_BYTES));
        }
        registry.register(&mut stream, token, Interest::READABLE | Interest::WRITABLE)?;
        Ok(Self { stream, tls })
    }

    /// What the socket takes in memory beside the kernel's share, bytes.
    pub(super) fn bytes(&self) -> usize {
        if self.tls.is_some() { TLS_BYTES } else { 0 }
    }

    /// The common name in the client's certificate.
    pub(super) fn client_name(&self) -> Option<String> {
        self.tls.as_ref().and_then(|tls| client_name(tls))
    }

    /// Reads what has arrived; 0 bytes mean that the client has closed its side. Fails with [`ErrorKind::WouldBlock`]
    /// if nothing has arrived.
    pub(super) fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let Some(tls) = &mut self.tls else { return read(&mut self.stream, buffer) };
        loop {
            match tls.reader().read(buffer) {
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                // The client has closed the connection without the farewell of TLS.
                Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(0),
                read => return read,
            }
            if tls.read_tls(&mut self.stream)? == 0 {
                return Ok(0);
            }
            let processed = tls.process_new_packets();
            // Even after an error there may be an alert to send.
            while tls.wants_write() && tls.write_tls(&mut self.stream).is_ok_and(|bytes| bytes > 0) {}
            processed.map_err(|error| io::Error::new(ErrorKind::InvalidData, error))?;
        }
    }

    /// Writes as much as the socket takes. Fails with [`ErrorKind::WouldBlock`] if it takes nothing.
    pub(super) fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Some(tls) = &mut self.tls else { return write(&mut self.stream, bytes) };
        loop {
            let written = tls.writer().write(bytes)?;
            let sent = flush_tls(tls, &mut self.stream);
            match (written, sent) {
                (0, Ok(())) if !bytes.is_empty() => {}
                (0, Err(error)) => return Err(error),
                (_, Err(error)) if error.kind() != ErrorKind::WouldBlock => return Err(error),
                (written, _) => return Ok(written),
            }
        }
    }

    /// Sends what TLS has buffered. Fails with [`ErrorKind::WouldBlock`] if not all of it could be sent.
    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.tls.as_mut().map_or(Ok(()), |tls| flush_tls(tls, &mut self.stream))
    }

    /// Tells the client that nothing more comes.
    pub(super) fn close_writing(&mut self) {
        if let Some(tls) = &mut self.tls {
            tls.send_close_notify();
            let _ = flush_tls(tls, &mut self.stream);
        }
        let _ = self.stream.shutdown(Shutdown::Write);
    }

    pub(super) fn deregister(&mut self, registry: &Registry) {
        let _ = registry.deregister(&mut self.stream);
    }
}

fn flush_tls(tls: &mut ServerConnection, stream: &mut TcpStream) -> io::Result<()> {
    while tls.wants_write() {
        match tls.write_tls(stream) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Ok(0) => return Err(ErrorKind::WriteZero.into()),
            Ok(_) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

fn read(stream: &mut TcpStream, buffer: &mut [u8]) -> io::Result<usize> {
    loop {
        match stream.read(buffer) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            read => return read,
        }
    }
}

fn write(stream: &mut TcpStream, bytes: &[u8]) -> io::Result<usize> {
    loop {
        match stream.write(bytes) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            written => return written,
        }
    }
}
