//! Checks the commands that documents show: their options exist, and each command is run by CI or was run by hand.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use cosurf_tests::programs::program;
use cosurf_tests::results::document::unmarked;

use crate::text::{documents, lines, read};

/// Documents whose commands must all have been run, by CI or by hand.
const RUN: [&str; 4] =
    ["README.md", "shared/docs/INSTALL.md", "shared/docs/OPERATING.md", "shared/docs/STATION.md"];
/// The commands that were run by hand. Each line is the date of the run and the command.
const BY_HAND: &str = include_str!("by_hand.txt");

/// The commands in a document's code blocks marked `sh`.
fn commands(document: &str) -> Vec<String> {
    let shell = lines(document).into_iter().filter(|(language, _)| *language == Some("sh"));
    split(shell.map(|(_, line)| line))
}

/// The commands of a shell script's lines, without comments. `&&` separates two commands of a line.
fn split<'a>(lines: impl Iterator<Item = &'a str>) -> Vec<String> {
    let lines = lines.filter(|line| !line.trim_start().starts_with('#'));
    let lines = lines.map(|line| line.split_once(" #").map_or(line, |(command, _)| command));
    let commands = lines.flat_map(|line| line.split("&&")).map(|command| command.trim().to_owned());
    commands.filter(|command| !command.is_empty()).collect()
}

/// The commands that the script of CI runs, without `--locked` at their end: the documents leave it out.
fn run_by_ci(script: &str) -> BTreeSet<String> {
    let joined = script.replace("\\\n", "");
    let commands = split(joined.lines()).into_iter();
    commands.map(|command| command.strip_suffix(" --locked").unwrap_or(&command).to_owned()).collect()
}

/// Commands of our programs, with arguments, that a document shows outside of code blocks marked `sh`. There no test
/// would see them. Tables between markers are left out, because `results` writes their commands.
fn hidden_commands(document: &str) -> Vec<String> {
    let document = unmarked(document).collect::<Vec<_>>().join("\n");
    let code = lines(&document).into_iter().flat_map(|(language, line)| match language {
        None => line.split('`').skip(1).step_by(2).collect::<Vec<&str>>(),
        Some("sh") => Vec::new(),
        Some(_) => vec![line.trim()],
    });
    let is_command = |code: &str| code.starts_with("cosurf-") && code.split_whitespace().count() > 2;
    code.filter(|code| is_command(code)).map(str::to_owned).collect()
}

/// The options of a command that the program's `--help` does not list; `None` if the program is not one of ours.
fn unknown_options(command: &str, helps: &mut BTreeMap<String, String>) -> Option<Vec<String>> {
    let words: Vec<&str> = command.split_whitespace().collect();
    // Environment variables (`NAME=value`) come before the program.
    let at = words.iter().position(|word| !word.contains('='))?;
    let (name, subcommand) = (words[at].rsplit('/').next()?, words.get(at + 1)?);
    if !["cosurf-agent", "cosurf-aggregator"].contains(&name) {
        return None;
    }
    let help = helps.entry(format!("{name} {subcommand}")).or_insert_with(|| {
        let output = Command::new(program(name)).args([subcommand, "--help"]).output().unwrap();
        assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    });
    let is_known = |option: &str| help.split([' ', '\n', ',', '=', '[']).any(|word| word == option);
    let options = words[at..].iter().filter(|word| word.starts_with("--"));
    let options = options.filter_map(|word| word.split('=').next()).filter(|option| !is_known(option));
    Some(options.map(str::to_owned).collect())
}

#[test]
fn every_option_that_documents_show_exists() {
    let mut helps = BTreeMap::new();
    for document in documents() {
        for command in commands(&read(&document)) {
            let unknown = unknown_options(&command, &mut helps);
            assert_eq!(unknown.unwrap_or_default(), [""; 0], "{document}: {command}");
        }
    }
    assert!(helps.len() > 4, "hardly any command was found: {:?}", helps.keys());
    let wrong = unknown_options("cosurf-agent train DATA --no-such-option", &mut helps);
    assert_eq!(wrong, Some(vec!["--no-such-option".to_owned()]));
}

/// A changed command must be run again. The entry of a removed command must be deleted from the list.
#[test]
fn every_command_is_run_by_ci_or_was_by_hand() {
    let by_ci = run_by_ci(&read(".ci/run"));
    let shown = RUN.iter().flat_map(|document| commands(&read(document)));
    let not_by_ci: BTreeSet<String> = shown.filter(|command| !by_ci.contains(command)).collect();
    let by_hand = BY_HAND.lines().map(|line| line.split_once(' ').expect("a day and a command").1.to_owned());
    assert_eq!(not_by_ci, by_hand.collect(), "left: shown and not run by CI, right: by_hand.txt");
}

#[test]
fn ci_runs_whole_commands() {
    let script = "# cargo a && cargo a\nX=1 cargo b\ncargo c --release \\\n-p d --locked\ncargo e && cargo f --locked # cargo g\n";
    let expected = ["X=1 cargo b", "cargo c --release -p d", "cargo e", "cargo f"].map(str::to_owned);
    assert_eq!(run_by_ci(script), BTreeSet::from(expected), "neither `cargo c` nor `cargo c --release`");
}

#[test]
fn commands_stand_in_blocks_of_shell() {
    for document in RUN {
        assert_eq!(hidden_commands(&read(document)), [""; 0], "{document}: move them into `sh` blocks");
    }
}

#[test]
fn hidden_commands_are_found() {
    let text = "`cosurf-a run` and `cosurf-a forget b`\n```\ncosurf-a eval c\n```\n```sh\ncosurf-a train d\n```\n\
                <!-- results: x -->\n`cosurf-a train e`: today\n<!-- end of results -->\n";
    assert_eq!(hidden_commands(text), ["cosurf-a forget b", "cosurf-a eval c"]);
}
