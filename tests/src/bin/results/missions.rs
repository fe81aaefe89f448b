//! Measurements of missions over real photographs, and of the models of their agents.

use anyhow::Result;
use cosurf_tests::results::{Better, Column, Measurement, Results, Tolerance};
use serde_json::Value;
use tempfile::TempDir;

use crate::benches::TRAINING;
use crate::commands::{MIB, agents, build, dataset, evaluate, merge, mission, train};

/// Compares the joined models and the merged models of four agents with one model that is trained on the views of all
/// agents. With `--compress-first`, only one agent uploads the splats of ground that several agents observe.
pub(crate) fn missions(folder: &TempDir) -> Result<Results> {
    build()?;
    let caliterra = dataset("real_caliterra")?;
    let out = |name: &str| folder.path().join(name);
    let sent = Column::new("sent", "MiB", 2).guarded(Better::Lower, Tolerance::Relative(0.05));
    let left = Column::new("splats left to other agents", "%", 0);
    let mut measurement =
        Measurement::start("missions", &[Column::psnr("PSNR"), Column::splats(), sent, left]);

    let alone = train(&caliterra, &["--max-size", "240", "--steps", "3200"], &out("alone"))?;
    measurement.row("one model of all views", &[alone.figure("/psnr"), alone.figure("/splats"), None, None]);
    let merged = mission(Some(&caliterra), &TRAINING, &out("merged"))?;
    merge(&agents(&out("merged"), 4), &["--epochs", "0", "--no-compress"], &out("joined"))?;
    let joined = evaluate(&out("joined"), &caliterra, &TRAINING[..2])?;
    let figure = |value: &Value, pointer| value.pointer(pointer).and_then(Value::as_f64);
    measurement
        .row("four agents, joined", &[figure(&joined, "/mean/psnr"), figure(&joined, "/splats"), None, None]);
    let compressed = merge(&agents(&out("merged"), 4), &["--epochs", "0"], &out("compressed"))?;
    let first = mission(Some(&caliterra), &[&TRAINING[..], &["--compress-first"]].concat(), &out("first"))?;
    let cases = [
        ("four agents, merged", merged, share_left(&compressed)),
        ("the same, `--compress-first`", first, None),
    ];
    for (name, outcome, left) in cases {
        let [psnr, splats, bytes] = ["/whole/quality/psnr", "/whole/splats", "/whole/bytes_sent"]
            .map(|pointer| outcome.figure(pointer));
        measurement.row(name, &[psnr, splats, bytes.map(|bytes| bytes / MIB), left]);
    }
    Ok(measurement.finish()?)
}

/// The share of splats that a merge removed because another agent owns them, percent.
fn share_left(merge: &Value) -> Option<f64> {
    let locals = merge.pointer("/merge/locals")?.as_array()?;
    let sum = |name: &str| locals.iter().map(|local| local[name].as_f64()).sum::<Option<f64>>();
    Some(100.0 * sum("removed")? / sum("arrived")?)
}
