//! Runs agents as processes: starts them, reads their events, restarts those that die, and ends all when the
//! mission ends.
//!
//! An agent prints [`AgentEvent`] lines on its standard output. Its standard error goes to `agent.log` in its
//! folder. A process that dies (killed, crashed, panicked) is restarted at most [`RESTARTS_MAX`] times; it
//! then resumes from its checkpoint. A process that exits with an error is not restarted: it would fail
//! again.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_contract::{AgentEvent, ENDS_WITH_STDIN};

/// Largest number of restarts of a process that dies.
pub(crate) const RESTARTS_MAX: u32 = 5;
/// The pause before restart `n` is `n` times this, so that a temporary cause has time to end.
const RESTART_PAUSE: Duration = Duration::from_millis(300);
/// Interval at which the exit of a process is polled.
const POLL: Duration = Duration::from_millis(20);
/// Longest line that is read from an agent, bytes; events are far shorter.
const LINE_BYTES_MAX: u64 = 1 << 16;
/// Number of bytes at the end of a log that are searched for the reason of a failure.
const LOG_TAIL_BYTES: u64 = 4096;
/// The exit code of a Rust process that panicked.
const PANIC_CODE: i32 = 101;

/// How to start one agent.
#[derive(Clone, Debug)]
pub(crate) struct AgentCommand {
    /// The executable.
    pub(crate) program: PathBuf,
    /// The arguments of the executable.
    pub(crate) arguments: Vec<String>,
    /// The file to which the agent's standard error is appended.
    pub(crate) log: PathBuf,
}

/// An event of one agent.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ProcessEvent {
    /// Index into the commands given to [`AgentProcesses::start`].
    pub(crate) agent: usize,
    /// What happened.
    pub(crate) kind: ProcessEventKind,
}

/// What happened to an agent.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ProcessEventKind {
    /// The agent printed an event.
    Said(AgentEvent),
    /// The process died and is about to be restarted.
    Restarting {
        /// Number of this restart, from 1.
        attempt: u32,
        /// How the process died.
        reason: String,
    },
    /// The process exited without an error.
    Ended,
    /// The process failed and is not restarted.
    Failed {
        /// The reason, one line.
        reason: String,
    },
}

/// Running agents. Dropping this value ends them all.
pub(crate) struct AgentProcesses {
    stopping: Arc<AtomicBool>,
    children: Vec<Arc<Mutex<Option<Child>>>>,
    threads: Vec<JoinHandle<()>>,
}

impl AgentProcesses {
    /// Starts one process for each command. A thread for each process passes its events to `events`.
    pub(crate) fn start(
        commands: Vec<AgentCommand>,
        events: impl Fn(ProcessEvent) + Clone + Send + 'static,
    ) -> Self {
        let mut processes = Self {
            stopping: Arc::new(AtomicBool::new(false)),
            children: commands.iter().map(|_| Arc::default()).collect(),
            threads: Vec::with_capacity(commands.len()),
        };
        for (agent, command) in commands.into_iter().enumerate() {
            let events = events.clone();
            let supervisor = Supervisor {
                command,
                child: processes.children[agent].clone(),
                stopping: processes.stopping.clone(),
                say: Box::new(move |kind| events(ProcessEvent { agent, kind })),
            };
            processes.threads.push(thread::spawn(move || supervisor.run()));
        }
        processes
    }
}

impl Drop for AgentProcesses {
    fn drop(&mut self) {
        self.stopping.store(true, Ordering::SeqCst);
        for child in &self.children {
            if let Some(child) = lock(child).as_mut() {
                let _ = child.kill(); // fails only if the process has already exited
            }
        }
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// The thread that runs one agent.
struct Supervisor {
    command: AgentCommand,
    child: Arc<Mutex<Option<Child>>>,
    stopping: Arc<AtomicBool>,
    say: Box<dyn Fn(ProcessEventKind) + Send>,
}

impl Supervisor {
    fn run(&self) {
        for restarts in 0.. {
            let outcome = self.run_once();
            if self.stopping.load(Ordering::SeqCst) {
                return;
            }
            let (reason, died) = match outcome {
                Ok(status) if status.success() => return (self.say)(ProcessEventKind::Ended),
                Ok(status) => (self.reason(status), is_death(status)),
                Err(error) => (format!("cannot start {}: {error}", self.command.program.display()), false),
            };
            if !died {
                return (self.say)(ProcessEventKind::Failed { reason });
            }
            let attempt = restarts + 1;
            if attempt > RESTARTS_MAX {
                let reason = format!("{reason}, again after each of {RESTARTS_MAX} restarts");
                return (self.say)(ProcessEventKind::Failed { reason });
            }
            (self.say)(ProcessEventKind::Restarting { attempt, reason });
            thread::sleep(RESTART_PAUSE * attempt);
        }
    }

    fn run_once(&self) -> io::Result<ExitStatus> {
        let stdout = self.spawn()?;
        self.listen(stdout);
        loop {
            if let Some(child) = lock(&self.child).as_mut()
                && let Some(status) = child.try_wait()?
            {
                return Ok(status);
            }
            thread::sleep(POLL);
        }
    }

    /// Starts the process, unless [`AgentProcesses`] is being dropped.
    fn spawn(&self) -> io::Result<Option<ChildStdout>> {
        let log = File::options().create(true).append(true).open(&self.command.log)?;
        let mut slot = lock(&self.child);
        if self.stopping.load(Ordering::SeqCst) {
            return Err(io::ErrorKind::Interrupted.into());
        }
        let mut child = Command::new(&self.command.program)
            .args(&self.command.arguments)
            // Never written to: the agent ends once this process has, even if it was killed.
            .stdin(Stdio::piped())
            .env(ENDS_WITH_STDIN, "1")
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()?;
        let stdout = child.stdout.take();
        *slot = Some(child);
        Ok(stdout)
    }

    /// Passes the agent's events on until the process closes its standard output. Ignores all other lines.
    fn listen(&self, stdout: Option<ChildStdout>) {
        let Some(stdout) = stdout else { return };
        let mut reader = BufReader::new(stdout);
        let mut line = Vec::new();
        while matches!(reader.by_ref().take(LINE_BYTES_MAX).read_until(b'\n', &mut line), Ok(1..)) {
            if let Ok(event) = serde_json::from_slice::<AgentEvent>(&line) {
                (self.say)(ProcessEventKind::Said(event));
            }
            line.clear();
        }
    }

    /// Why the process ended: its last error message, its exit status, or both.
    fn reason(&self, status: ExitStatus) -> String {
        let last_message = read_tail(&self.command.log).ok().and_then(|tail| last_message(&tail));
        match (is_death(status), last_message) {
            (true, Some(message)) => format!("{status}; the last line of its log: {message}"),
            (true, None) => status.to_string(),
            (false, Some(message)) => message,
            (false, None) => format!("{status} without an error message; see {}", self.command.log.display()),
        }
    }
}

/// True if a process was killed or panicked; false if it exited by itself.
fn is_death(status: ExitStatus) -> bool {
    status.code().is_none_or(|code| code == PANIC_CODE)
}

fn read_tail(log: &Path) -> io::Result<String> {
    let mut file = File::open(log)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(LOG_TAIL_BYTES)))?;
    let mut tail = Vec::new();
    file.take(LOG_TAIL_BYTES).read_to_end(&mut tail)?;
    Ok(String::from_utf8_lossy(&tail).into_owned())
}

/// The last line of a log, not counting empty lines and lines that begin with `note: `. A prefix such as
/// `error: ` is removed.
fn last_message(log: &str) -> Option<String> {
    let mut lines = log.lines().rev().map(str::trim);
    let line = lines.find(|line| !line.is_empty() && !line.starts_with("note: "))?;
    let prefixes = ["cosurf-agent: ", "error: ", "Error: "];
    Some(prefixes.iter().find_map(|prefix| line.strip_prefix(prefix)).unwrap_or(line).to_string())
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(all(test, unix))]
mod tests {
    //! Shell scripts stand in for agents, so that a test can make them crash.
    #![allow(clippy::unwrap_used)]
    use std::fs;
    use std::sync::mpsc::{self, Receiver};
    use std::time::Instant;

    use tempfile::TempDir;

    use super::*;

    /// Starts one agent: a shell that runs `script` in `folder`.
    fn start(script: &str, folder: &TempDir) -> (AgentProcesses, Receiver<ProcessEventKind>) {
        let command = AgentCommand {
            program: "/bin/sh".into(),
            arguments: vec!["-c".into(), format!("cd '{}'; {script}", folder.path().display())],
            log: folder.path().join("agent.log"),
        };
        let (sender, receiver) = mpsc::channel();
        (AgentProcesses::start(vec![command], move |event| sender.send(event.kind).unwrap()), receiver)
    }

    fn acknowledged(bytes_sent: u64) -> ProcessEventKind {
        ProcessEventKind::Said(AgentEvent::Acknowledged { bytes_sent })
    }

    #[test]
    fn events_arrive_and_other_output_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"echo hello; echo '{"event":"acknowledged","bytes_sent":7}'; echo '{"event":"no"}'"#;
        let (_processes, events) = start(script, &folder);
        assert_eq!(events.iter().take(2).collect::<Vec<_>>(), [acknowledged(7), ProcessEventKind::Ended]);
    }

    #[test]
    fn a_killed_agent_is_restarted() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"
            if [ ! -e once ]; then touch once; kill -9 $$; fi
            echo '{"event":"acknowledged","bytes_sent":8}'"#;
        let (_processes, events) = start(script, &folder);
        let events: Vec<_> = events.iter().take(3).collect();
        let ProcessEventKind::Restarting { attempt: 1, reason } = &events[0] else { panic!("{events:?}") };
        assert!(reason.contains("signal: 9"), "{reason}");
        assert_eq!(events[1..], [acknowledged(8), ProcessEventKind::Ended]);
    }

    #[test]
    fn an_agent_that_always_dies_fails_after_its_restarts() {
        let folder = tempfile::tempdir().unwrap();
        let (_processes, events) = start("echo x >> runs; kill -9 $$", &folder);
        let events: Vec<_> = events.iter().collect();
        assert_eq!(events.len(), 6, "{events:?}");
        let ProcessEventKind::Failed { reason } = &events[5] else { panic!("{events:?}") };
        assert!(reason.contains("after each of 5 restarts"), "{reason}");
        assert_eq!(fs::read_to_string(folder.path().join("runs")).unwrap().lines().count(), 6);
    }

    #[test]
    fn an_agent_that_exits_with_an_error_fails_at_once_with_its_message() {
        let folder = tempfile::tempdir().unwrap();
        let (_processes, events) = start("echo 'error: no images in x' >&2; exit 1", &folder);
        let reason = "no images in x".to_string();
        assert_eq!(events.iter().collect::<Vec<_>>(), [ProcessEventKind::Failed { reason }]);
    }

    #[test]
    fn a_missing_executable_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let command = AgentCommand {
            program: folder.path().join("nobody"),
            arguments: Vec::new(),
            log: folder.path().join("agent.log"),
        };
        let (sender, events) = mpsc::channel();
        let _processes = AgentProcesses::start(vec![command], move |event| sender.send(event.kind).unwrap());
        let event = events.recv().unwrap();
        assert!(
            matches!(&event, ProcessEventKind::Failed { reason } if reason.contains("nobody")),
            "{event:?}"
        );
    }

    /// What a killed mission leaves: its end of the agent's standard input is closed.
    #[test]
    fn an_agent_can_tell_that_its_mission_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"
            if [ "$COSURF_ENDS_WITH_STDIN" != 1 ]; then exit 1; fi
            echo '{"event":"acknowledged","bytes_sent":5}'; cat; echo '{"event":"acknowledged","bytes_sent":6}'"#;
        let (processes, events) = start(script, &folder);
        assert_eq!(events.recv().unwrap(), acknowledged(5));
        assert!(events.recv_timeout(Duration::from_millis(300)).is_err(), "it ends too soon");
        let input = lock(&processes.children[0]).as_mut().unwrap().stdin.take();
        drop(input);
        assert_eq!(events.recv_timeout(Duration::from_secs(10)), Ok(acknowledged(6)));
    }

    #[test]
    fn dropping_the_fleet_ends_its_processes() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"echo $$ > pid; echo '{"event":"acknowledged","bytes_sent":9}'; exec sleep 60"#;
        let (processes, events) = start(script, &folder);
        assert_eq!(events.recv().unwrap(), acknowledged(9));
        let begun = Instant::now();
        drop(processes);
        assert!(begun.elapsed() < Duration::from_secs(5), "the drop waited for the sleeping process");
        let pid = fs::read_to_string(folder.path().join("pid")).unwrap();
        let alive =
            Command::new("/bin/kill").args(["-0", pid.trim()]).stderr(Stdio::null()).status().unwrap();
        assert!(!alive.success(), "process {pid} still runs");
        assert_eq!(events.iter().count(), 0, "an event came after the drop");
    }
}
