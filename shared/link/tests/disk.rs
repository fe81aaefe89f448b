//! A disk that becomes full while a model is stored, after different numbers of bytes.
#![cfg(unix)]
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;

use cosurf_link::{ModelKey, ModelStore};
use cosurf_tests::offers::offer;
use cosurf_wire::ModelKind;

const CHILD: &str = "COSURF_TEST_FULL_DISK";

/// A child process stores a model while the system limits the size of the files that it writes. The limits
/// rise from 0. The model that was stored earlier must stay intact, and the new one must be stored completely
/// or not at all. The child must report success only if the model is stored.
#[test]
fn fault_10_disk_full_at_every_write() {
    let old = offer("drone", 1, ModelKind::Local, 1, 500, 1024);
    let new = offer("drone", 2, ModelKind::Local, 2, 8000, 1024);
    if let Some(folder) = std::env::var_os(CHILD) {
        let (store, _) = ModelStore::open(Path::new(&folder)).unwrap();
        let is_stored = store.put(&new.header, &new.body).is_ok();
        std::process::exit(if is_stored { 7 } else { 8 });
    }
    let (mut kept, mut stored) = (0, 0);
    // The system limits files in blocks of 512 bytes.
    for blocks in (0..new.body.len() as u64 / 512 + 40).step_by(9) {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = ModelStore::open(folder.path()).unwrap();
        store.put(&old.header, &old.body).unwrap();
        let status = Command::new("sh")
            .args(["-c", &format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" --exact \"$1\"")])
            .arg(std::env::current_exe().unwrap())
            .arg("fault_10_disk_full_at_every_write")
            .env(CHILD, folder.path())
            .output()
            .unwrap()
            .status;
        let was_reported = match status.code() {
            Some(7) => true,
            Some(8) => false,
            _ => panic!("{blocks} blocks: {status}"),
        };
        let (store, headers) = ModelStore::open(folder.path()).unwrap();
        assert_eq!(headers.len(), 1 + usize::from(was_reported), "{blocks} blocks");
        assert!(store.get(ModelKey::from(old.header)).unwrap().1 == old.body, "{blocks} blocks");
        if was_reported {
            assert!(store.get(ModelKey::from(new.header)).unwrap().1 == new.body, "{blocks} blocks");
        }
        let files = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(files, headers.len(), "{blocks} blocks: something is left behind");
        kept += u32::from(!was_reported);
        stored += u32::from(was_reported);
    }
    assert!(kept > 5 && stored > 0, "{kept} refused, {stored} stored");
}
