//! The broker's thread: it waits for sockets, reads packets, hands them to the router and writes what the router has
//! for each client. No client is waited for.

mod doors;
mod packets;
mod slots;
mod turns;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use cosurf_wire::DeviceId;
use mio::{Events, Poll, Token};
use rumqttc::v5::mqttbytes::v5::DisconnectReasonCode;

use super::access::{Access, Verifier};
use super::client::User;
use super::connection::{Connection, Fault, Stage};
use super::entrance::Entrance;
use super::event::{BrokerEvent, Teller};
use super::memory::Budget;
use super::router::Router;

/// The token that wakes the thread for a command.
pub(super) const WAKER: Token = Token(0);
/// The first token of connections; those below belong to the entrances.
const FIRST_CONNECTION: usize = 8;
/// How often deadlines are checked.
const TICK: Duration = Duration::from_millis(250);
/// Limit on the bytes per read.
const READ_BYTES: usize = 64 << 10;

/// A command to the thread.
pub(super) enum Command {
    /// Say farewell to all clients and end.
    Stop,
    /// Remember the client id of a device that the service knows.
    Know(String),
    /// Refuse the users with these names, and end their connections. Replaces those that were given before.
    Revoke(BTreeSet<DeviceId>),
    /// A password is verified: the fingerprint, if it was right.
    Verified(usize, DeviceId, Option<blake3::Hash>),
}

/// The broker's thread.
pub(super) struct Reactor<S> {
    poll: Poll,
    entrances: Vec<Entrance>,
    commands: Receiver<Command>,
    access: Arc<Access>,
    verifier: Verifier,
    budget: Arc<Budget>,
    clients_max: usize,
    router: Router,
    /// Users that are refused, whatever certificate or password they show.
    revoked: BTreeSet<DeviceId>,
    connections: BTreeMap<usize, Connection>,
    last_token: usize,
    /// Connections that may have packets to handle.
    turns: BTreeSet<usize>,
    /// The stranger that has last had its turn.
    last_turn: usize,
    /// Connections whose message waits, the longest wait first.
    blocked: VecDeque<usize>,
    teller: Teller<S>,
    /// Messages that were dropped or refused for lack of memory and are not yet reported.
    dropped: u64,
    scratch: Box<[u8]>,
}

/// What the thread begins with.
pub(super) struct Parts<S> {
    pub(super) poll: Poll,
    pub(super) entrances: Vec<Entrance>,
    pub(super) commands: Receiver<Command>,
    pub(super) access: Arc<Access>,
    pub(super) verifier: Verifier,
    pub(super) memory_bytes: usize,
    pub(super) clients_max: usize,
    pub(super) teller: Teller<S>,
}

impl<S: Fn(BrokerEvent)> Reactor<S> {
    pub(super) fn new(parts: Parts<S>) -> Self {
        let Parts { poll, entrances, commands, access, verifier, memory_bytes, clients_max, teller } = parts;
        let budget = Budget::new(memory_bytes);
        let router = Router::new(clients_max, Arc::clone(&budget), Arc::clone(&access));
        Self {
            poll,
            entrances,
            commands,
            access,
            verifier,
            budget,
            clients_max,
            router,
            revoked: BTreeSet::new(),
            connections: BTreeMap::new(),
            last_token: FIRST_CONNECTION,
            turns: BTreeSet::new(),
            last_turn: 0,
            blocked: VecDeque::new(),
            teller,
            dropped: 0,
            scratch: vec![0; READ_BYTES].into(),
        }
    }

    /// Serves clients until told to stop.
    pub(super) fn run(mut self) {
        let mut events = Events::with_capacity(256);
        let mut next_tick = Instant::now();
        loop {
            let is_busy = !self.turns.is_empty() || self.entrances.iter().any(|entrance| entrance.is_ready);
            let wait = match is_busy {
                true => Duration::ZERO,
                false => next_tick.saturating_duration_since(Instant::now()),
            };
            match self.poll.poll(&mut events, Some(wait)) {
                Err(error) if error.kind() != io::ErrorKind::Interrupted => std::thread::sleep(TICK),
                _ => {}
            }
            let now = Instant::now();
            for event in &events {
                self.note(event.token().0, event.is_readable() || event.is_error(), event.is_writable());
            }
            if self.obey(now) {
                break;
            }
            self.accept(now);
            self.take_turns(now);
            self.retry_blocked(now);
            self.router.keep_bound();
            self.write_ready(now);
            if now >= next_tick {
                self.tick(now);
                next_tick = now + TICK;
            }
        }
        self.say_farewell();
    }

    /// Notes that a socket is ready.
    fn note(&mut self, token: usize, is_readable: bool, is_writable: bool) {
        if let Some(entrance) = self.entrances.iter_mut().find(|entrance| entrance.token.0 == token) {
            entrance.is_ready = true;
        }
        let Some(connection) = self.connections.get_mut(&token) else { return };
        connection.is_readable |= is_readable;
        if is_writable {
            connection.set_writable();
            self.write(token, Instant::now());
        }
        if is_readable {
            self.turns.insert(token);
        }
    }

    /// Carries out commands; returns whether to stop.
    fn obey(&mut self, now: Instant) -> bool {
        while let Ok(command) = self.commands.try_recv() {
            match command {
                Command::Stop => return true,
                Command::Know(id) => self.router.know(id),
                Command::Revoke(users) => self.revoke(users, now),
                Command::Verified(token, user, fingerprint) => self.verified(token, now, user, fingerprint),
            }
        }
        false
    }

    /// Ends the connections of users that are revoked.
    fn revoke(&mut self, users: BTreeSet<DeviceId>, now: Instant) {
        self.revoked = users;
        let tokens: Vec<usize> = self.connections.keys().copied().collect();
        for token in tokens {
            if self.router.client(token).is_some_and(|client| self.is_revoked(client.user())) {
                self.close(token, now, DisconnectReasonCode::NotAuthorized);
            }
        }
    }

    fn is_revoked(&self, user: &User) -> bool {
        matches!(user, User::Named(name) if self.revoked.iter().any(|revoked| revoked.as_str() == &**name))
    }

    fn write_ready(&mut self, now: Instant) {
        for token in self.router.take_ready() {
            self.write(token, now);
        }
    }

    /// Writes what a connection has to get.
    fn write(&mut self, token: usize, now: Instant) {
        let Some(connection) = self.connections.get_mut(&token) else { return };
        let router = &mut self.router;
        let is_open = connection.is_open();
        let has_written = connection.write(now, |bytes, out| {
            if is_open {
                router.write(token, now, bytes, out);
            }
        });
        connection.weigh();
        if !has_written {
            return self.end(token, now, false);
        }
        if matches!(connection.stage, Stage::Closing(_)) && connection.is_flushed() {
            connection.socket.close_writing();
        }
        // The client's packets may have waited for its answers to be sent.
        if connection.has_input() {
            self.turns.insert(token);
        }
    }

    /// Hands on messages for which there is room now, or whose time is over.
    fn retry_blocked(&mut self, now: Instant) {
        for token in std::mem::take(&mut self.blocked) {
            let Some(connection) = self.connections.get_mut(&token) else { continue };
            let Some((publish, until)) = connection.blocked.take() else { continue };
            self.hand_on(token, now, publish, until);
            if self.connections.get(&token).is_some_and(|connection| !connection.is_paused()) {
                self.turns.insert(token);
            }
        }
    }

    /// Checks all deadlines.
    fn tick(&mut self, now: Instant) {
        self.entrances.iter_mut().for_each(|entrance| entrance.is_ready = true);
        self.router.tick(now);
        let tokens: Vec<usize> = self.connections.keys().copied().collect();
        for token in tokens {
            let missed = self.router.missed(token);
            match self.connections.get(&token).and_then(|connection| connection.fault(now, missed)) {
                None => {}
                Some(Fault::Gone) => self.end(token, now, false),
                Some(Fault::Silent) => self.close(token, now, DisconnectReasonCode::KeepAliveTimeout),
                Some(Fault::Slow) => {
                    let client = self.router.client(token).map(|client| client.id().to_owned());
                    self.teller.tell(now, BrokerEvent::Slow { client: client.unwrap_or_default() });
                    self.close(token, now, DisconnectReasonCode::QuotaExceeded);
                }
            }
        }
        self.dropped += self.router.take_lost();
        if self.dropped > 0 {
            let memory_bytes = self.budget.max();
            if self.teller.tell(now, BrokerEvent::MemoryFull { memory_bytes, dropped: self.dropped }) {
                self.dropped = 0;
            }
        }
    }

    /// Ends a connection with a reason.
    fn close(&mut self, token: usize, now: Instant, reason: DisconnectReasonCode) {
        self.router.disconnect(token, now, false);
        if let Some(connection) = self.connections.get_mut(&token) {
            connection.close(now, reason);
            self.write(token, now);
        }
    }

    /// Ends a connection without a word.
    fn end(&mut self, token: usize, now: Instant, is_graceful: bool) {
        self.router.disconnect(token, now, is_graceful);
        if let Some(mut connection) = self.connections.remove(&token) {
            connection.deregister(self.poll.registry());
        }
    }

    /// Tells all clients that the broker ends. Their last wills are not delivered.
    fn say_farewell(&mut self) {
        let now = Instant::now();
        for connection in self.connections.values_mut() {
            connection.close(now, DisconnectReasonCode::ServerShuttingDown);
            connection.write(now, |_, _| ());
            connection.socket.close_writing();
        }
    }
}
