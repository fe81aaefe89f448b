//! The files that a training writes: `model.ply`, `cameras.json`, `report.json`.

use std::io::Write;
use std::path::Path;

use anyhow::Result;
use cosurf_contract::TrainReport;
use cosurf_scene::{Camera, LocalFrame, Splats, atomic, camera_list, files, ply};
use serde::Serialize;

/// Writes all three files into `out`, each one atomically. A folder of such a name is set aside. `frame` is that of the splats and cameras; the files hold the
/// frame's origin and world cameras.
pub fn write(
    out: &Path,
    splats: &Splats,
    cameras: &[Camera],
    frame: &LocalFrame,
    report: &TrainReport,
) -> Result<()> {
    let [model, camera_list, report_file] =
        ["model.ply", camera_list::FILE, "report.json"].map(|name| out.join(name));
    for path in [&model, &camera_list, &report_file] {
        files::set_aside_unless_file(path)?;
    }
    ply::write(&model, splats, frame)?;
    let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.world_camera(camera)).collect();
    camera_list::write(&camera_list, &cameras)?;
    write_json(&report_file, report)
}

/// Writes a value as indented JSON, atomically.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    atomic::write(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        writeln!(file)
    })?;
    Ok(())
}
