//! The CSV file *Internal/External camera parameters*: a line with the names of the columns, then a line for each picture.
//!
//! The columns `heading`, `pitch` and `roll`, degrees, turn a camera that looks down with its upper side to the north:
//! `world_from_cam = Rz(-heading) Rx(pitch) Ry(roll)` for a camera with x right, y up and z backward. `f` is in millimetres;
//! `px` and `py` are shares of the longer side, as RealityScan's newer names for the same columns say.

use std::path::Path;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::film::FilmLens;
use crate::error::Refusal;
use crate::shot::{Shot, find_picture, picture_folder};
use crate::{Pose, SceneError, xml};

/// Columns that must be there.
const NEEDED: [&str; 8] = ["#name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
/// Columns that are 0 if they are not there.
const OPTIONAL: [&str; 8] = ["px", "py", "k1", "k2", "k3", "k4", "t1", "t2"];
/// Names that RealityScan 2 gives to columns.
const RENAMED: [(&str, &str); 4] =
    [("heading", "yaw"), ("f", "f_35mm"), ("px", "px_norm"), ("py", "py_norm")];

/// Whether a file's beginning is that of such a file.
pub(super) fn is_one(head: &str) -> bool {
    head.lines().take(2).any(|line| Columns::of(line).is_ok())
}

/// Reads a file.
pub(super) fn read(path: &Path) -> Result<Vec<Shot>, SceneError> {
    let text = xml::read(path)?;
    shots(&text, &picture_folder(path)).map_err(|refusal| refusal.of(path))
}

fn shots(text: &str, folder: &Path) -> Result<Vec<Shot>, Refusal> {
    let mut lines = (1..).zip(text.trim_start_matches('\u{FEFF}').lines());
    // The number of cameras may come before the names of the columns.
    let mut header = lines.next().map_or("", |(_, line)| line);
    if header.starts_with("#cameras") {
        header = lines.next().map_or("", |(_, line)| line);
    }
    let columns = Columns::of(header)?;
    let filled = lines.filter(|(_, line)| !line.trim().is_empty());
    filled
        .map(|(number, line)| {
            shot(&columns, line, folder).map_err(|refusal| refusal.at(format_args!("line {number}")))
        })
        .collect()
}

/// Where each column is.
struct Columns {
    needed: [usize; NEEDED.len()],
    optional: [Option<usize>; OPTIONAL.len()],
}

impl Columns {
    fn of(header: &str) -> Result<Self, Refusal> {
        let names: Vec<&str> = header.trim_start_matches('\u{FEFF}').split(',').map(str::trim).collect();
        let named = |name: &str| names.iter().position(|found| found.eq_ignore_ascii_case(name));
        let renamed =
            |name: &str| RENAMED.iter().find(|(old, _)| *old == name).and_then(|(_, new)| named(new));
        let place = |name: &str| named(name).or_else(|| renamed(name));
        let mut needed = [0; NEEDED.len()];
        for (column, name) in needed.iter_mut().zip(NEEDED) {
            *column = place(name).ok_or_else(|| {
                format!(
                    "has no column {name}; export `Internal/External camera parameters` from RealityCapture"
                )
            })?;
        }
        Ok(Self { needed, optional: OPTIONAL.map(place) })
    }
}

fn shot(columns: &Columns, line: &str, folder: &Path) -> Result<Shot, Refusal> {
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    let field =
        |column: usize| fields.get(column).copied().ok_or_else(|| Refusal::from("has too few fields"));
    let number = |column: usize| {
        let text = field(column)?;
        let parsed = text.parse().ok().filter(|number: &f64| number.is_finite());
        parsed.ok_or_else(|| Refusal::from(format!("'{}' is not a finite number", text.escape_debug())))
    };
    let optional = |name: usize| columns.optional[name].map_or(Ok(0.0), &number);
    let [name, x, y, alt, heading, pitch, roll, f] = columns.needed;
    let (name, path) = find_picture(folder, field(name)?);
    let center = DVec3::new(number(x)?, number(y)?, number(alt)?);
    let rotation = cam_from_world([number(heading)?, number(pitch)?, number(roll)?]);
    let lens = FilmLens {
        focal_mm: number(f)?,
        center_share: DVec2::new(optional(0)?, optional(1)?),
        distortion: [optional(2)?, optional(3)?, optional(4)?, optional(5)?, optional(6)?, optional(7)?],
    };
    let lens = lens.on(&path)?;
    Ok(Shot { name, path, cam_from_world: Pose { rotation, translation: -(rotation * center) }, lens })
}

/// The rotation of heading, pitch and roll, degrees.
fn cam_from_world(turns_deg: [f64; 3]) -> DQuat {
    let [heading, pitch, roll] = turns_deg.map(f64::to_radians);
    let upright =
        DMat3::from_rotation_z(-heading) * DMat3::from_rotation_x(pitch) * DMat3::from_rotation_y(roll);
    // From x right, y up, z backward to x right, y down, z forward.
    let world_from_cam = upright * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    DQuat::from_mat3(&world_from_cam.transpose()).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headings_turn_as_the_program_itself_says() {
        // One camera of RealityCapture as CSV and as XMP, from a question to its makers (forums.unrealengine.com/t/710449).
        let turned = DMat3::from_quat(cam_from_world([
            163.736_597_399_311,
            83.415_431_346_162_8,
            174.386_496_244_756,
        ]));
        let told = crate::rotation::from_rows(&[
            0.982_594_073,
            0.185_426_734,
            -0.011_216_689,
            -0.032_113_633,
            0.110_081_027,
            -0.993_403_685,
            -0.182_968_856,
            0.976_472_782,
            0.114,
        ]);
        assert!(turned.abs_diff_eq(told, 2e-4), "{turned} {told}");
    }
}
