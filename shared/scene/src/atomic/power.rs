//! Tests with a simulated disk that loses power: unsynced data may survive whole, in half or not at
//! all.
#![allow(clippy::unwrap_used)]

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use super::*;

const PATH: &str = "folder/model";
const PARTIAL: &str = "folder/.model.partial";

/// All bytes written to a file, and those that were synced.
#[derive(Clone, Debug, Default)]
struct Content {
    written: Vec<u8>,
    synced: Vec<u8>,
}

#[derive(Clone, Debug, Default)]
struct FailingDisk {
    files: Rc<RefCell<Vec<Content>>>,
    names: Rc<RefCell<BTreeMap<PathBuf, usize>>>,
    synced_names: Rc<RefCell<BTreeMap<PathBuf, usize>>>,
    /// Number of operations before the power fails.
    left: Rc<Cell<u32>>,
}

impl FailingDisk {
    /// A disk with the synced content `old` at [`PATH`], which loses power after `left` operations.
    fn new(old: &[u8], left: u32) -> Self {
        let disk = Self::default();
        disk.files.borrow_mut().push(Content { written: old.to_vec(), synced: old.to_vec() });
        disk.names.borrow_mut().insert(PATH.into(), 0);
        disk.synced_names.replace(disk.names.borrow().clone());
        disk.left.set(left);
        disk
    }

    fn power(&self) -> io::Result<()> {
        let left = self.left.get().checked_sub(1).ok_or_else(|| io::Error::other("no power"))?;
        self.left.set(left);
        Ok(())
    }

    /// Every content that [`PATH`] may have when the power returns.
    fn survivors(&self) -> Vec<Vec<u8>> {
        let files = self.files.borrow();
        let mut found = Vec::new();
        for names in [self.names.borrow(), self.synced_names.borrow()] {
            let Content { written, synced } = &files[names[Path::new(PATH)]];
            found.push(synced.clone());
            found.push(written[..synced.len().max(written.len() / 2)].to_vec());
            found.push(written.clone());
        }
        found
    }
}

struct FailingFile {
    disk: FailingDisk,
    file: usize,
}

impl Write for FailingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.disk.power()?;
        let some = bytes.len().min(100);
        self.disk.files.borrow_mut()[self.file].written.extend_from_slice(&bytes[..some]);
        Ok(some)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Disk for FailingDisk {
    type File = FailingFile;

    fn create(&self, path: &Path) -> io::Result<FailingFile> {
        self.power()?;
        let mut files = self.files.borrow_mut();
        files.push(Content::default());
        self.names.borrow_mut().insert(path.to_owned(), files.len() - 1);
        Ok(FailingFile { disk: self.clone(), file: files.len() - 1 })
    }

    fn sync(&self, file: &FailingFile) -> io::Result<()> {
        self.power()?;
        let content = &mut self.files.borrow_mut()[file.file];
        content.synced = content.written.clone();
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.power()?;
        let mut names = self.names.borrow_mut();
        let file = names.remove(from).unwrap();
        names.insert(to.to_owned(), file);
        Ok(())
    }

    fn sync_folder(&self, _folder: &Path) -> io::Result<()> {
        self.power()?;
        self.synced_names.replace(self.names.borrow().clone());
        Ok(())
    }
}

/// Models, checkpoints and session numbers are written by [`write()`], so they survive a power cut
/// between any two of its steps.
#[test]
fn fault_11_power_loss_between_any_two_steps() {
    let (old, new) = (vec![1; 350], vec![2; 450]);
    let mut outcomes = [0, 0];
    for left in 0..20 {
        let disk = FailingDisk::new(&old, left);
        let done =
            write_and_rename(&disk, Path::new(PARTIAL), Path::new(PATH), |out| out.write_all(&new)).is_ok();
        outcomes[usize::from(done)] += 1;
        for survivor in disk.survivors() {
            let is_whole = survivor == new || (survivor == old && !done);
            assert!(
                is_whole,
                "power lost after {left} steps: {} bytes, acknowledged: {done}",
                survivor.len()
            );
        }
    }
    assert!(outcomes[0] >= 8 && outcomes[1] >= 8, "{outcomes:?}");
}
