//! Broker, gateway and service as devices reach them: over sockets and pseudo-terminals.
#![allow(clippy::unwrap_used)]

mod attacks;
mod broker;
#[cfg(unix)]
mod gateway;
mod raw;
mod replay;
mod station;
