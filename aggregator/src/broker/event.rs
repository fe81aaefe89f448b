//! What a broker reports, and how often.

use std::fmt;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use cosurf_contract::{Escaped, counted};
use serde::Serialize;

/// Events of the same kind are reported at most once in this time.
const QUIET: Duration = Duration::from_secs(60);

/// What a broker reports. Each kind is reported at most once a minute.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum BrokerEvent {
    /// A client is refused because too many are connected.
    #[serde(rename = "broker_full")]
    Full {
        /// The limit on clients.
        clients_max: usize,
    },
    /// Messages were dropped or refused because the memory is full.
    #[serde(rename = "broker_memory_full")]
    MemoryFull {
        /// The limit, bytes.
        memory_bytes: usize,
        /// Messages that were dropped or refused since the last report.
        dropped: u64,
    },
    /// A client takes its messages too slowly and is disconnected.
    #[serde(rename = "broker_slow_client")]
    Slow {
        /// The client's id.
        client: String,
    },
    /// The broker accepts everybody who reaches it from other computers.
    #[serde(rename = "broker_open")]
    Open {
        /// The address on which it listens.
        address: SocketAddr,
    },
    /// The operating system allows fewer open files than `clients_max` needs.
    #[serde(rename = "broker_few_files")]
    FewFiles {
        /// The limit on clients as configured.
        wanted: usize,
        /// The limit on clients that is used instead.
        clients_max: usize,
    },
}

impl fmt::Display for BrokerEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Full { clients_max } => {
                write!(
                    f,
                    "broker: a client is refused: {clients_max} clients are connected; raise `clients_max`"
                )
            }
            Self::MemoryFull { memory_bytes, dropped } => write!(
                f,
                "broker: its memory of {} MiB is full: {} dropped or refused; raise `broker_memory`, or find the \
                 client that publishes so much",
                memory_bytes >> 20,
                counted(*dropped, "message")
            ),
            Self::Slow { client } => {
                write!(f, "broker: {} takes its messages too slowly and is disconnected", Escaped(client))
            }
            Self::Open { address } => write!(
                f,
                "broker: WARNING: everybody who reaches {address} can read and send everything; set `users` or `tls`"
            ),
            Self::FewFiles { wanted, clients_max } => write!(
                f,
                "broker: only {clients_max} of {wanted} clients may connect, because of the limit on open files; raise \
                 it (`ulimit -n`)"
            ),
        }
    }
}

/// Reports events, each kind at most once a minute.
pub(super) struct Teller<S> {
    say: S,
    told: [Option<Instant>; 5],
}

impl<S: Fn(BrokerEvent)> Teller<S> {
    pub(super) fn new(say: S) -> Self {
        Self { say, told: [None; 5] }
    }

    /// Reports an event, unless one of its kind was reported a short time ago; returns whether it did.
    pub(super) fn tell(&mut self, now: Instant, event: BrokerEvent) -> bool {
        let kind = match &event {
            BrokerEvent::Full { .. } => 0,
            BrokerEvent::MemoryFull { .. } => 1,
            BrokerEvent::Slow { .. } => 2,
            BrokerEvent::Open { .. } => 3,
            BrokerEvent::FewFiles { .. } => 4,
        };
        let is_due = self.told[kind].is_none_or(|at| now.saturating_duration_since(at) >= QUIET);
        if is_due {
            self.told[kind] = Some(now);
            (self.say)(event);
        }
        is_due
    }
}
