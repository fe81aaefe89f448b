//! Connections whose request has not arrived. When the server is full, one of them makes room for a new connection, so that
//! idle connections of a stranger do not keep an operator out.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::task::{AbortHandle, JoinHandle};

/// The connections that wait, oldest first.
#[derive(Clone, Default)]
pub(super) struct Waiting(Arc<Mutex<Connections>>);

#[derive(Default)]
struct Connections {
    last_id: u64,
    list: VecDeque<Connection>,
}

struct Connection {
    id: u64,
    from: IpAddr,
    task: AbortHandle,
}

/// The place of a connection. It no longer waits once this value is dropped.
pub(super) struct Place {
    waiting: Waiting,
    id: u64,
}

impl Waiting {
    /// Adds a connection from this address. `serve` starts its task, and must not drop the place itself.
    pub(super) fn add(&self, from: IpAddr, serve: impl FnOnce(Place) -> JoinHandle<()>) {
        // Locked until the task is in the list, or a short one would end before.
        let mut connections = self.lock();
        connections.last_id += 1;
        let id = connections.last_id;
        let task = serve(Place { waiting: self.clone(), id }).abort_handle();
        connections.list.push_back(Connection { id, from, task });
    }

    /// Ends the oldest connection of the address that has the most. False if no connection waits.
    pub(super) fn make_room(&self) -> bool {
        let mut connections = self.lock();
        let froms: Vec<IpAddr> = connections.list.iter().map(|connection| connection.from).collect();
        let place = oldest_of_most(&froms);
        let Some(connection) = place.and_then(|place| connections.list.remove(place)) else { return false };
        connection.task.abort();
        true
    }

    fn lock(&self) -> MutexGuard<'_, Connections> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.waiting.lock().list.retain(|connection| connection.id != self.id);
    }
}

/// The place of the first connection of the address that has the most.
fn oldest_of_most(froms: &[IpAddr]) -> Option<usize> {
    let number = |from: &IpAddr| froms.iter().filter(|other| *other == from).count();
    // Of equal numbers, `max_by_key` takes the last.
    (0..froms.len()).rev().max_by_key(|place| number(&froms[*place]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use tokio::runtime::Builder;

    use super::*;

    #[test]
    fn the_oldest_of_the_address_with_most_connections_makes_room() {
        let froms = |numbers: &[u8]| -> Vec<IpAddr> {
            numbers.iter().map(|number| IpAddr::from([10, 0, 0, *number])).collect()
        };
        assert_eq!(oldest_of_most(&froms(&[])), None);
        assert_eq!(oldest_of_most(&froms(&[1, 2, 2, 3])), Some(1));
        assert_eq!(oldest_of_most(&froms(&[1, 2, 3, 2, 1])), Some(0));
    }

    #[test]
    fn a_connection_that_no_longer_waits_is_left_alone() {
        Builder::new_current_thread().build().unwrap().block_on(leave_alone());
    }

    async fn leave_alone() {
        let waiting = Waiting::default();
        let (mut place, mut ends) = (None, Vec::new());
        for number in 0..2 {
            let from = IpAddr::from([10, 0, 0, 1]);
            waiting.add(from, |its| {
                let task = tokio::spawn(std::future::pending());
                ends.push(task.abort_handle());
                match number {
                    0 => place = Some(its),
                    _ => std::mem::forget(its),
                }
                task
            });
        }
        drop(place);
        assert!(waiting.make_room() && !waiting.make_room());
        tokio::task::yield_now().await;
        assert_eq!([ends[0].is_finished(), ends[1].is_finished()], [false, true]);
    }
}
