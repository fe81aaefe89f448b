//! Broker, gateway and service as devices reach them: over sockets and pseudo-terminals.
#![allow(clippy::unwrap_used)]

mod broker;
#[cfg(unix)]
mod gateway;
mod replay;
mod station;
