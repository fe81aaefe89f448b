//! Keeps a connection while the agent trains: tells the other devices of its flight, and everybody how far it is. What is
//! wrong with the broker or the keys is told before the training.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_agent::status::{StatusBoard, StatusTeller};
use cosurf_contract::AgentEvent;
use cosurf_link::{Credentials, Identity, InboxLimits, Node, NodeEvent};
use cosurf_scene::Camera;

use super::route::Connection;
use crate::cli::progress::Progress;

/// How long the agent tries to connect before it trains. It trains without a connection, too.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// How long the agent waits, once it is connected, for the broker's refusals of its messages.
const REFUSAL_TIMEOUT: Duration = Duration::from_millis(300);
/// Longest wait for a message, after which the loop checks whether it must stop.
const POLL_TIMEOUT: Duration = Duration::from_millis(200);

/// A connection that a thread of its own keeps until this value is dropped.
pub(super) struct Reporter {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// What the thread tells.
enum Told {
    Connected,
    Problem(AgentEvent),
}

impl Reporter {
    /// Connects, and announces the cameras `flight`. Waits until the connection is up, but at most [`CONNECT_TIMEOUT`], and
    /// then for `flush_time`, so that the announcement is sent. Shows what is wrong, now and while the agent trains.
    /// Without a `board`, no status is told.
    pub(super) fn start(
        identity: Identity,
        credentials: &Credentials,
        flight: Option<&[Camera]>,
        connection: Connection,
        board: Option<&StatusBoard>,
        flush_time: Duration,
        progress: &mut Progress,
    ) -> Self {
        // This node accepts no models; the node of `publish` does.
        let mut node = Node::new(identity, InboxLimits::CLOSED, &[]);
        node.set_credentials(credentials.clone());
        if let Some(flight) = flight {
            node.announce_flight(flight);
        }
        let teller = board.map(|board| StatusTeller::new(board, identity));
        let (say, hear) = channel();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || keep(node, connection, teller, &say, &stop))
        };
        if await_connection(&hear, progress) {
            std::thread::sleep(flush_time);
        }
        progress.listen(problems(hear));
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Reporter {
    /// Breaks the connection, once what is queued is sent.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Waits for the connection and for refusals of the first messages, and shows what is wrong. Returns whether it is up.
fn await_connection(hear: &Receiver<Told>, progress: &mut Progress) -> bool {
    let mut end = Instant::now() + CONNECT_TIMEOUT;
    let mut is_connected = false;
    loop {
        match hear.recv_timeout(end.saturating_duration_since(Instant::now())) {
            Ok(Told::Connected) => (is_connected, end) = (true, Instant::now() + REFUSAL_TIMEOUT),
            Ok(Told::Problem(event)) => progress.show(&event),
            Err(_) if is_connected => return true,
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                let seconds = CONNECT_TIMEOUT.as_secs();
                let reason = format!(
                    "no connection after {seconds} s: the training begins without one; check the address"
                );
                progress.show(&AgentEvent::Retrying { reason, attempt: 1 });
                return false;
            }
        }
    }
}

/// The problems among what the thread tells, as an iterator that never waits.
fn problems(hear: Receiver<Told>) -> impl FnMut() -> Option<AgentEvent> {
    move || {
        hear.try_iter().find_map(|told| match told {
            Told::Problem(event) => Some(event),
            Told::Connected => None,
        })
    }
}

/// Keeps the connection until `stop`.
fn keep(
    mut node: Node,
    mut connection: Connection,
    mut teller: Option<StatusTeller>,
    say: &Sender<Told>,
    stop: &AtomicBool,
) {
    let begun = Instant::now();
    let now = || begun.elapsed() + Duration::from_secs(1);
    while !stop.load(Ordering::Relaxed) {
        let event = node.step(&mut connection, now, POLL_TIMEOUT);
        let is_connected = match &event {
            Some(NodeEvent::Connected) => Some(true),
            Some(NodeEvent::Disconnected { .. }) => Some(false),
            _ => None,
        };
        if let Some(teller) = &mut teller {
            is_connected.into_iter().for_each(|is_connected| teller.on_connection(is_connected));
            teller.tell(&mut connection, now());
        }
        if let Some(told) = event.and_then(told) {
            let _ = say.send(told);
        }
    }
}

/// What an event means for the user. Of attempts in a row, fewer and fewer are told.
fn told(event: NodeEvent) -> Option<Told> {
    let problem = |reason, attempt| Some(Told::Problem(AgentEvent::Retrying { reason, attempt }));
    match event {
        NodeEvent::Connected => Some(Told::Connected),
        NodeEvent::Disconnected { attempt, reason } if attempt.is_power_of_two() => problem(reason, attempt),
        NodeEvent::Denied(reason) => problem(reason, 1),
        _ => None,
    }
}
