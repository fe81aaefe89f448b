//! Runs COLMAP: finds it, reads which options its version has, keeps what it prints, and tells its progress.

mod output;

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use cosurf_scene::SceneError;

use super::error::IngestError;
pub(super) use output::Progress;
use output::{Complaint, progress};

/// Most that is read of a help text, bytes.
const HELP_BYTES_MAX: u64 = 1 << 20;

/// COLMAP on this computer.
pub(super) struct Colmap {
    program: PathBuf,
}

impl Colmap {
    /// Finds the program, and checks that it is COLMAP.
    pub(super) fn find(program: &Path) -> Result<Self, IngestError> {
        let its = Self { program: program.to_owned() };
        let help = its.help("help")?;
        // The first versions with all commands and options that are used here, 3.6 of 2020, begin so too.
        let is_it = help.trim_start().starts_with("COLMAP") && help.contains("image_undistorter");
        if is_it { Ok(its) } else { Err(its.not_colmap(&help)) }
    }

    fn not_colmap(&self, printed: &str) -> IngestError {
        let first = printed.lines().map(str::trim).find(|line| !line.is_empty());
        let said = first.map_or_else(|| "it prints nothing".to_owned(), |line| format!("it prints: {line}"));
        IngestError::NotColmap { program: self.program.clone(), said }
    }

    /// The command with those of these options that its version has. Options are tried with each name in turn: versions
    /// renamed them. A version without an option for a path, which is no choice, is refused.
    pub(super) fn command(
        &self,
        name: &str,
        options: &[(&[&str], OsString)],
    ) -> Result<Vec<OsString>, IngestError> {
        let help = self.help(name)?;
        if !help.contains("--") {
            return Err(self.not_colmap(&help));
        }
        let has = |option: &&&str| help.split_whitespace().any(|word| word == format!("--{option}"));
        let mut command = vec![OsString::from(name)];
        for (names, value) in options {
            if let Some(known) = names.iter().find(has) {
                command.extend([OsString::from(format!("--{known}")), value.clone()]);
            } else if names[0].ends_with("_path") {
                let (program, command, option) = (self.program.clone(), name.into(), names[0].into());
                return Err(IngestError::UnknownColmap { program, command, option });
            }
        }
        Ok(command)
    }

    fn help(&self, command: &str) -> Result<String, IngestError> {
        let failed = |cause| IngestError::NoColmap { program: self.program.clone(), cause };
        let (reader, writer) = io::pipe().map_err(failed)?;
        let mut run = Command::new(&self.program);
        run.arg(command).stdin(Stdio::null()).stdout(writer.try_clone().map_err(failed)?).stderr(writer);
        if command != "help" {
            run.arg("--help");
        }
        let mut child = run.spawn().map_err(failed)?;
        drop(run); // its ends of the pipe, or reading would not end
        let mut text = Vec::new();
        let read = reader.take(HELP_BYTES_MAX).read_to_end(&mut text);
        child.wait().and(read).map_err(failed)?;
        Ok(String::from_utf8_lossy(&text).into_owned())
    }

    /// Runs a command. What it prints is appended to `log`, and `tell` gets its progress. If this process ends, the command
    /// ends with its next line, as nobody reads it.
    pub(super) fn run(
        &self,
        command: &[OsString],
        log: &Path,
        tell: &mut dyn FnMut(Progress),
    ) -> Result<(), IngestError> {
        let failed = |cause| IngestError::NoColmap { program: self.program.clone(), cause };
        let logging = |cause| SceneError::io(log, cause);
        let mut file = File::options().create(true).append(true).open(log).map_err(logging)?;
        let (reader, writer) = io::pipe().map_err(failed)?;
        let mut run = Command::new(&self.program);
        run.args(command).stdin(Stdio::null()).stdout(writer.try_clone().map_err(failed)?).stderr(writer);
        let mut child = run.spawn().map_err(failed)?;
        drop(run);
        let (mut reader, mut line, mut complaint) =
            (BufReader::new(reader), Vec::new(), Complaint::default());
        while reader.read_until(b'\n', &mut line).map_err(logging)? > 0 {
            file.write_all(&line).map_err(logging)?;
            let text = String::from_utf8_lossy(&line);
            complaint.read(&text);
            progress(&text).into_iter().for_each(&mut *tell);
            line.clear();
        }
        let status = child.wait().map_err(failed)?;
        if status.success() {
            return Ok(());
        }
        // A program that is killed has no last words; those that it printed before are of its work.
        let reason = match status.code() {
            None => format!(
                "it was killed ({status}), most often because memory ran out; run the same command again"
            ),
            Some(_) => match complaint.text().unwrap_or_else(|| status.to_string()) {
                locked if locked.contains("database is locked") => {
                    format!(
                        "{locked}: COLMAP of a run that was killed still works; try again when it has ended"
                    )
                }
                reason => reason,
            },
        };
        let command = command[0].to_string_lossy().into_owned();
        Err(IngestError::Failed { command, reason, log: log.to_owned() })
    }
}
