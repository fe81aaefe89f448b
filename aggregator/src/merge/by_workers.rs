//! Lets workers distil the tiles of a merge: puts a task for each tile into the store and into the queue, and waits for
//! the results. Workers may die, and the queue may be away for a while. Whoever can reach the queue can keep tasks from
//! the workers, and whoever can write to the store can write results. So a result is believed only if distillation can
//! give it, and this computer distils a tile itself after two bad results, or if no result comes for too long.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread;
use std::time::{Duration, Instant};

use cosurf_scene::Splats;

use super::carry_out::{failure, name_of_failure};
use super::error::MergeError;
use super::expected::Expected;
use super::news::{Learnt, Report};
use super::patience::Patience;
use super::results::{self, Found, TileRecord};
use super::settings::Workers;
use super::task::{self, Task};

/// Interval at which the store is asked for results.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Interval at which tasks are queued again that the queue has lost.
const QUEUE_EVERY: Duration = Duration::from_secs(5);
/// A queue or store that fails for longer fails the merge.
const PATIENCE: Duration = Duration::from_secs(60);
/// After so many bad results, this computer distils a tile itself.
const BAD_MAX: u32 = 2;

/// Distils a tile. The second argument returns false to stop.
type Learn<'a> = dyn Fn(&Task, &dyn Fn() -> bool) -> Result<Splats, MergeError> + 'a;

/// What the merge's own computer does.
pub(super) struct Here<'a> {
    /// Class of devices that may distil the tiles.
    pub(super) class: String,
    /// Makes the task of a tile.
    pub(super) task: &'a dyn Fn(usize) -> Result<Task, MergeError>,
    /// Bytes of memory that the distillation of a tile takes, and that it may take.
    pub(super) needed_bytes: &'a dyn Fn(usize) -> u64,
    pub(super) memory_bytes: u64,
    pub(super) learn: &'a Learn<'a>,
}

/// A tile that is being distilled.
struct Sent {
    index: usize,
    expected: Expected,
    /// Number of bad results.
    bad: u32,
}

impl Sent {
    /// Name of the result in the store.
    fn name(&self) -> String {
        self.expected.task.to_hex().to_string()
    }
}

/// The tiles that are being distilled by workers.
struct Coordinator<'a> {
    workers: Workers<'a>,
    here: &'a Here<'a>,
    left: Vec<Sent>,
    patience: Patience,
    /// Whether it was told that the workers are absent.
    is_told: bool,
    is_stopped: &'a AtomicBool,
    say: &'a Sender<Report>,
}

/// Lets workers distil the tiles with the indices `order`.
pub(super) fn by_workers(
    order: &[usize],
    workers: Workers,
    here: &Here,
    is_stopped: &AtomicBool,
    say: &Sender<Report>,
) {
    let patience = Patience::new(workers.patience, Instant::now());
    let left = Vec::new();
    let mut coordinator = Coordinator { workers, here, left, patience, is_told: false, is_stopped, say };
    for &index in order {
        let sent = (here.task)(index).and_then(|task| coordinator.send(index, &task));
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

    /// Tells a trouble. Nobody may listen.
    fn tell(&self, trouble: String) {
        let _ = self.workers.say.send(trouble);
    }

    /// Puts a task where workers find it, unless its result is known.
    fn send(&mut self, index: usize, task: &Task) -> Result<(), MergeError> {
        let mut sent = Sent { index, expected: Expected::of(task)?, bad: 0 };
        match self.find(&sent)? {
            Found::Sound(splats) => {
                self.done(&sent, splats, true);
                return Ok(());
            }
            Found::Bad(reason) => self.note_bad(&mut sent, &reason),
            Found::Nothing => {}
        }
        self.patiently(|its| {
            its.workers.store.remove(&sent.name())?; // a bad result
            its.workers.store.remove(&name_of_failure(&sent.expected.task))?; // of an earlier merge
            task.put(its.workers.store)
        })?;
        self.queue(&sent)?;
        self.left.push(sent);
        Ok(())
    }

    /// Waits until all results are there.
    fn wait(&mut self) {
        let mut queued = Instant::now();
        self.patience = Patience::new(self.workers.patience, queued);
        while !self.left.is_empty() && self.goes_on(Report::Waiting) {
            thread::sleep(LOOK_EVERY);
            let is_late = queued.elapsed() >= QUEUE_EVERY;
            if is_late {
                queued = Instant::now();
            }
            if let Err((index, error)) = self.look(is_late).and_then(|()| self.help()) {
                let _ = self.say.send(Report::Done(index, Err(error)));
                return;
            }
        }
    }

    /// Takes the results that are there. With `is_late`, tasks that the queue has lost are queued again. An error comes
    /// with the index of its tile.
    fn look(&mut self, is_late: bool) -> Result<(), (usize, MergeError)> {
        let names = self.patiently(|its| Ok(its.workers.store.names()?));
        let names: BTreeSet<String> =
            names.map_err(|error| (self.left[0].index, error))?.into_iter().collect();
        for mut sent in std::mem::take(&mut self.left) {
            match self.settle(&mut sent, &names, is_late) {
                Ok(true) => {}
                Ok(false) => self.left.push(sent),
                Err(error) => return Err((sent.index, error)),
            }
        }
        Ok(())
    }

    /// Looks after a tile; returns whether it is done. `names` has those of all objects in the store.
    fn settle(
        &mut self,
        sent: &mut Sent,
        names: &BTreeSet<String>,
        is_late: bool,
    ) -> Result<bool, MergeError> {
        let found = if names.contains(&sent.name()) { self.find(sent)? } else { Found::Nothing };
        match found {
            Found::Sound(splats) => {
                self.patience.renew(Instant::now());
                self.forget_task(sent)?;
                self.done(sent, splats, false);
                return Ok(true);
            }
            Found::Bad(reason) => {
                self.note_bad(sent, &reason);
                self.patiently(|its| Ok(its.workers.store.remove(&sent.name())?))?;
                if sent.bad >= BAD_MAX {
                    self.distil_here(sent)?;
                    return Ok(true);
                }
                self.queue(sent)?;
            }
            Found::Nothing if names.contains(&name_of_failure(&sent.expected.task)) => {
                let reason = failure(self.workers.store, &sent.expected.task)?;
                return Err(MergeError::Workers { reason });
            }
            Found::Nothing if is_late => self.queue(sent)?,
            Found::Nothing => {}
        }
        Ok(false)
    }

    /// Distils a tile if the workers have given no result for too long: the last in the queue that fits into the memory.
    fn help(&mut self) -> Result<(), (usize, MergeError)> {
        if self.left.is_empty() || !self.patience.is_over(Instant::now()) {
            return Ok(());
        }
        let needed = |sent: &Sent| (self.here.needed_bytes)(sent.index);
        let place = self.left.iter().rposition(|sent| needed(sent) <= self.here.memory_bytes);
        if !std::mem::replace(&mut self.is_told, true) {
            let what = match place {
                Some(_) => "this computer distils tiles too".to_owned(),
                None => {
                    let least = self.left.iter().map(needed).min().unwrap_or_default();
                    format!(
                        "this computer needs {} MiB of memory to distil one itself",
                        least.div_ceil(1 << 20)
                    )
                }
            };
            let seconds = self.patience.limit().as_secs();
            self.tell(format!("the workers have not distilled a tile for {seconds} s; {what}"));
        }
        let Some(place) = place else { return Ok(()) };
        let sent = self.left.remove(place);
        self.distil_here(&sent).map_err(|error| (sent.index, error))
    }

    /// Distils a tile on this computer.
    fn distil_here(&self, sent: &Sent) -> Result<(), MergeError> {
        let Here { memory_bytes, .. } = *self.here;
        let needed_bytes = (self.here.needed_bytes)(sent.index);
        if needed_bytes > memory_bytes {
            return Err(MergeError::TooLittleMemory { memory_bytes, needed_bytes });
        }
        let task = (self.here.task)(sent.index)?;
        let reported = Cell::new(Instant::now());
        let splats = (self.here.learn)(&task, &|| {
            if reported.get().elapsed() < LOOK_EVERY {
                return !self.is_stopped.load(Ordering::Relaxed);
            }
            reported.set(Instant::now());
            self.goes_on(Report::Waiting)
        })?;
        self.patiently(|its| Ok(results::keep(its.workers.store, &sent.expected.task, &splats)?))?;
        self.forget_task(sent)?;
        self.done(sent, splats, false);
        Ok(())
    }

    fn find(&self, sent: &Sent) -> Result<Found, MergeError> {
        self.patiently(|its| Ok(results::find(its.workers.store, &sent.expected)?))
    }

    fn note_bad(&self, sent: &mut Sent, reason: &str) {
        sent.bad += 1;
        let then = if sent.bad < BAD_MAX { "a worker distils it again" } else { "this computer distils it" };
        let name = &sent.name()[..12];
        self.tell(format!("a result of tile {name} is not believed and deleted: {reason}; {then}"));
    }

    /// Queues a task, unless it is in the queue.
    fn queue(&self, sent: &Sent) -> Result<(), MergeError> {
        let Workers { store, queue, .. } = self.workers;
        self.patiently(|its| Ok(queue.send(&its.here.class, &sent.name(), store.folder_name())?))
    }

    /// Removes a task that is done.
    fn forget_task(&self, sent: &Sent) -> Result<(), MergeError> {
        self.patiently(|its| Ok(its.workers.store.remove(&task::name(&sent.expected.task))?))
    }

    fn done(&self, sent: &Sent, splats: Splats, was_found: bool) {
        let learnt = Learnt { record: TileRecord::of(&sent.expected.task, &splats), splats, was_found };
        let _ = self.say.send(Report::Done(sent.index, Ok(learnt)));
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
