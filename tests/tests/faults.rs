//! Lists the faults that cosurf must survive, and checks that each fault has a test.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

/// Number of the fault, its description, and the file with its test. The test's name begins with the number
/// (`fault_01_…`).
const FAULTS: [(u32, &str, &str); 20] = [
    (1, "the broker is killed during an upload", "shared/link/tests/faults.rs"),
    (2, "chunks are duplicated, out of order or lost", "shared/link/tests/faults.rs"),
    (3, "messages are corrupt or truncated", "shared/link/tests/faults.rs"),
    (4, "lengths are hostile", "shared/link/tests/faults.rs"),
    (5, "compressed bytes unpack to far too much", "shared/link/src/codec/tests.rs"),
    (6, "values cannot be rendered", "shared/link/tests/faults.rs"),
    (7, "models are poisoned", "aggregator/src/gate/tests.rs"),
    (8, "models are replayed, have old numbers or wrong names", "shared/link/tests/faults.rs"),
    (9, "frame, scale, datum or origin is wrong", "aggregator/src/gate/tests.rs"),
    (10, "the disk is full, at every write", "shared/link/tests/disk.rs"),
    (11, "power is lost between any two steps", "shared/scene/src/atomic/power.rs"),
    (12, "clocks jump", "shared/link/tests/faults.rs"),
    (13, "one upload stalls", "shared/link/tests/faults.rs"),
    (14, "messages are larger than the broker allows", "shared/link/tests/faults.rs"),
    (15, "two drones have the same name", "shared/link/tests/faults.rs"),
    (16, "the aggregator is killed during a merge", "aggregator/src/service/tests.rs"),
    (17, "certificates are expired or revoked", "shared/link/tests/mosquitto.rs"),
    (18, "the link is down for ten minutes", "shared/link/tests/faults.rs"),
    (19, "the other side runs another version", "shared/link/tests/faults.rs"),
    (20, "random messages ask for memory", "shared/link/tests/faults.rs"),
];

#[test]
fn every_fault_has_its_test() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for (number, what, file) in FAULTS {
        let text = fs::read_to_string(root.join(file)).unwrap();
        let is_tested = text.contains(&format!("#[test]\nfn fault_{number:02}_"));
        assert!(is_tested, "{file} has no test of fault {number}: {what}");
    }
}
