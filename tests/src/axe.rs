//! Checks pages with axe-core, the rules of which find what keeps people out who use a keyboard or a screen reader.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::chromium::Chromium;
use crate::skips::skip;

/// The script of axe-core.
#[derive(Debug)]
pub struct Axe(String);

impl Axe {
    /// The one that `.ci/run` has installed. If it is missing, reports that the test is skipped and returns `None`; panics
    /// instead if the environment variable `REQUIRE_AXE` is set.
    pub fn installed() -> Option<Self> {
        let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        let file = workspace.join("target/validators/node_modules/axe-core/axe.min.js");
        let script = fs::read_to_string(file).ok();
        if script.is_none() {
            skip("REQUIRE_AXE", "axe-core is not installed");
        }
        script.map(Self)
    }

    /// The serious and critical faults of the page that a browser shows, one line each.
    pub fn faults(&self, browser: &Chromium) -> Vec<String> {
        browser.run(&self.0);
        let found = browser.value("axe.run().then(({violations}) => violations)");
        let violations = found.as_array().unwrap().iter();
        let bad = violations.filter(|its| its["impact"] == "serious" || its["impact"] == "critical");
        let line = |its: &Value| format!("{}: {} ({})", its["id"], its["help"], its["nodes"][0]["html"]);
        bad.map(line).collect()
    }
}
