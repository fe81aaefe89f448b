//! Lets workers distil the tiles of a merge: puts a task for each tile into the store and into the queue, and waits for
//! the results. Workers may die, and the queue may be away for a while.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread;
use std::time::{Duration, Instant};

use blake3::Hash;

use super::carry_out::{failure, name_of_failure};
use super::error::MergeError;
use super::news::{Learnt, Report};
use super::results::{self, TileRecord};
use super::task::{self, Task};
use crate::queue::Queue;
use crate::store::Store;

/// Interval at which the store is asked for results.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Interval at which tasks are queued again that the queue has lost.
const QUEUE_EVERY: Duration = Duration::from_secs(5);
/// A queue or store that fails for longer fails the merge.
const PATIENCE: Duration = Duration::from_secs(60);

/// A tile that is being distilled.
struct Sent {
    index: usize,
    hash: Hash,
    sh_degree: u32,
}

/// The tiles that are being distilled by workers.
struct Coordinator<'a> {
    store: &'a Store,
    queue: &'a Queue,
    /// Class of devices that may distil them.
    class: &'a str,
    left: Vec<Sent>,
    is_stopped: &'a AtomicBool,
    say: &'a Sender<Report>,
}

/// Lets workers with devices of this class distil the tiles with the indices `order`. `task` makes the task of a tile.
pub(super) fn by_workers(
    order: &[usize],
    task: &dyn Fn(usize) -> Result<Task, MergeError>,
    class: &str,
    store: &Store,
    queue: &Queue,
    is_stopped: &AtomicBool,
    say: &Sender<Report>,
) {
    let mut coordinator = Coordinator { store, queue, class, left: Vec::new(), is_stopped, say };
    for &index in order {
        let sent = task(index).and_then(|task| coordinator.send(index, &task));
        match sent {
            Ok(()) if coordinator.goes_on(Report::Waiting) => {}
            Ok(()) => return,
            Err(error) => return drop(say.send(Report::Done(index, Err(error)))),
        }
    }
    coordinator.wait();
}

impl Coordinator<'_> {
    /// Reports, and returns whether the merge goes on.
    fn goes_on(&self, report: Report) -> bool {
        self.say.send(report).is_ok() && !self.is_stopped.load(Ordering::Relaxed)
    }

    /// Puts a task where workers find it, unless its result is known.
    fn send(&mut self, index: usize, task: &Task) -> Result<(), MergeError> {
        let (hash, sh_degree) = (task.hash(), task.sh_degree());
        let found = self.patiently(|its| Ok(results::find(its.store, &hash, sh_degree)?))?;
        if let Some(splats) = found {
            let learnt = Learnt { record: TileRecord::of(&hash, &splats), splats, was_found: true };
            let _ = self.say.send(Report::Done(index, Ok(learnt)));
            return Ok(());
        }
        self.patiently(|its| {
            its.store.remove(&hash.to_hex())?; // a damaged result
            its.store.remove(&name_of_failure(&hash))?; // of an earlier merge
            task.put(its.store)?;
            Ok(its.queue.send(its.class, &hash.to_hex(), its.store.folder_name())?)
        })?;
        self.left.push(Sent { index, hash, sh_degree });
        Ok(())
    }

    /// Waits until all results are there.
    fn wait(&mut self) {
        let mut queued = Instant::now();
        while !self.left.is_empty() && self.goes_on(Report::Waiting) {
            thread::sleep(LOOK_EVERY);
            let is_late = queued.elapsed() >= QUEUE_EVERY;
            if is_late {
                queued = Instant::now();
            }
            let names = self.patiently(|its| Ok(its.store.names()?));
            let looked = names.and_then(|names| self.look(&names.into_iter().collect(), is_late));
            if let Err((index, error)) = looked.map_err(|error| (self.left[0].index, error)) {
                let _ = self.say.send(Report::Done(index, Err(error)));
                return;
            }
        }
    }

    /// Takes the results that are among the `names` of objects. With `is_late`, tasks that the queue has lost are
    /// queued again.
    fn look(&mut self, names: &BTreeSet<String>, is_late: bool) -> Result<(), MergeError> {
        let mut left = Vec::new();
        for Sent { index, hash, sh_degree } in std::mem::take(&mut self.left) {
            let is_there = names.contains(hash.to_hex().as_str());
            let sent = Sent { index, hash, sh_degree };
            let found = match is_there {
                true => self.patiently(|its| Ok(results::find(its.store, &hash, sh_degree)?)),
                false => Ok(None),
            };
            let kept = found.and_then(|found| match found {
                Some(splats) => {
                    self.patiently(|its| Ok(its.store.remove(&task::name(&hash))?))?;
                    let learnt = Learnt { record: TileRecord::of(&hash, &splats), splats, was_found: false };
                    let _ = self.say.send(Report::Done(index, Ok(learnt)));
                    Ok(None)
                }
                None => self.await_further(&sent, is_there, names, is_late).map(|()| Some(sent)),
            });
            match kept {
                Ok(kept) => left.extend(kept),
                Err(error) => {
                    self.left = vec![Sent { index, hash, sh_degree }];
                    return Err(error);
                }
            }
        }
        self.left = left;
        Ok(())
    }

    /// What is to be done about a tile without a result.
    fn await_further(
        &self,
        sent: &Sent,
        is_damaged: bool,
        names: &BTreeSet<String>,
        is_late: bool,
    ) -> Result<(), MergeError> {
        if names.contains(&name_of_failure(&sent.hash)) {
            return Err(MergeError::Workers { reason: failure(self.store, &sent.hash)? });
        }
        if is_damaged {
            self.patiently(|its| Ok(its.store.remove(&sent.hash.to_hex())?))?;
        }
        if is_late || is_damaged {
            self.patiently(|its| {
                Ok(its.queue.send(its.class, &sent.hash.to_hex(), its.store.folder_name())?)
            })?;
        }
        Ok(())
    }

    /// Tries something again and again until it succeeds, or has failed for too long.
    fn patiently<T>(&self, attempt: impl Fn(&Self) -> Result<T, MergeError>) -> Result<T, MergeError> {
        let begun = Instant::now();
        loop {
            match attempt(self) {
                Err(MergeError::Queue(_) | MergeError::Tiles(_)) if begun.elapsed() < PATIENCE => {}
                outcome => return outcome,
            }
            thread::sleep(LOOK_EVERY);
            if !self.goes_on(Report::Waiting) {
                return Err(MergeError::GivenUp);
            }
        }
    }
}
