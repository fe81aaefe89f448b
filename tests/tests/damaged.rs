//! An agent whose files were damaged while it did not run goes on by itself: it ends well, and its model and the global
//! model have the bytes that they had. Each file gets one of seven damages; `DAMAGE_SEED` (0 to 6)
//! decides which.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};

use cosurf_tests::datasets::write_city;
use cosurf_tests::running::Running;

/// What happens to a file.
type Damage = (&'static str, fn(&Path));

const DAMAGES: [Damage; 7] = [
    ("a bit flipped", |path| {
        let mut bytes = fs::read(path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        fs::write(path, bytes).unwrap();
    }),
    ("cut", |path| {
        let bytes = fs::read(path).unwrap();
        fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    }),
    ("emptied", |path| fs::write(path, "").unwrap()),
    ("garbage", |path| fs::write(path, [0xa5; 300]).unwrap()),
    ("deleted", |path| fs::remove_file(path).unwrap()),
    ("a folder in its place", |path| {
        fs::remove_file(path).unwrap();
        fs::create_dir(path).unwrap();
    }),
    ("a link that leads nowhere", |path| {
        fs::remove_file(path).unwrap();
        std::os::unix::fs::symlink("missing", path).unwrap();
    }),
];

/// Files that people read. What is in their place is not looked at before they are written anew.
const OUTPUTS: [&str; 4] = ["model.ply", "cameras.json", "report.json", "changes-global.json"];

/// The files of a folder, relative to `root`, by name.
fn files_of(root: &Path, folder: &Path) -> Vec<PathBuf> {
    let mut entries: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    let inside = |path: PathBuf| match path.is_dir() {
        true => files_of(root, &path),
        false => vec![path.strip_prefix(root).unwrap().to_owned()],
    };
    entries.into_iter().flat_map(inside).collect()
}

fn copy(from: &Path, to: &Path) {
    for file in files_of(from, from) {
        fs::create_dir_all(to.join(&file).parent().unwrap()).unwrap();
        fs::copy(from.join(&file), to.join(&file)).unwrap();
    }
}

#[test]
fn an_agent_goes_on_after_any_damage_to_its_files() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    write_city(&folder.join("data"), 40.0, 12, [64, 48]);
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let station =
        format!("site = \"site\"\nout = \"ground\"\nbind = \"{address}\"\nquorum = 1\nquiet_s = 0\n");
    fs::write(folder.join("aggregator.toml"), station).unwrap();
    let agent = format!(
        "site = \"site\"\nbroker = \"mqtt://{address}\"\ndevice = \"drone\"\ndata = \"data\"\nout = \"out\"\nsteps = 10\n\
         threads = 1\nwait_global = true\n"
    );
    fs::write(folder.join("agent.toml"), agent).unwrap();
    let _station = Running::start("cosurf-aggregator", folder, &["run"]);
    let run = || {
        let _ = fs::remove_file(folder.join("cosurf-agent.log"));
        Running::start("cosurf-agent", folder, &["run"]).end()
    };
    let (ended_well, log) = run();
    assert!(ended_well, "{log}");
    let (out, undamaged) = (folder.join("out"), folder.join("undamaged"));
    fs::rename(&out, &undamaged).unwrap();
    let files = files_of(&undamaged, &undamaged);
    assert!(files.len() >= 8, "{files:?}");
    let is_output = |file: &Path| OUTPUTS.iter().any(|output| Path::new(output) == file);
    let seed: usize = std::env::var("DAMAGE_SEED").map_or(0, |seed| seed.parse().unwrap());
    let cases = files.iter().enumerate().map(|(i, file)| (file, DAMAGES[(i + seed) % DAMAGES.len()]));
    for (file, (name, damage)) in cases {
        if is_output(file) && name == "a folder in its place" {
            continue;
        }
        copy(&undamaged, &out);
        damage(&out.join(file));
        let (ended_well, log) = run();
        assert!(ended_well, "{}, {name}: {log}", file.display());
        for same in ["model.ply", "global.ply"] {
            let same_bytes = fs::read(out.join(same)).unwrap() == fs::read(undamaged.join(same)).unwrap();
            assert!(same_bytes, "{}, {name}: another {same}: {log}", file.display());
        }
        fs::remove_dir_all(&out).unwrap();
    }
}
