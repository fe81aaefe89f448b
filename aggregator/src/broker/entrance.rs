//! Where clients come in: listening sockets.

use std::io;
use std::sync::Arc;

use mio::Token;
use mio::net::TcpListener;
use rustls::ServerConfig;

use super::connection::Door;

/// A listening socket.
pub(super) struct Entrance {
    pub(super) listener: TcpListener,
    pub(super) token: Token,
    pub(super) door: Door,
    pub(super) tls: Option<Arc<ServerConfig>>,
    /// Whether connections may wait to be accepted.
    pub(super) is_ready: bool,
}

/// Limit on connections that are no clients: they have not said hello, or they are about to end.
pub(super) fn guests_max(clients_max: usize) -> usize {
    clients_max / 8 + 16
}

/// Whether no connection can be accepted because too many files are open.
pub(super) fn descriptors_are_lacking(error: &io::Error) -> bool {
    // EMFILE and ENFILE have no kind of their own.
    cfg!(unix) && matches!(error.raw_os_error(), Some(23 | 24))
}
