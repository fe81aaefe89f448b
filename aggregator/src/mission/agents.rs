//! Agents as processes: started, listened to, started again when they die, ended with the mission.
//!
//! An agent speaks in [`AgentEvent`] lines on its standard output; its standard error goes to
//! `agent.log` in its folder. A process that dies (killed, crashed, panicked) is started again and
//! goes on from its checkpoint, at most [`RESTARTS_MAX`] times. A process that ends with an error of
//! its own has said why, and would say so again: that is for good.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_scene::report::AgentEvent;

/// How often a process that dies is started again.
pub(crate) const RESTARTS_MAX: u32 = 5;
/// Pause before the n-th restart, times n: what kills a process at once need not kill it at once again.
const RESTART_PAUSE: Duration = Duration::from_millis(300);
/// How often an ending process is looked at.
const POLL: Duration = Duration::from_millis(20);
/// The longest line that an agent may say; events stay far below.
const LINE_BYTES_MAX: u64 = 1 << 16;
/// How much of the end of a log is looked at for the reason of a failure.
const LOG_TAIL_BYTES: u64 = 4096;
/// The exit code of a Rust process that panicked.
const PANIC_CODE: i32 = 101;

/// How to start one agent.
#[derive(Clone, Debug)]
pub(crate) struct AgentCommand {
    /// The executable.
    pub(crate) program: PathBuf,
    /// Its arguments.
    pub(crate) arguments: Vec<String>,
    /// Where its standard error is appended to.
    pub(crate) log: PathBuf,
}

/// What happened to an agent.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ProcessEvent {
    /// Index into the orders.
    pub(crate) agent: usize,
    /// What.
    pub(crate) kind: ProcessEventKind,
}

/// See [`ProcessEvent`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ProcessEventKind {
    /// It said something.
    Said(AgentEvent),
    /// It died and is about to be started again.
    Restarting {
        /// 1 for the first restart.
        attempt: u32,
        /// How it died.
        reason: String,
    },
    /// It ended well.
    Ended,
    /// It ended for good without having done its work.
    Failed {
        /// Why, one line.
        reason: String,
    },
}

/// Running agents. Dropping it ends them all.
pub(crate) struct AgentProcesses {
    stopping: Arc<AtomicBool>,
    children: Vec<Arc<Mutex<Option<Child>>>>,
    threads: Vec<JoinHandle<()>>,
}

impl AgentProcesses {
    /// Starts one process per order, each watched by a thread that tells `events` what happens.
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
                let _ = child.kill(); // fails only where it ended by itself
            }
        }
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// One thread's view of one agent.
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
                let reason = format!("{reason}, and so after each of {RESTARTS_MAX} restarts");
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

    /// Starts the process, unless the fleet is being ended: then none may be born any more.
    fn spawn(&self) -> io::Result<Option<ChildStdout>> {
        let log = File::options().create(true).append(true).open(&self.command.log)?;
        let mut slot = lock(&self.child);
        if self.stopping.load(Ordering::SeqCst) {
            return Err(io::ErrorKind::Interrupted.into());
        }
        let mut child = Command::new(&self.command.program)
            .args(&self.command.arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()?;
        let stdout = child.stdout.take();
        *slot = Some(child);
        Ok(stdout)
    }

    /// Passes events on until the process closes its standard output. What is no event is left out.
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

    /// How the process ended, with the last line of its log.
    fn reason(&self, status: ExitStatus) -> String {
        let last_words = read_tail(&self.command.log).ok().and_then(|tail| last_words(&tail));
        match (is_death(status), last_words) {
            (true, Some(words)) => format!("{status}; its last words: {words}"),
            (true, None) => status.to_string(),
            (false, Some(words)) => words,
            (false, None) => format!("{status} without a word; see {}", self.command.log.display()),
        }
    }
}

/// Whether a process was ended from outside or by a defect, rather than by its own judgement.
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

/// The last line that says something, without the prefix that says it is an error.
fn last_words(log: &str) -> Option<String> {
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
    //! The agents here are shell scripts, so that they can be made to crash at will.
    #![allow(clippy::unwrap_used)]
    use std::fs;
    use std::sync::mpsc::{self, Receiver};
    use std::time::Instant;

    use tempfile::TempDir;

    use super::*;

    /// Starts one agent that runs `script` in a shell, in a folder of its own.
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
    fn events_arrive_and_other_talk_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"echo hello; echo '{"event":"acknowledged","bytes_sent":7}'; echo '{"event":"no"}'"#;
        let (_processes, events) = start(script, &folder);
        assert_eq!(events.iter().take(2).collect::<Vec<_>>(), [acknowledged(7), ProcessEventKind::Ended]);
    }

    #[test]
    fn a_killed_agent_is_started_again() {
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
    fn an_agent_that_gives_up_itself_fails_at_once_with_its_own_words() {
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

    #[test]
    fn dropping_the_fleet_ends_its_processes() {
        let folder = tempfile::tempdir().unwrap();
        let script = r#"echo $$ > pid; echo '{"event":"acknowledged","bytes_sent":9}'; exec sleep 60"#;
        let (processes, events) = start(script, &folder);
        assert_eq!(events.recv().unwrap(), acknowledged(9));
        let begun = Instant::now();
        drop(processes);
        assert!(begun.elapsed() < Duration::from_secs(5), "it did not wait for the sleeper");
        let pid = fs::read_to_string(folder.path().join("pid")).unwrap();
        let alive =
            Command::new("/bin/kill").args(["-0", pid.trim()]).stderr(Stdio::null()).status().unwrap();
        assert!(!alive.success(), "process {pid} is gone");
        assert_eq!(events.iter().count(), 0, "and nobody complains");
    }
}
