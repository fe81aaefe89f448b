//! Keeps what graphics drivers print to standard error away from the user. Mesa complains there about a missing
//! `XDG_RUNTIME_DIR` on every computer without a desktop, though nothing is wrong.

/// Runs `open` without standard error. Lines that other threads write there meanwhile are lost, so `open` must be short.
pub(super) fn hushed<T>(open: impl FnOnce() -> T) -> T {
    #[cfg(unix)]
    let _hush = Hush::begin();
    open()
}

/// Standard error goes nowhere until this value is dropped.
#[cfg(unix)]
struct Hush {
    /// Where standard error went before; `None` if it could not be changed.
    before: Option<std::os::fd::OwnedFd>,
    /// Two threads must not change it at the same time, or one would restore what the other had changed.
    _turn: std::sync::MutexGuard<'static, ()>,
}

#[cfg(unix)]
impl Hush {
    fn begin() -> Self {
        static TURN: std::sync::Mutex<()> = std::sync::Mutex::new(());
        let turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let nowhere = || {
            let before = rustix::io::fcntl_dupfd_cloexec(std::io::stderr(), 3).ok()?;
            let nowhere = std::fs::File::options().write(true).open("/dev/null").ok()?;
            rustix::stdio::dup2_stderr(nowhere).ok()?;
            Some(before)
        };
        Self { before: nowhere(), _turn: turn }
    }
}

#[cfg(unix)]
impl Drop for Hush {
    fn drop(&mut self) {
        if let Some(before) = &self.before {
            let _ = rustix::stdio::dup2_stderr(before);
        }
    }
}
