//! The files that a training writes: `model.ply`, `cameras.json`, `report.json`.

use std::io::Write;
use std::path::Path;

use anyhow::Result;
use cosurf_contract::TrainReport;
use cosurf_scene::{Camera, LocalFrame, Splats, atomic, camera_list, ply};
use serde::Serialize;

/// Writes all three files into `out`, each one atomically. `frame` is that of the splats and cameras; the files hold the
/// frame's origin and world cameras.
pub fn write(
    out: &Path,
    splats: &Splats,
    cameras: &[Camera],
    frame: &LocalFrame,
    report: &TrainReport,
) -> Result<()> {
    ply::write(&out.join("model.ply"), splats, frame)?;
    let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.world_camera(camera)).collect();
    camera_list::write(&out.join(camera_list::FILE), &cameras)?;
    write_json(&out.join("report.json"), report)
}

/// Writes a value as indented JSON, atomically.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    atomic::write(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        writeln!(file)
    })?;
    Ok(())
}
