//! Splats as PLY in the layout of the original 3DGS code, which viewers and other trainers open:
//! `x y z nx ny nz f_dc_0..2 f_rest_0..K opacity scale_0..2 rot_0..3`, all 32-bit floats. `f_rest` has
//! all coefficients of red, then those of green, then those of blue. Scales are natural logarithms,
//! opacities are logits, and quaternions are wxyz. The line `comment origin X Y Z` in the header tells that positions are
//! relative to that world position; without it they are world positions.
//!
//! Files are written as binary little-endian with normals of 0. The reader also accepts ascii, any
//! order of the properties, other number types, extra properties and missing normals. Files are read
//! and written row by row, so little memory is needed besides the splats.
//!
//! ```
//! use cosurf_scene::{LocalFrame, Splats, ply};
//!
//! let mut splats = Splats::with_capacity(1, 0);
//! let (mean, quat, log_scale) = ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0], [-4.0, -4.0, -6.0]);
//! splats.push(mean, quat, log_scale, 2.0, &[0.5, 0.0, -0.5]);
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("model.ply");
//! ply::write(&path, &splats, &LocalFrame::WORLD)?;
//! assert_eq!(ply::read(&path, &LocalFrame::WORLD)?, splats);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub(crate) mod compressed;
mod header;
mod points;
mod rows;
#[cfg(test)]
mod tests;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::error::Refusal;
use crate::parts::{Parts, Record};
use crate::splats::sh_coefficients;
use crate::{LocalFrame, SceneError, Splats, atomic};
use glam::DVec3;

pub(crate) use header::{Element, Kind, Scalar, origin_line};
pub use points::read_points;
pub(crate) use points::read_points_into;
pub use rows::check_length;
use rows::read_vertices;
pub(crate) use rows::{Rows, read_elements};

/// Writes the splats of a frame as a binary little-endian PLY, atomically: after an error, an earlier file at
/// `path` is unchanged. The file has the frame's origin and the world's unit.
pub fn write(path: &Path, splats: &Splats, frame: &LocalFrame) -> Result<(), SceneError> {
    atomic::write_sized(path, file_bytes(splats.len(), splats.sh_degree, frame), |out| {
        out.write_all(header_of(splats.len(), splats.sh_degree, frame, &[]).as_bytes())?;
        (0..splats.len()).try_for_each(|i| write_row(out, splats, i, frame))
    })
}

/// Length of the file that [`write()`] makes of so many splats in a frame, bytes.
pub fn file_bytes(count: usize, sh_degree: u32, frame: &LocalFrame) -> u64 {
    file_bytes_with(count, sh_degree, frame, &[])
}

fn file_bytes_with(count: usize, sh_degree: u32, frame: &LocalFrame, extra: &[&str]) -> u64 {
    // Position, normal, spherical harmonics, opacity, scales and rotation.
    let numbers = 3 + 3 + 3 * sh_coefficients(sh_degree) + 1 + 3 + 4 + extra.len();
    header_of(count, sh_degree, frame, extra).len() as u64 + count as u64 * 4 * numbers as u64
}

/// As [`write()`], for splats that come in parts, so that they need not all be in memory. `count` is the number of all
/// splats, and `sh_degree` the degree of each part.
pub fn write_parts(
    path: &Path,
    count: usize,
    sh_degree: u32,
    frame: &LocalFrame,
    mut parts: impl Iterator<Item = io::Result<Splats>>,
) -> Result<(), SceneError> {
    write_with(path, count, sh_degree, frame, |write| parts.try_for_each(|splats| write(&splats?)))
}

/// As [`write_parts`], for a caller that has each part for a moment only: `fill` gets a function that writes one.
pub fn write_with(
    path: &Path,
    count: usize,
    sh_degree: u32,
    frame: &LocalFrame,
    fill: impl FnOnce(&mut dyn FnMut(&Splats) -> io::Result<()>) -> io::Result<()>,
) -> Result<(), SceneError> {
    write_with_extra(path, count, sh_degree, frame, &[], |write| fill(&mut |splats| write(splats, &[])))
}

/// As [`write_with`], with further properties, named `extra`, behind those of 3DGS: viewers ignore them. With the splats of
/// a part, `fill` hands over their values, splat by splat.
pub fn write_with_extra(
    path: &Path,
    count: usize,
    sh_degree: u32,
    frame: &LocalFrame,
    extra: &[&str],
    fill: impl FnOnce(&mut dyn FnMut(&Splats, &[f32]) -> io::Result<()>) -> io::Result<()>,
) -> Result<(), SceneError> {
    atomic::write_sized(path, file_bytes_with(count, sh_degree, frame, extra), |out| {
        out.write_all(header_of(count, sh_degree, frame, extra).as_bytes())?;
        let mut written = 0;
        fill(&mut |splats, values| {
            if splats.sh_degree != sh_degree {
                return Err(io::Error::other("its parts have different degrees of spherical harmonics"));
            }
            if values.len() != splats.len() * extra.len() {
                return Err(io::Error::other("its parts have other numbers of values than of splats"));
            }
            written += splats.len();
            (0..splats.len()).try_for_each(|i| {
                write_row(out, splats, i, frame)?;
                let values = &values[i * extra.len()..(i + 1) * extra.len()];
                values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
            })
        })?;
        if written == count {
            Ok(())
        } else {
            Err(io::Error::other("its parts have other numbers of splats"))
        }
    })
}

fn header_of(count: usize, sh_degree: u32, frame: &LocalFrame, extra: &[&str]) -> String {
    let mut text = format!("ply\nformat binary_little_endian 1.0\n{}", origin_line(frame.origin()));
    text += &format!("element vertex {count}\n");
    let rest = 3 * (sh_coefficients(sh_degree) - 1);
    let names = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).into_iter();
    let harmonics = numbered("f_dc", 3).chain(numbered("f_rest", rest));
    let extra = extra.iter().map(|name| (*name).into());
    for name in names.chain(harmonics).chain(tail_names()).chain(extra) {
        text += &format!("property float {name}\n");
    }
    text + "end_header\n"
}

/// Names of the properties that follow the spherical harmonics.
fn tail_names() -> impl Iterator<Item = String> {
    std::iter::once("opacity".into()).chain(numbered("scale", 3)).chain(numbered("rot", 4))
}

fn numbered(name: &str, count: usize) -> impl Iterator<Item = String> {
    (0..count).map(move |i| format!("{name}_{i}"))
}

fn write_row(out: &mut impl Write, splats: &Splats, i: usize, frame: &LocalFrame) -> io::Result<()> {
    let files = frame.of_files();
    let mut put = |values: &[f32]| values.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()));
    let sh = splats.sh_of(i);
    put(&frame.moved(splats.means[i], &files))?;
    put(&[0.0; 3])?;
    put(&sh[..3])?;
    for channel in 0..3 {
        for coefficient in sh[3..].chunks_exact(3) {
            put(&coefficient[channel..=channel])?;
        }
    }
    put(&[splats.opacity_logits[i]])?;
    put(&frame.moved_log_scale(splats.log_scales[i], &files))?;
    put(&splats.quats[i])
}

/// Reads splats into a frame. Errors: a missing property, or a value that cannot be rendered
/// ([`Splats::find_bad_value`]). The error names the property, and for a value also the vertex. The
/// number of vertices is checked against the file's length before anything is allocated.
pub fn read(path: &Path, frame: &LocalFrame) -> Result<Splats, SceneError> {
    read_vertices(path, |element, rows| {
        let columns = Columns::find(element)?;
        let mut splats = Splats::with_capacity(element.count as usize, columns.sh_degree);
        while let Some(row) = rows.next()? {
            columns.read(element, row, &mut splats, 0)?;
        }
        LocalFrame::at(rows.origin()).move_splats(&mut splats, frame);
        Ok(splats)
    })
}

/// The world position that the positions of a file are relative to. Reads only the header.
pub fn origin(path: &Path) -> Result<DVec3, SceneError> {
    read_vertices(path, |_, rows| Ok(rows.origin()))
}

/// Reads splats into `parts`, which leaves out those that cannot be rendered. Other errors are those of [`read`].
pub(crate) fn read_into(path: &Path, parts: &mut Parts) -> Result<(), SceneError> {
    read_vertices(path, |element, rows| {
        let columns = Columns::find(element)?;
        parts.begin(columns.sh_degree, element.count as usize, rows.origin());
        while let Some(row) = rows.next()? {
            parts.add(&columns.record(row));
        }
        Ok(())
    })
}

/// Number of splats of a file and the degree of their spherical harmonics, from its header. Errors are those of [`read`],
/// except for values that cannot be rendered.
pub fn size(path: &Path) -> Result<(usize, u32), SceneError> {
    read_vertices(path, |element, _| Ok((element.count as usize, Columns::find(element)?.sh_degree)))
}

/// Files with the splats in the folder of a training or of a merge.
const OF_FOLDERS: [&str; 2] = ["model.ply", "global.ply"];

/// The file with the splats of a model: the path itself, or the one in the folder of a training, a merge, a service or a
/// mission. Errors: a folder without one.
pub fn of_model(path: &Path) -> Result<PathBuf, SceneError> {
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    let inside = OF_FOLDERS.map(|name| path.join(name)).into_iter().find(|path| path.is_file());
    let reason = "has neither model.ply nor global.ply: name the model's PLY file";
    inside.ok_or_else(|| SceneError::malformed(path, reason))
}

/// For each number of a splat, the index of its column in a row of the file.
struct Columns {
    sh_degree: u32,
    mean: [usize; 3],
    quat: [usize; 4],
    log_scale: [usize; 3],
    opacity: usize,
    /// Columns of the spherical harmonics, `[(sh_degree + 1)², rgb]`.
    sh: Vec<usize>,
}

impl Columns {
    fn find(element: &Element) -> Result<Self, Refusal> {
        let column = |name: &str| {
            element.column(name).ok_or_else(|| {
                Refusal::from(format!(
                    "has no property {name} for its vertices, so they are not Gaussian splats"
                ))
            })
        };
        let sh_degree = find_sh_degree(element)?;
        let rest = sh_coefficients(sh_degree) - 1;
        let mut sh = vec![column("f_dc_0")?, column("f_dc_1")?, column("f_dc_2")?];
        for coefficient in 0..rest {
            for channel in 0..3 {
                sh.push(column(&format!("f_rest_{}", channel * rest + coefficient))?);
            }
        }
        Ok(Self {
            sh_degree,
            mean: [column("x")?, column("y")?, column("z")?],
            quat: [column("rot_0")?, column("rot_1")?, column("rot_2")?, column("rot_3")?],
            log_scale: [column("scale_0")?, column("scale_1")?, column("scale_2")?],
            opacity: column("opacity")?,
            sh,
        })
    }

    /// The splat of a row.
    fn record(&self, row: &[f64]) -> Record {
        let read = |column: &usize| row[*column] as f32;
        let mut record = Record {
            mean: self.mean.each_ref().map(read),
            quat: self.quat.each_ref().map(read),
            log_scale: self.log_scale.each_ref().map(read),
            opacity_logit: read(&self.opacity),
            ..Record::ZERO
        };
        record.sh.iter_mut().zip(&self.sh).for_each(|(value, column)| *value = read(column));
        record
    }

    /// Appends the splat of a row. `before` is the number of splats that were read before those in `splats`.
    fn read(
        &self,
        element: &Element,
        row: &[f64],
        splats: &mut Splats,
        before: usize,
    ) -> Result<(), Refusal> {
        self.record(row).push_to(splats);
        check_last(element, self, row, splats, before)
    }
}

fn find_sh_degree(element: &Element) -> Result<u32, Refusal> {
    let rest = element.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    (0..=3).find(|&degree| 3 * (sh_coefficients(degree) - 1) == rest).ok_or_else(|| {
        format!("has {rest} properties f_rest_*; spherical harmonics of degree 0 to 3 have 0, 9, 24 or 45")
            .into()
    })
}

/// Checks the last splat, which was read from `row`. If it cannot be rendered, the error names the
/// property, and the vertex: `before` vertices precede those in `splats`.
fn check_last(
    element: &Element,
    columns: &Columns,
    row: &[f64],
    splats: &Splats,
    before: usize,
) -> Result<(), Refusal> {
    let last = splats.len() - 1;
    let Some(bad) = splats.find_bad_value_of(last) else { return Ok(()) };
    let columns = match bad.field {
        "mean" => &columns.mean[..],
        "quat" => &columns.quat[..],
        "log_scale" => &columns.log_scale[..],
        "opacity_logit" => std::slice::from_ref(&columns.opacity),
        _ => &columns.sh[..],
    };
    let is_bad = |&&column: &&usize| !(row[column] as f32).is_finite();
    let describe = |column: usize| format!("{} is {:?}", element.properties[column].name, row[column]);
    let fault = match (columns.iter().find(is_bad), bad.field) {
        (Some(&column), _) => describe(column),
        (None, "quat") => "rot_0 to rot_3 are a quaternion too short or too long to normalise".into(),
        (None, _) => columns.iter().map(|&column| describe(column)).collect::<Vec<_>>().join(", "),
    };
    Err(format!("vertex {}: {fault}, which cannot be rendered; remove or repair the vertex", before + last)
        .into())
}
