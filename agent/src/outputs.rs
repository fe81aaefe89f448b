//! The files that a training writes: `model.ply`, `cameras.json`, `report.json`, and `geo.json` of a dataset that has one.

use std::fs;
use std::io::Write;
use std::path::Path;

use anyhow::{Context, Result};
use cosurf_contract::TrainReport;
use cosurf_geo::Georeference;
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

/// Notes in the report of the training in `out` that the process has taken so much memory since.
pub fn note_peak(out: &Path, peak_memory_bytes: u64) -> Result<()> {
    let path = out.join("report.json");
    let Ok(report) = serde_json::from_slice::<TrainReport>(&files::read(&path)?) else { return Ok(()) };
    let peak_memory_bytes = report.peak_memory_bytes.max(peak_memory_bytes);
    write_json(&path, &TrainReport { peak_memory_bytes, ..report })
}

/// Copies `geo.json`, which tells where on the earth a dataset lies, into the folder of its model. A model of a dataset without
/// it has none, either.
pub fn take_over_place(data: &Path, out: &Path) -> Result<()> {
    let folder = files::folder_of(data);
    let place = Georeference::of_folder(folder)?;
    let path = out.join(Georeference::FILE);
    files::set_aside_unless_file(&path)?;
    match place {
        Some(place) => atomic::write_bytes(&path, place.to_json().as_bytes())?,
        None if path.is_file() => fs::remove_file(&path).with_context(|| path.display().to_string())?,
        None => {}
    }
    Ok(())
}

/// Writes a value as indented JSON, atomically.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    atomic::write(path, |file| {
        serde_json::to_writer_pretty(&mut *file, value)?;
        writeln!(file)
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_geo::Geodetic;

    use super::*;

    #[test]
    fn a_model_lies_where_its_dataset_lies() {
        let [data, out] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let place =
            Georeference::at(Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 }).unwrap();
        fs::write(data.path().join(Georeference::FILE), place.to_json()).unwrap();
        take_over_place(data.path(), out.path()).unwrap();
        assert_eq!(Georeference::of_folder(out.path()).unwrap(), Some(place));
        fs::remove_file(data.path().join(Georeference::FILE)).unwrap();
        take_over_place(data.path(), out.path()).unwrap();
        assert_eq!(Georeference::of_folder(out.path()).unwrap(), None);
        fs::write(data.path().join(Georeference::FILE), "{\"origin\": 5}").unwrap();
        assert!(take_over_place(data.path(), out.path()).unwrap_err().to_string().contains("geo.json"));
    }
}
