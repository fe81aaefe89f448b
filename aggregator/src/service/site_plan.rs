//! The plan of the site: which device observes which ground, as somebody has drawn it.

use std::collections::BTreeMap;
use std::path::Path;

use cosurf_link::PlannedCell;
use cosurf_scene::{Outline, SceneError};
use cosurf_wire::{DeviceId, PLAN_COORDINATE_MAX, PLAN_CORNERS_MAX, VerticalAxis};

use crate::partition::{DrawnCell, PartitionError, read_cells};

/// Reads the cells of a GeoJSON file, each with the name of its device. `margin` is the width of the margin around each
/// cell, as a share of the cell's size. The error names the file and the cell.
pub(super) fn read_plan(file: &Path, margin: f64) -> Result<BTreeMap<DeviceId, PlannedCell>, SceneError> {
    planned(&read_cells(file)?, margin).map_err(|reason| SceneError::malformed(file, reason))
}

fn planned(cells: &[DrawnCell], margin: f64) -> Result<BTreeMap<DeviceId, PlannedCell>, String> {
    if cells.is_empty() {
        return Err("no cell is drawn: draw one polygon per drone".to_owned());
    }
    let mut plan = BTreeMap::new();
    for (i, cell) in cells.iter().enumerate() {
        let number = i + 1;
        let name = cell.device.as_deref().ok_or_else(|| {
            format!("cell {number} has no property `device`: write the name of its drone there")
        })?;
        let device = DeviceId::new(name).map_err(|error| format!("cell {number}, device: {error}"))?;
        let corners = corners(cell, number)?;
        let planned = PlannedCell { vertical: VerticalAxis::Z, corners, margin };
        if plan.insert(device, planned).is_some() {
            return Err(format!("cell {number} is the second one of {device}: draw one polygon per drone"));
        }
    }
    Ok(plan)
}

/// The corners of a cell that can be sent to a device.
fn corners(cell: &DrawnCell, number: usize) -> Result<Vec<[f64; 2]>, String> {
    let outline = Outline::polygon(&cell.corners)
        .ok_or_else(|| PartitionError::NoPolygon { cell: number }.to_string())?;
    let corners: Vec<[f64; 2]> = outline.corners().iter().map(|corner| corner.to_array()).collect();
    if corners.len() > PLAN_CORNERS_MAX {
        let count = corners.len();
        return Err(format!("cell {number} has {count} corners: draw it with at most {PLAN_CORNERS_MAX}"));
    }
    if corners.as_flattened().iter().any(|coordinate| coordinate.abs() > PLAN_COORDINATE_MAX) {
        return Err(format!("cell {number} has a coordinate beyond {PLAN_COORDINATE_MAX:e} m"));
    }
    Ok(corners)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::*;

    fn cell(device: &str, corners: &[[f64; 2]]) -> DrawnCell {
        DrawnCell { corners: corners.to_vec(), device: Some(device.to_owned()) }
    }

    const TRIANGLE: [[f64; 2]; 4] = [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [0.0, 0.0]];

    #[test]
    fn each_device_has_its_polygon_without_the_repeated_corner() {
        let plan = planned(&[cell("b", &TRIANGLE), cell("a", &TRIANGLE[..3])], 0.25).unwrap();
        let names: Vec<&str> = plan.keys().map(DeviceId::as_str).collect();
        assert_eq!(names, ["a", "b"]);
        let expected =
            PlannedCell { vertical: VerticalAxis::Z, corners: TRIANGLE[..3].to_vec(), margin: 0.25 };
        assert!(plan.values().all(|cell| *cell == expected), "{plan:?}");
    }

    #[test]
    fn a_wrong_cell_is_refused_with_its_number_and_the_remedy() {
        let nobodys = DrawnCell { corners: TRIANGLE.to_vec(), device: None };
        let many: Vec<[f64; 2]> = (0..65).map(|i| [f64::from(i), f64::from(i * i)]).collect();
        let good = cell("a", &TRIANGLE);
        for (cells, what) in [
            (vec![], "no cell is drawn"),
            (vec![good.clone(), nobodys], "cell 2 has no property `device`"),
            (vec![cell("a b", &TRIANGLE)], "cell 1, device: ' ' in a name"),
            (vec![good.clone(), cell("b", &TRIANGLE[..2])], "cell 2 is not a polygon"),
            (vec![good.clone(), good.clone()], "cell 2 is the second one of a"),
            (vec![cell("a", &many)], "cell 1 has 65 corners: draw it with at most 64"),
            (vec![cell("a", &[[0.0, 0.0], [1e9, 0.0], [0.0, 1.0]])], "beyond 1e8 m"),
        ] {
            let error = planned(&cells, 0.2).unwrap_err();
            assert!(error.contains(what) && !error.contains('\n'), "{error}");
        }
        assert!(planned(&[cell("a", &many[..64])], 0.2).is_ok());
    }

    #[test]
    fn the_error_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cells.geojson");
        let text = |error: SceneError| error.to_string();
        assert!(text(read_plan(&file, 0.2).unwrap_err()).contains("cells.geojson"));
        fs::write(&file, r#"{"type":"Polygon","coordinates":[[[0,0],[1,0],[0,1]]]}"#).unwrap();
        let error = text(read_plan(&file, 0.2).unwrap_err());
        assert!(error.contains("cells.geojson: cell 1 has no property"), "{error}");
    }
}
