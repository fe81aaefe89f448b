//! Runs programs for Windows under Wine, in a prefix of their own.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use tempfile::TempDir;

use crate::skips::skip;

/// Wine 8 has no `bcryptprimitives.dll`, from which Rust's standard library takes its random bytes.
const STUB: &str = "#include <windows.h>\n#include <ntsecapi.h>\n\
    __declspec(dllexport) BOOL WINAPI ProcessPrng(PBYTE bytes, SIZE_T count) {\n\
        return RtlGenRandom(bytes, (ULONG)count);\n\
    }\n";
const COMPILER: &str = "x86_64-w64-mingw32-gcc";
/// Where Debian has Wine's programs, which are not on `PATH`.
const FOLDER: &str = "/usr/lib/wine";

/// Wine with the programs of the folder that the environment variable `COSURF_WINDOWS` names. All that runs in it is ended
/// when this value is dropped.
#[derive(Debug)]
pub struct Wine {
    loader: PathBuf,
    folder: TempDir,
}

impl Wine {
    /// If anything is missing, reports that the test is skipped and returns `None`; panics instead if the environment
    /// variable `REQUIRE_WINE` is set.
    pub fn start() -> Option<Self> {
        let built = env::var_os("COSURF_WINDOWS").map(PathBuf::from);
        let loader = Path::new(FOLDER).join("wine64");
        let folder = tempfile::tempdir().unwrap();
        let missing = match &built {
            None => "COSURF_WINDOWS names no folder with the programs for Windows",
            Some(_) if !loader.is_file() => "wine64 is not installed",
            Some(_) if !makes_stub(folder.path()) => "gcc-mingw-w64-x86-64 is not installed",
            Some(built) => {
                for name in ["cosurf-agent.exe", "cosurf-aggregator.exe"] {
                    fs::copy(built.join(name), folder.path().join(name)).unwrap();
                }
                return Some(Self { loader, folder });
            }
        };
        skip("REQUIRE_WINE", missing);
        None
    }

    /// The folder in which programs run, and in which they lie.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// A command of a program, for example `cosurf-agent`.
    pub fn command(&self, name: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new(&self.loader);
        command.arg(format!("{name}.exe")).args(arguments);
        self.set_up(&mut command);
        command
    }

    /// Runs a program until its end.
    pub fn run(&self, name: &str, arguments: &[&str]) -> Output {
        self.command(name, arguments).output().unwrap()
    }

    /// Starts a program in a terminal. What is written to its input is typed, and what it prints is in `typed.log` at once.
    pub fn type_to(&self, name: &str, arguments: &str) -> Child {
        let mut command = Command::new("script");
        // `exec`, because a shell that waits for the program would answer to Ctrl-C, too, with a status of its own.
        command.args([
            "-qefc",
            &format!("exec {} {name}.exe {arguments}", self.loader.display()),
            "typed.log",
        ]);
        self.set_up(&mut command);
        command.stdin(Stdio::piped()).spawn().unwrap()
    }

    /// The processes whose command line has this text.
    pub fn processes(&self, text: &str) -> Vec<u32> {
        let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
        let ids = entries.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
        let is_ours = |id: &u32| {
            let read = |file: &str| fs::read(format!("/proc/{id}/{file}")).unwrap_or_default();
            let line = String::from_utf8_lossy(&read("cmdline")).into_owned();
            let prefix = self.prefix();
            let environment = String::from_utf8_lossy(&read("environ")).into_owned();
            line.contains(text) && environment.contains(prefix.to_str().unwrap())
        };
        ids.filter(is_ours).collect()
    }

    fn prefix(&self) -> PathBuf {
        self.folder.path().join("wine")
    }

    fn set_up(&self, command: &mut Command) {
        // Without Mono and Gecko, which a new prefix asks for.
        let settings = [("WINEDEBUG", "-all"), ("WINEDLLOVERRIDES", "mscoree,mshtml="), ("DISPLAY", "")];
        command.env("WINEPREFIX", self.prefix()).envs(settings).current_dir(self.folder());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    }
}

impl Drop for Wine {
    fn drop(&mut self) {
        let mut server = Command::new(Path::new(FOLDER).join("wineserver64"));
        self.set_up(server.args(["-k", "-w"]));
        let _ = server.status();
    }
}

fn makes_stub(folder: &Path) -> bool {
    fs::write(folder.join("stub.c"), STUB).unwrap();
    let mut compiler = Command::new(COMPILER);
    compiler.args(["-shared", "-o", "bcryptprimitives.dll", "stub.c", "-ladvapi32"]).current_dir(folder);
    compiler.status().is_ok_and(|status| status.success())
}
