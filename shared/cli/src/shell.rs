//! `completions` and `man`: a program's command line, written for shells and for `man`.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Args, Command, CommandFactory};
use clap_complete::Shell;
use clap_mangen::Man;
use cosurf_scene::atomic;

use crate::VERSION;

/// Print the completion script of a shell, which lets the Tab key complete commands and options.
#[derive(Args, Debug)]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Write the manual pages: one for the program, and one for each command.
#[derive(Args, Debug)]
pub struct ManArgs {
    /// Folder to write to; it is created if it is absent
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

/// Prints the completion script for the command line `P`.
pub fn completions<P: CommandFactory>(args: &CompletionsArgs) -> Result<()> {
    io::stdout().lock().write_all(&script::<P>(args.shell))?;
    Ok(())
}

fn script<P: CommandFactory>(shell: Shell) -> Vec<u8> {
    let mut command = P::command();
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut command, name, &mut script);
    script
}

/// Writes the manual pages of the command line `P`.
pub fn man<P: CommandFactory>(args: &ManArgs) -> Result<()> {
    let folder = &args.folder;
    fs::create_dir_all(folder)
        .with_context(|| format!("{}: the folder cannot be made; name another", folder.display()))?;
    let mut command = P::command().disable_help_subcommand(true);
    command.build();
    write_pages(&command, folder)
}

/// Writes the page of a command, and those of its own commands.
fn write_pages(command: &Command, folder: &Path) -> Result<()> {
    let name = command.get_display_name().unwrap_or_else(|| command.get_name()).to_owned();
    // In place of a date: pages without one show the next field there.
    let page =
        Man::new(command.clone()).title(name.to_uppercase()).date(VERSION).source("cosurf").manual("cosurf");
    let mut text = Vec::new();
    page.render(&mut text)?;
    atomic::write_bytes(&folder.join(format!("{name}.1")), &text)?;
    command.get_subcommands().try_for_each(|command| write_pages(command, folder))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use clap::{Parser, Subcommand};

    use super::*;

    #[derive(Parser)]
    #[command(name = "fly")]
    struct Fly {
        #[command(subcommand)]
        _command: FlyCommand,
    }

    #[derive(Subcommand)]
    enum FlyCommand {
        /// Rise above the ground.
        Rise {
            /// Height in metres
            #[arg(long)]
            height: f64,
        },
    }

    #[test]
    fn scripts_name_commands_and_options() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let script = String::from_utf8(script::<Fly>(shell)).unwrap();
            assert!(script.contains("rise") && script.contains("height"), "{shell}: {script}");
        }
    }

    #[test]
    fn the_program_and_each_command_get_a_page() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("share/man1");
        man::<Fly>(&ManArgs { folder: folder.clone() }).unwrap();
        let mut names: Vec<_> =
            fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["fly-rise.1", "fly.1"]);
        let page = fs::read_to_string(folder.join("fly-rise.1")).unwrap();
        assert!(page.contains("Height in metres"), "{page}");
        let blocked = folder.join("fly.1").join("below-a-file");
        let error = man::<Fly>(&ManArgs { folder: blocked }).unwrap_err().to_string();
        assert!(error.contains("name another"), "{error}");
    }
}
