//! Broker, gateway and service as devices reach them: over sockets and pseudo-terminals.
#![allow(clippy::unwrap_used)]

mod access;
mod attacks;
mod broker;
#[cfg(unix)]
mod died;
#[cfg(unix)]
mod gateway;
mod ground;
mod protocol;
mod raw;
mod replay;
mod station;
mod users;
