//! An aggregator's side of the site's plan: it answers the start of a device's session with the device's cell.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::{DeviceId, FrameId, Message, Plan, Reply, SiteId, State, Topic, VerticalAxis};
use serde::{Deserialize, Serialize};

use crate::pacing::PLAN_PAUSE;
use crate::transport::Outgoing;

/// A device's cell of the site's plan: the ground that the device observes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannedCell {
    /// The vertical axis of the world frame. The other two are the axes of the corners.
    pub vertical: VerticalAxis,
    /// The corners in order around the cell, at most [`cosurf_wire::PLAN_CORNERS_MAX`].
    pub corners: Vec<[f64; 2]>,
    /// Width of the margin around the cell, as a share of the cell's size, 0 to 1. The device also observes the margin.
    pub margin: f64,
}

/// The plan, and the devices that get their cells.
#[derive(Debug, Default)]
pub(super) struct Planning {
    cells: BTreeMap<DeviceId, PlannedCell>,
    receivers: BTreeMap<DeviceId, Receiver>,
}

#[derive(Debug)]
struct Receiver {
    /// The device's session.
    session: u64,
    is_due: bool,
    /// When the answer is sent.
    at: Duration,
}

impl Planning {
    pub(super) fn new(cells: BTreeMap<DeviceId, PlannedCell>) -> Self {
        Self { cells, ..Self::default() }
    }

    /// A device has started or ended a session. At each start it gets an answer: its cell, or that it has none. At most
    /// `devices_max` devices do.
    pub(super) fn on_state(&mut self, now: Duration, state: &State, devices_max: usize) {
        let State { device, session, alive } = *state;
        let known = self.receivers.get(&device);
        if alive && (known.is_some() || self.receivers.len() < devices_max) {
            let at = known.map_or(now, |known| known.at);
            self.receivers.insert(device, Receiver { session, is_due: true, at });
        } else if !alive && known.is_some_and(|known| known.session == session) {
            self.receivers.remove(&device);
        }
    }

    /// When the next answer is due.
    pub(super) fn next_wakeup(&self) -> Option<Duration> {
        self.receivers.values().filter(|receiver| receiver.is_due).map(|receiver| receiver.at).min()
    }

    /// The next answer that is due. `frame` is the world frame of the site.
    pub(super) fn next(&mut self, now: Duration, site: &SiteId, frame: FrameId) -> Option<Outgoing> {
        let is_due = |receiver: &Receiver| receiver.is_due && receiver.at <= now;
        let (device, receiver) = self.receivers.iter_mut().find(|(_, receiver)| is_due(receiver))?;
        (receiver.is_due, receiver.at) = (false, now + PLAN_PAUSE);
        let (device, session) = (*device, receiver.session);
        let none = PlannedCell { vertical: VerticalAxis::Z, corners: Vec::new(), margin: 0.0 };
        let PlannedCell { vertical, corners, margin } = self.cells.get(&device).unwrap_or(&none);
        let (vertical, margin) = (*vertical, *margin);
        let cell: Vec<u8> = corners.iter().copied().flat_map(Plan::encode_corner).collect();
        let plan = Plan { device, session, frame, vertical, margin, cell: &cell };
        let topic = Topic::LocalReply { device, reply: Reply::Plan };
        Some(Outgoing::new(site, topic, &Message::Plan(plan), false))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn device(name: &str) -> DeviceId {
        DeviceId::new(name).unwrap()
    }

    /// The answers that are due: receiver, its session, number of corners.
    fn answers(planning: &mut Planning, now_s: u64) -> Vec<(String, u64, usize)> {
        let site = SiteId::new("site").unwrap();
        let now = Duration::from_secs(now_s);
        let messages = std::iter::from_fn(|| planning.next(now, &site, FrameId::default()));
        let answer = |message: Outgoing| match Message::decode(&message.payload).unwrap() {
            Message::Plan(plan) => {
                assert!(!message.retain);
                (plan.device.to_string(), plan.session, plan.corners().len())
            }
            other => panic!("{other:?}"),
        };
        messages.map(answer).collect()
    }

    #[test]
    fn each_start_of_a_session_is_answered_once_and_not_too_often() {
        let corners = vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
        let cell = PlannedCell { vertical: VerticalAxis::Z, corners, margin: 0.2 };
        let mut planning = Planning::new(BTreeMap::from([(device("a"), cell)]));
        let hear = |planning: &mut Planning, now_s, name: &str, session, alive| {
            let state = State { device: device(name), session, alive };
            planning.on_state(Duration::from_secs(now_s), &state, 2);
        };
        for name in ["a", "b", "c"] {
            hear(&mut planning, 0, name, 7, true);
        }
        assert_eq!(answers(&mut planning, 0), [("a".into(), 7, 3), ("b".into(), 7, 0)], "c is one too many");
        assert_eq!((answers(&mut planning, 9), planning.next_wakeup()), (vec![], None));
        for _ in 0..9 {
            hear(&mut planning, 9, "a", 8, true);
        }
        assert_eq!(answers(&mut planning, 9), [("a".into(), 8, 3)]);
        hear(&mut planning, 9, "a", 8, true);
        assert_eq!(answers(&mut planning, 9), [], "not so soon");
        assert_eq!(answers(&mut planning, 10), [("a".into(), 8, 3)]);
        hear(&mut planning, 20, "b", 9, true);
        hear(&mut planning, 20, "b", 8, false);
        assert_eq!(answers(&mut planning, 20), [("b".into(), 9, 0)], "an earlier session has ended");
        hear(&mut planning, 20, "b", 9, false);
        hear(&mut planning, 20, "c", 1, true);
        assert_eq!(answers(&mut planning, 20), [("c".into(), 1, 0)], "there is room for c");
    }
}
