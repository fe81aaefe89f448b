//! Ctrl-C and requests to terminate while a training is under way: it ends with a checkpoint after the current step. A
//! second request ends the program at once, as does one outside of a training.

use std::io::{self, Write};
use std::process;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};
use cosurf_agent::status::StatusBoard;
use cosurf_cli::ENDED_BY_SIGNAL;

/// Interval at which a program that is to end looks whether its training has ended.
const TRAINING_POLL: Duration = Duration::from_millis(100);

/// How long a connected agent has, outside of a training, to tell that it was stopped.
const LAST_STATUS_TIME: Duration = Duration::from_millis(500);

static IS_TRAINING: AtomicBool = AtomicBool::new(false);
static IS_ASKED: AtomicBool = AtomicBool::new(false);
static BOARD: OnceLock<StatusBoard> = OnceLock::new();

/// Catches the signals from now on. To be called once.
pub(super) fn listen() -> Result<()> {
    ctrlc::set_handler(|| {
        if !IS_TRAINING.load(Ordering::SeqCst) || IS_ASKED.swap(true, Ordering::SeqCst) {
            let _ = writeln!(io::stderr(), "\ncosurf-agent: stopped"); // fails only if nobody reads
            if let Some(board) = BOARD.get() {
                board.stop();
                thread::sleep(LAST_STATUS_TIME);
            }
            process::exit(ENDED_BY_SIGNAL.into());
        }
    })
    .context("cannot install the Ctrl-C handler")
}

/// Ends the program, as a signal would, once nobody holds the other end of standard input: a mission that starts agents
/// holds it, and cannot tell them when it is killed.
pub(super) fn end_with_stdin() {
    thread::spawn(|| {
        let _ = io::copy(&mut io::stdin(), &mut io::sink()); // an input that cannot be read is closed
        IS_ASKED.store(true, Ordering::SeqCst);
        while IS_TRAINING.load(Ordering::SeqCst) {
            thread::sleep(TRAINING_POLL);
        }
        process::exit(ENDED_BY_SIGNAL.into());
    });
}

/// Lets the status on the board tell that the program was stopped, also outside of a training.
pub(super) fn tell_on(board: &StatusBoard) {
    let _ = BOARD.set(board.clone()); // fails only if another board is told already
}

/// Whether the program is asked to end.
pub(super) fn is_asked() -> bool {
    IS_ASKED.load(Ordering::SeqCst)
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
        is_asked()
    }
}

impl Drop for Stoppable {
    fn drop(&mut self) {
        IS_TRAINING.store(false, Ordering::SeqCst);
    }
}
