//! The faults that cosurf holds itself to survive, by number, and where each is tested.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

/// Number, what goes wrong, and the file whose test of that number (`fault_01_…`) makes it go wrong.
const FAULTS: [(u32, &str, &str); 20] = [
    (1, "the broker is killed in mid-upload", "shared/link/tests/faults.rs"),
    (2, "chunks come twice, out of order, or not", "shared/link/tests/faults.rs"),
    (3, "messages are corrupt or truncated", "shared/link/tests/faults.rs"),
    (4, "lengths are hostile", "shared/link/tests/faults.rs"),
    (5, "compressed bytes are a bomb", "shared/link/src/codec/tests.rs"),
    (6, "values cannot be rendered", "shared/link/tests/faults.rs"),
    (7, "models are poisoned", "aggregator/src/gate/tests.rs"),
    (8, "replays, old counters, wrong names", "shared/link/tests/faults.rs"),
    (9, "frame, scale, datum or origin are wrong", "aggregator/src/gate/tests.rs"),
    (10, "the disk is full, at every write", "shared/link/tests/disk.rs"),
    (11, "power is lost between any two steps", "shared/scene/src/atomic/power.rs"),
    (12, "clocks jump", "shared/link/tests/faults.rs"),
    (13, "one is slow", "shared/link/tests/faults.rs"),
    (14, "messages are larger than the broker takes", "shared/link/tests/faults.rs"),
    (15, "two drones have one name", "shared/link/tests/faults.rs"),
    (16, "the aggregator is killed in mid-merge", "aggregator/src/service/tests.rs"),
    (17, "certificates are expired or revoked", "shared/link/tests/mosquitto.rs"),
    (18, "the link is away for ten minutes", "shared/link/tests/faults.rs"),
    (19, "the other side is of another version", "shared/link/tests/faults.rs"),
    (20, "noise asks for memory", "shared/link/tests/faults.rs"),
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
