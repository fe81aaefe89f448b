//! Ctrl-C and requests to terminate while a training is under way: it ends with a checkpoint after the current step. A
//! second request ends the program at once, as does one outside of a training.

use std::process;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};

/// Exit code of a program that a signal has ended, as shells report it for Ctrl-C.
const ENDED_BY_SIGNAL: i32 = 130;

static IS_TRAINING: AtomicBool = AtomicBool::new(false);
static IS_ASKED: AtomicBool = AtomicBool::new(false);

/// Catches the signals from now on. To be called once.
pub(super) fn listen() -> Result<()> {
    ctrlc::set_handler(|| {
        if !IS_TRAINING.load(Ordering::SeqCst) || IS_ASKED.swap(true, Ordering::SeqCst) {
            process::exit(ENDED_BY_SIGNAL);
        }
    })
    .context("cannot install the Ctrl-C handler")
}

/// A training that ends when it is asked to.
pub(super) struct Stoppable(());

impl Stoppable {
    pub(super) fn begin() -> Self {
        IS_TRAINING.store(true, Ordering::SeqCst);
        Self(())
    }

    /// Whether the training is asked to end.
    pub(super) fn is_asked(&self) -> bool {
        IS_ASKED.load(Ordering::SeqCst)
    }
}

impl Drop for Stoppable {
    fn drop(&mut self) {
        IS_TRAINING.store(false, Ordering::SeqCst);
    }
}
