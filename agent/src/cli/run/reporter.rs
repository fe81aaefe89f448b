//! Keeps a connection while the agent trains: asks for the agent's cell of the site's plan, tells the other devices of its
//! flight, and everybody how far it is. What is wrong with the broker or the keys is told before the training.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_agent::status::{StatusBoard, StatusTeller};
use cosurf_contract::AgentEvent;
use cosurf_link::{Credentials, Identity, InboxLimits, Node, NodeEvent, Outgoing, Transport};
use cosurf_scene::Camera;
use cosurf_wire::{ModelId, Topic};

use super::choice::Answer;
use super::route::Connection;
use crate::cli::progress::Progress;

/// How long the agent tries to connect before it trains. It trains without a connection, too.
pub(super) const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// How long the agent waits, once it is connected, for the broker's refusals of its messages.
const REFUSAL_TIMEOUT: Duration = Duration::from_millis(300);
/// How long the agent waits, once it is connected, for its cell of the plan.
const PLAN_TIMEOUT: Duration = Duration::from_secs(3);
/// Longest wait for a message, after which the loop checks whether it must stop.
const POLL_TIMEOUT: Duration = Duration::from_millis(200);

/// A connection that a thread of its own keeps until this value is dropped.
pub(super) struct Reporter {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    start: Start,
    flights: Sender<Flight>,
}

/// A flight that the thread announces, in the world frame of these credentials.
struct Flight {
    credentials: Credentials,
    cameras: Vec<Camera>,
}

/// What the thread tells.
enum Told {
    Connected,
    Plan(Answer),
    Problem(AgentEvent),
}

impl Reporter {
    /// Connects. Waits until the connection is up, but at most [`CONNECT_TIMEOUT`]; and then, if it `asks` for the agent's
    /// cell, at most [`PLAN_TIMEOUT`] for the answer, which is returned too. Shows what is wrong, now and while the agent
    /// trains. Without a `board`, no status is told.
    pub(super) fn start(
        identity: Identity,
        credentials: Credentials,
        connection: Connection,
        board: Option<&StatusBoard>,
        asks: bool,
        progress: &mut Progress,
    ) -> (Self, Option<Answer>) {
        // This node accepts no models; the node of `publish` does.
        let mut node = Node::new(identity, InboxLimits::CLOSED, &[]);
        node.set_credentials(credentials);
        if asks {
            node.ask_for_plan();
        }
        let teller = board.map(|board| StatusTeller::new(board, identity));
        let (say, hear) = channel();
        let (flights, queue) = channel();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let stop = Arc::clone(&stop);
            let trial = connection.has_broker().then(|| trial_of(&identity));
            std::thread::spawn(move || keep(node, connection, trial, teller, &say, &queue, &stop))
        };
        let (start, answer) = await_start(&hear, asks, progress);
        progress.listen(problems(hear));
        (Self { stop, thread: Some(thread), start, flights }, answer)
    }

    /// Announces the cameras of the agent's flight, in the frame of these credentials.
    pub(super) fn announce(&self, credentials: Credentials, cameras: Vec<Camera>) {
        let _ = self.flights.send(Flight { credentials, cameras }); // fails only if the thread has panicked
    }

    /// Whether the agent was connected at the start.
    pub(super) fn is_connected(&self) -> bool {
        self.start.is_connected
    }

    /// Whether something was wrong at the start, which has been shown.
    pub(super) fn has_problem(&self) -> bool {
        self.start.has_problem
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

/// What the agent knows once it stops waiting.
#[derive(Debug, Default)]
struct Start {
    is_connected: bool,
    has_problem: bool,
}

/// Waits for the connection, for refusals of the first messages and, if the agent `asks` for its cell, for the answer, which
/// is returned too. Shows what is wrong.
fn await_start(hear: &Receiver<Told>, asks: bool, progress: &mut Progress) -> (Start, Option<Answer>) {
    let (mut start, mut answer) = (Start::default(), None);
    let (mut end, mut refusals_end) = (Instant::now() + CONNECT_TIMEOUT, Instant::now());
    loop {
        match hear.recv_timeout(end.saturating_duration_since(Instant::now())) {
            Ok(Told::Connected) if start.is_connected => {}
            Ok(Told::Connected) => {
                start.is_connected = true;
                refusals_end = Instant::now() + REFUSAL_TIMEOUT;
                end = if asks { Instant::now() + PLAN_TIMEOUT } else { refusals_end };
            }
            Ok(Told::Plan(plan)) => {
                answer = Some(plan);
                end = refusals_end;
            }
            Ok(Told::Problem(event)) => {
                start.has_problem = true;
                progress.show(&event);
            }
            Err(_) => return (start, answer),
        }
    }
}

/// The problems among what the thread tells, as an iterator that never waits.
fn problems(hear: Receiver<Told>) -> impl FnMut() -> Option<AgentEvent> {
    move || {
        hear.try_iter().find_map(|told| match told {
            Told::Problem(event) => Some(event),
            Told::Connected | Told::Plan(_) => None,
        })
    }
}

/// A message that changes nothing, under a topic of models: it deletes an offer that was never made. A broker that does not let
/// this device send models refuses it before the training.
fn trial_of(Identity { site, device, .. }: &Identity) -> Outgoing {
    let topic = Topic::LocalHeader { device: *device, model: ModelId(0) }.to_text(site);
    Outgoing { topic, payload: Vec::new(), retain: true }
}

/// Keeps the connection until `stop`. Sends the `trial` once it is up.
fn keep(
    mut node: Node,
    mut connection: Connection,
    mut trial: Option<Outgoing>,
    mut teller: Option<StatusTeller>,
    say: &Sender<Told>,
    flights: &Receiver<Flight>,
    stop: &AtomicBool,
) {
    let begun = Instant::now();
    let now = || begun.elapsed() + Duration::from_secs(1);
    while !stop.load(Ordering::Relaxed) {
        if let Ok(Flight { credentials, cameras }) = flights.try_recv() {
            node.set_credentials(credentials);
            node.announce_flight(&cameras);
        }
        let event = node.step(&mut connection, now, POLL_TIMEOUT);
        let is_connected = match &event {
            Some(NodeEvent::Connected) => Some(true),
            Some(NodeEvent::Disconnected { .. }) => Some(false),
            _ => None,
        };
        if is_connected == Some(true)
            && let Some(trial) = trial.take()
        {
            let _ = connection.publish(&trial); // what cannot be sent is not refused
        }
        if let Some(teller) = &mut teller {
            is_connected.into_iter().for_each(|is_connected| teller.on_connection(is_connected));
            teller.tell(&mut connection, now());
        }
        if let Some(told) = event.and_then(told) {
            let _ = say.send(told);
        }
    }
    // What has changed since, such as why the agent ends.
    if let Some(teller) = &mut teller {
        teller.tell(&mut connection, now());
    }
}

/// What an event means for the user. Of attempts in a row, fewer and fewer are told.
fn told(event: NodeEvent) -> Option<Told> {
    let problem = |reason, attempt| Some(Told::Problem(AgentEvent::Retrying { reason, attempt }));
    match event {
        NodeEvent::Connected => Some(Told::Connected),
        NodeEvent::Plan { frame, cell } => Some(Told::Plan(Answer { frame, cell })),
        NodeEvent::Disconnected { attempt, reason } if attempt.is_power_of_two() => problem(reason, attempt),
        NodeEvent::Denied(reason) => problem(reason, 1),
        _ => None,
    }
}
