//! The control group of this process: containers and units of systemd limit memory through it (cgroups(7)).

use std::fs;
use std::path::{Path, PathBuf};

/// Where the control groups are mounted.
const ROOT: &str = "/sys/fs/cgroup";
/// Limits from here on are no limits: version 1 writes the largest multiple of a page.
const NO_LIMIT_BYTES: u64 = 1 << 60;

/// The tightest limit on memory of the group and of those that contain it, bytes; `None` if there is none.
pub(super) fn limit_bytes() -> Option<u64> {
    levels().iter().filter_map(Level::limit_bytes).min()
}

/// What the group may still take, bytes; `None` if there is no limit.
pub(super) fn free_bytes() -> Option<u64> {
    levels().iter().filter_map(Level::free_bytes).min()
}

fn levels() -> Vec<Level> {
    let own = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    levels_of(&own, Path::new(ROOT))
}

/// A group: its folder, and the names of its files.
struct Level {
    folder: PathBuf,
    limit: &'static str,
    taken: &'static str,
}

/// The group that `/proc/self/cgroup` names, and all above it. In a container the folder may be missing: the container's
/// own group is then the root.
fn levels_of(own: &str, root: &Path) -> Vec<Level> {
    let mut levels = Vec::new();
    for line in own.lines() {
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else { continue };
        let (root, limit, taken) = match controllers {
            "" => (root.to_owned(), "memory.max", "memory.current"),
            _ if controllers.split(',').any(|name| name == "memory") => {
                (root.join("memory"), "memory.limit_in_bytes", "memory.usage_in_bytes")
            }
            _ => continue,
        };
        let own = root.join(path.trim_start_matches('/'));
        let folders = own.ancestors().take_while(|folder| folder.starts_with(&root));
        levels.extend(folders.map(|folder| Level { folder: folder.to_owned(), limit, taken }));
    }
    levels
}

impl Level {
    fn limit_bytes(&self) -> Option<u64> {
        self.number(self.limit).filter(|bytes| *bytes < NO_LIMIT_BYTES)
    }

    fn free_bytes(&self) -> Option<u64> {
        let taken = self.number(self.taken)?.saturating_sub(self.reclaimable_bytes());
        Some(self.limit_bytes()?.saturating_sub(taken))
    }

    /// Pages of files that were not used for long: the system drops them before it refuses memory.
    fn reclaimable_bytes(&self) -> u64 {
        let text = fs::read_to_string(self.folder.join("memory.stat")).unwrap_or_default();
        let value = text.lines().find_map(|line| line.strip_prefix("inactive_file "));
        value.and_then(|value| value.parse().ok()).unwrap_or(0)
    }

    fn number(&self, file: &str) -> Option<u64> {
        fs::read_to_string(self.folder.join(file)).ok()?.trim().parse().ok()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn limit_and_free(own: &str, root: &Path) -> (Option<u64>, Option<u64>) {
        let levels = levels_of(own, root);
        let least = |of: fn(&Level) -> Option<u64>| levels.iter().filter_map(of).min();
        (least(Level::limit_bytes), least(Level::free_bytes))
    }

    #[test]
    fn the_tightest_limit_of_all_groups_counts() {
        let root = tempfile::tempdir().unwrap();
        let unit = root.path().join("system.slice/cosurf.service");
        fs::create_dir_all(&unit).unwrap();
        for (file, text) in [
            ("system.slice/cosurf.service/memory.max", "max\n"),
            ("system.slice/memory.max", "1000\n"),
            ("system.slice/memory.current", "700\n"),
            ("system.slice/memory.stat", "anon 400\ninactive_file 200\n"),
            ("memory.max", "2000\n"),
        ] {
            fs::write(root.path().join(file), text).unwrap();
        }
        let own = "0::/system.slice/cosurf.service\n";
        assert_eq!(limit_and_free(own, root.path()), (Some(1000), Some(500)));
        assert_eq!(limit_and_free("0::/a/container/of/others\n", root.path()).0, Some(2000));
        assert_eq!(limit_and_free("", root.path()), (None, None));
    }

    #[test]
    fn the_older_version_is_read_too() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("memory/docker/7");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("memory.limit_in_bytes"), "4096\n").unwrap();
        fs::write(root.path().join("memory/memory.limit_in_bytes"), "9223372036854771712\n").unwrap();
        let own = "7:cpu:/docker/7\n5:memory,hugetlb:/docker/7\n";
        assert_eq!(limit_and_free(own, root.path()).0, Some(4096));
    }
}
