//! Splats as SPZ (github.com/nianticlabs/spz), for viewers and other tools; ten times smaller than PLY. A file has a
//! header, then all positions, opacities, colours, scales, rotations and spherical harmonics: up to version 3 in one gzip
//! stream, in version 4 as a table and a zstd stream for each.
//!
//! Versions 1 to 4 are read, 2 to 4 are written. Extensions of vendors, and harmonics above degree 3, are left out. SPZ's
//! axes are right, up, back; those of the 3DGS PLY are right, down, forward. So y and z change sign when a file is written or
//! read, as in other converters. Viewers then show the SPZ like the PLY.
//!
//! A file has one column after the other, so a model that does not fit into the memory is read once for each ([`write_with`]).
//!
//! The format is lossy: use it for viewing models, not for keeping them. Its steps are 0.24 mm for coordinates below
//! 2 km, 6 % for scales from 0.045 mm to 380 m, and 0.1° for rotations (1° in version 2). Spherical harmonics have 4 or 5
//! bits.
//!
//! ```
//! use cosurf_scene::{Splats, spz};
//!
//! let mut splats = Splats::with_capacity(1, 0);
//! let (mean, quat, log_scale) = ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0], [-4.0, -4.0, -6.0]);
//! splats.push(mean, quat, log_scale, 2.0, &[0.5, 0.0, -0.5]);
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("model.spz");
//! spz::write(&path, &splats, spz::Version::V3)?;
//! let read = spz::read(&path)?;
//! assert_eq!(read.means, splats.means);
//! assert!((read.sh[0] - splats.sh[0]).abs() < 0.02);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod columns;
mod header;
mod pack;
mod steps;
#[cfg(test)]
mod tests;
mod unpack;

use std::io::{Cursor, Read};
use std::path::Path;

use glam::DVec3;

use crate::error::Refusal;
use crate::parts::Parts;
use crate::{LocalFrame, SceneError, Splats, atomic};
use header::Header;
pub use header::Version;
pub use pack::Source;
use steps::{LOG_SCALE_MIN, LOG_SCALE_STEPS};

/// Splats whose bytes are read at a time.
const READ_AT_ONCE: usize = 1024;

/// Writes `splats` as SPZ, atomically: after an error, an earlier file at `path` is unchanged. Errors: a coordinate
/// beyond ±8,388,607, and version 1, which is not written.
pub fn write(path: &Path, splats: &Splats, version: Version) -> Result<(), SceneError> {
    write_with(path, splats.sh_degree, version, &*whole(splats))
}

/// As [`write()`], for splats that come in parts of this degree, so that they need not all be in memory. `source` is called
/// up to seven times, and hands over the same splats each time.
pub fn write_with(path: &Path, sh_degree: u32, version: Version, source: &Source) -> Result<(), SceneError> {
    if version == Version::V1 {
        return Err(SceneError::malformed(path, "SPZ of version 1 is not written; choose version 2, 3 or 4"));
    }
    let header = pack::header(sh_degree, version, source)?.ok_or_else(|| {
        SceneError::malformed(path, "SPZ cannot hold coordinates beyond 8,388,607; write a PLY instead")
    })?;
    atomic::write(path, |out| pack::encode(out, &header, source))
}

/// Splats as one part.
fn whole(splats: &Splats) -> Box<Source<'_>> {
    Box::new(|visit| {
        visit(splats);
        Ok(())
    })
}

/// The bytes of an SPZ file of version 3 with these splats; `None` if a coordinate is beyond ±8,388,607.
pub fn to_bytes(splats: &Splats) -> Option<Vec<u8>> {
    to_bytes_of(splats, Version::V3)
}

/// As [`to_bytes`], of version 2, 3 or 4.
pub(crate) fn to_bytes_of(splats: &Splats, version: Version) -> Option<Vec<u8>> {
    let source = whole(splats);
    let header = pack::header(splats.sh_degree, version, &*source).ok()??;
    let mut bytes = Cursor::new(Vec::new());
    pack::encode(&mut bytes, &header, &*source).ok()?;
    Some(bytes.into_inner())
}

/// Number of splats that a file holds in another size, because their second longest axis is below 0.045 mm, or their longest
/// above 380 m. The shortest may be less: such a splat is a disc.
pub fn resized(splats: &Splats) -> usize {
    let log_scale_max = LOG_SCALE_MIN + 255.0 / LOG_SCALE_STEPS;
    let is_resized = |log_scales: &&[f32; 3]| {
        let mut sorted = **log_scales;
        sorted.sort_unstable_by(f32::total_cmp);
        sorted[1] < LOG_SCALE_MIN || sorted[2] > log_scale_max
    };
    splats.log_scales.iter().filter(is_resized).count()
}

/// Bytes of a splat before compression, in a file of version 3 or 4.
pub fn body_bytes(sh_degree: u32) -> usize {
    let header = Header { version: Version::V3, splats: 1, degree_in_file: sh_degree, fraction_bits: 0 };
    header.columns().iter().sum()
}

/// Number of splats of a file and the degree of their spherical harmonics, from its header. Errors are those of [`read`],
/// except for a file that was cut short.
pub fn size(path: &Path) -> Result<(usize, u32), SceneError> {
    let header = columns::read_header(path).map_err(|refusal| refusal.of(path))?;
    Ok((header.splats, header.sh_degree()))
}

/// Reads splats. Whatever the bytes of the file are, the values can be rendered ([`Splats::find_bad_value`]): in version 1,
/// infinite positions are possible, and such splats are left out. The number of splats is checked against the file's length
/// before anything is allocated.
pub fn read(path: &Path) -> Result<Splats, SceneError> {
    let (count, sh_degree) = size(path)?;
    let mut all = Splats::with_capacity(count, sh_degree);
    let mut visit = |part: &Splats| all.extend(part);
    let mut parts = Parts::new(&LocalFrame::WORLD, READ_AT_ONCE, &mut visit);
    read_into(path, &mut parts)?;
    parts.end();
    Ok(all)
}

/// Reads splats into `parts`.
pub(crate) fn read_into(path: &Path, parts: &mut Parts) -> Result<(), SceneError> {
    let header = columns::read_header(path).map_err(|refusal| refusal.of(path))?;
    let cut_short = |refusal| match refusal {
        Refusal::Io(cause) if cause.kind() == std::io::ErrorKind::UnexpectedEof => {
            format!("holds fewer than its {} splats; it was cut short, fetch it again", header.splats).into()
        }
        Refusal::Io(cause) => format!("cannot be unpacked ({cause}); it is damaged, fetch it again").into(),
        content => content,
    };
    read_columns(path, &header, parts).map_err(|refusal| cut_short(refusal).of(path))
}

fn read_columns(path: &Path, header: &Header, parts: &mut Parts) -> Result<(), Refusal> {
    let mut columns = columns::open(path, header)?;
    let widths = header.columns();
    let mut buffers = widths.map(|width| vec![0; width * READ_AT_ONCE]);
    parts.begin(header.sh_degree(), header.splats, DVec3::ZERO);
    for first in (0..header.splats).step_by(READ_AT_ONCE) {
        let count = READ_AT_ONCE.min(header.splats - first);
        for ((column, buffer), width) in columns.iter_mut().zip(&mut buffers).zip(widths) {
            column.read_exact(&mut buffer[..count * width])?;
        }
        for i in 0..count {
            let bytes = std::array::from_fn(|k| &buffers[k][i * widths[k]..(i + 1) * widths[k]]);
            parts.add(&unpack::unpack(header, bytes));
        }
    }
    Ok(())
}
