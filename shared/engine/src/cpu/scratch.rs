//! Memory that a kernel needs while it works on one band of a picture. Each thread has its own, allocated once.

use std::sync::{Mutex, PoisonError};

/// One value for each thread of a pool.
#[derive(Debug)]
pub(crate) struct PerThread<T>(Box<[Mutex<T>]>);

impl<T> PerThread<T> {
    /// Makes one value for each of `threads` threads, at least 1.
    pub(crate) fn new(threads: usize, make: impl Fn() -> T) -> Self {
        Self((0..threads).map(|_| Mutex::new(make())).collect())
    }

    /// Calls `work` with the value of the current thread. The value is locked until `work` returns. `work` must not wait
    /// for other jobs of the pool: while a thread waits, it may start a job that locks the same value, which is a
    /// deadlock. A thread outside the pool shares the value of a pool thread, and may wait for it.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let index = rayon::current_thread_index().unwrap_or(0) % self.0.len();
        // If another kernel panicked, its lock is poisoned. The numbers that it left are overwritten by the next
        // kernel.
        work(&mut self.0[index].lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Sets `values` to `len` zeros.
#[inline(always)]
pub(crate) fn zeros(values: &mut Vec<f32>, len: usize) {
    values.clear();
    values.resize(len, 0.0);
}
