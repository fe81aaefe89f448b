//! Tells over the link how far the agent is: at once when its phase changes, and every five seconds.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cosurf_contract::{AgentEvent, AgentPhase, AgentStatus, usage};
use cosurf_link::{Identity, Outgoing, Transport};
use cosurf_wire::Topic;

/// Time between two statuses.
const EVERY: Duration = Duration::from_secs(5);

/// The present status of the agent, for the thread that works and the thread that tells. Clones share it.
#[derive(Clone, Debug)]
pub struct StatusBoard(Arc<Mutex<Board>>);

#[derive(Debug)]
struct Board {
    status: AgentStatus,
    /// Number of changes of the phase.
    changes: u64,
    /// Whether somebody ends the agent, so that nothing else may be told.
    is_stopped: bool,
}

impl Board {
    fn fail(&mut self, reason: &str) {
        self.status.fail(reason);
        self.changes += 1;
    }
}

impl StatusBoard {
    /// The board of an agent that has just started and will train for so many steps.
    pub fn new(steps: u32) -> Self {
        let status = AgentStatus::new(steps, env!("CARGO_PKG_VERSION"));
        Self(Arc::new(Mutex::new(Board { status, changes: 0, is_stopped: false })))
    }

    /// Notes an event.
    pub fn follow(&self, event: &AgentEvent) {
        let mut board = self.lock();
        if !board.is_stopped {
            board.changes += u64::from(board.status.follow(event));
        }
    }

    /// Notes that the agent has finished.
    pub fn finish(&self) {
        let mut board = self.lock();
        board.status.phase = AgentPhase::Done;
        board.changes += 1;
    }

    /// Notes why the agent ends, if it does. Returns `result`.
    pub fn follow_result<T>(&self, result: anyhow::Result<T>) -> anyhow::Result<T> {
        if let Err(error) = &result {
            self.lock().fail(&format!("{error:#}"));
        }
        result
    }

    /// Notes that somebody ends the agent.
    pub fn stop(&self) {
        let mut board = self.lock();
        board.fail("stopped; run the same command again to go on");
        board.is_stopped = true;
    }

    fn lock(&self) -> MutexGuard<'_, Board> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read(&self) -> (AgentStatus, u64) {
        let board = self.lock();
        (board.status.clone(), board.changes)
    }
}

/// Publishes the status on a connection. The broker keeps the newest one.
#[derive(Debug)]
pub struct StatusTeller {
    board: StatusBoard,
    identity: Identity,
    is_connected: bool,
    /// When the next status is due, and the number of changes that the last one told.
    next: Duration,
    told: u64,
}

impl StatusTeller {
    /// Tells the status on `board` as that of `identity`.
    pub fn new(board: &StatusBoard, identity: Identity) -> Self {
        Self { board: board.clone(), identity, is_connected: false, next: Duration::ZERO, told: 0 }
    }

    /// Notes that the connection is up or broken. Once it is up, the status is told at once.
    pub fn on_connection(&mut self, is_connected: bool) {
        (self.is_connected, self.next) = (is_connected, Duration::ZERO);
    }

    /// Publishes the status if it is due. If the connection is busy, the next call tries again.
    pub fn tell<T: Transport>(&mut self, transport: &mut T, now: Duration) {
        if !self.is_connected {
            return;
        }
        let (mut status, changes) = self.board.read();
        if now < self.next && changes == self.told {
            return;
        }
        status.memory_bytes = usage::resident_bytes();
        status.time_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let topic = Topic::Status { device: self.identity.device }.to_text(&self.identity.site);
        let payload = serde_json::to_vec(&status).unwrap_or_default();
        if transport.publish(&Outgoing { topic, payload, retain: true }).is_ok() {
            (self.next, self.told) = (now + EVERY, changes);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::{Faults, MemoryNetwork, Role};
    use cosurf_wire::{DeviceId, SiteId};

    use super::*;

    #[test]
    fn a_status_is_told_at_once_on_changes_and_every_five_seconds() {
        let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone-1").unwrap());
        let identity = Identity { site, device, session: 1, role: Role::Device };
        let network = MemoryNetwork::new(1, Faults::NONE);
        let mut transport = network.join(&identity);
        let board = StatusBoard::new(300);
        let mut teller = StatusTeller::new(&board, identity);
        let mut told = |teller: &mut StatusTeller, seconds: u64| {
            network.advance(Duration::from_secs(seconds));
            teller.tell(&mut transport, Duration::from_secs(seconds));
            network.advance(network.now() + Duration::from_millis(100));
            while transport.poll(Duration::ZERO).is_some() {}
            let kept = network.retained("gs/v1/site/drone-1/status");
            kept.map(|bytes| serde_json::from_slice::<AgentStatus>(&bytes).unwrap())
        };
        assert_eq!(told(&mut teller, 1), None, "no connection yet");
        teller.on_connection(true);
        let first = told(&mut teller, 2).unwrap();
        assert!(
            first.phase == AgentPhase::Loading && first.memory_bytes > 0 && first.time_s > 0,
            "{first:?}"
        );
        let progress = |step| AgentEvent::Progress {
            step,
            steps: 300,
            psnr: 20.0,
            splats: 9,
            steps_per_s: 1.0,
            seconds_left: 9.0,
        };
        board.follow(&progress(1));
        assert_eq!(told(&mut teller, 3).unwrap().step, 1, "a new phase");
        board.follow(&progress(2));
        assert_eq!(told(&mut teller, 4).unwrap().step, 1, "not so soon");
        assert_eq!(told(&mut teller, 9).unwrap().step, 2);
        board.finish();
        assert_eq!(told(&mut teller, 10).unwrap().phase, AgentPhase::Done);
        board.stop();
        board.follow(&progress(3));
        let last = told(&mut teller, 11).unwrap();
        assert!(last.phase == AgentPhase::Failed && last.problem.unwrap().starts_with("stopped"));
    }
}
