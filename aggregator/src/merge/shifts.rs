//! Work on several models or tiles at once, as far as the memory allows it.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;

use cosurf_engine::budget::PROCESS_BYTES;

use super::error::MergeError;

/// How jobs are shared among threads. Two jobs side by side take less time than one after the other with two threads
/// each, because much of a small job cannot be divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shifts {
    /// Number of jobs that are done at once, at least 1.
    at_once: usize,
    /// Number of threads for each job, at least 1.
    pub(crate) threads: usize,
}

impl Shifts {
    /// Jobs that take up to `job_bytes` each, in a process that may take `memory_bytes`. At least one job is done at a
    /// time, even if it takes more.
    pub(crate) fn of(job_bytes: u64, memory_bytes: u64, threads: usize) -> Self {
        let fitting = memory_bytes.saturating_sub(PROCESS_BYTES) / job_bytes.max(1);
        let at_once = usize::try_from(fitting).unwrap_or(usize::MAX).clamp(1, threads);
        Self { at_once, threads: threads / at_once }
    }

    /// Two jobs at once, with one thread each.
    #[cfg(test)]
    pub(crate) const PAIR: Self = Self { at_once: 2, threads: 1 };

    /// Does `work` for each index below `count`, and passes the results to `take` in the order of the indices. Each
    /// thread keeps a value for `work` from one index to the next. `is_given_up` is called between results; if it returns
    /// true, the result is an error.
    pub(crate) fn run<S: Default, T: Send>(
        self,
        count: usize,
        is_given_up: &dyn Fn() -> bool,
        work: impl Fn(&mut S, usize) -> Result<T, MergeError> + Sync,
        mut take: impl FnMut(usize, T) -> Result<(), MergeError>,
    ) -> Result<(), MergeError> {
        let mut take = |index, result: Result<T, MergeError>| match is_given_up() {
            true => Err(MergeError::GivenUp),
            false => take(index, result?),
        };
        if self.at_once.min(count) <= 1 {
            let mut kept = S::default();
            return (0..count).try_for_each(|index| take(index, work(&mut kept, index)));
        }
        let (next, is_stopped) = (AtomicUsize::new(0), AtomicBool::new(false));
        thread::scope(|scope| {
            let (say, results) = mpsc::channel();
            for _ in 0..self.at_once.min(count) {
                let (say, work, next, is_stopped) = (say.clone(), &work, &next, &is_stopped);
                scope.spawn(move || {
                    let mut kept = S::default();
                    while !is_stopped.load(Ordering::Relaxed) {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        // Nobody listens any more once a job has failed.
                        if index >= count || say.send((index, work(&mut kept, index))).is_err() {
                            return;
                        }
                    }
                });
            }
            drop(say);
            let mut early = BTreeMap::new();
            let mut awaited = 0;
            let taken = results.into_iter().try_for_each(|(index, result)| {
                early.insert(index, result);
                while let Some(result) = early.remove(&awaited) {
                    take(awaited, result)?;
                    awaited += 1;
                }
                Ok(())
            });
            is_stopped.store(true, Ordering::Relaxed);
            taken
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_jobs_are_done_at_once_as_fit() {
        let with = |spare: u64| Shifts::of(10 << 20, PROCESS_BYTES + (spare << 20), 4);
        assert_eq!(with(0), Shifts { at_once: 1, threads: 4 });
        assert_eq!(with(19), Shifts { at_once: 1, threads: 4 });
        assert_eq!(with(20), Shifts { at_once: 2, threads: 2 });
        assert_eq!(with(1000), Shifts { at_once: 4, threads: 1 });
    }

    #[test]
    fn results_come_in_order_and_a_failure_ends_all() {
        for at_once in [1, 3] {
            let shifts = Shifts { at_once, threads: 1 };
            let mut taken = Vec::new();
            let work = |done: &mut u64, index: usize| {
                *done += 1;
                thread::sleep(std::time::Duration::from_millis(7 * (index as u64 % 3)));
                if index == 17 { Err(MergeError::BadTask) } else { Ok(10 * index) }
            };
            let done = shifts.run(12, &|| false, work, |index, result| {
                taken.push((index, result));
                Ok(())
            });
            assert!(done.is_ok());
            assert_eq!(taken, (0..12).map(|index| (index, 10 * index)).collect::<Vec<_>>());
            let failed = shifts.run(100, &|| false, work, |_, _| Ok(()));
            assert!(matches!(failed, Err(MergeError::BadTask)), "{failed:?}");
            let given_up = shifts.run(12, &|| true, work, |_, _| Ok(()));
            assert!(matches!(given_up, Err(MergeError::GivenUp)), "{given_up:?}");
        }
    }
}
