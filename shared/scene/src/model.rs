//! Models in any file format that is known: the PLY of 3DGS, the compressed PLY of SuperSplat, and SPZ. The first bytes of a
//! file tell its format.
//!
//! Files of other tools may have single splats that are infinite or not a number. They are left out; [`unusable_note`]
//! counts them. An opacity that is infinite counts as opaque or transparent.
//!
//! What it knows nothing about: what the splats are for.

use std::io::Read;
use std::path::Path;

use glam::DVec3;

use crate::parts::Parts;
use crate::ply::compressed;
use crate::{LocalFrame, SceneError, Splats, files, ply, spz};

/// Splats that are in memory at a time while unusable ones are counted.
const READ_AT_ONCE: usize = 4096;

enum Format {
    Ply,
    CompressedPly,
    Spz,
}

impl Format {
    fn of(path: &Path) -> Result<Self, SceneError> {
        let mut begin = Vec::new();
        files::open(path)?.take(4).read_to_end(&mut begin).map_err(|cause| SceneError::io(path, cause))?;
        match begin[..] {
            [b'p', b'l', b'y', ..] if compressed::is_compressed(path)? => Ok(Self::CompressedPly),
            [b'p', b'l', b'y', ..] => Ok(Self::Ply),
            [0x1f, 0x8b, ..] | [b'N', b'G', b'S', b'P'] => Ok(Self::Spz),
            _ => {
                Err(SceneError::malformed(path, "is no model: it is neither PLY nor SPZ; convert it to PLY"))
            }
        }
    }
}

/// Number of splats of a model and the degree of their spherical harmonics, from its header. Unusable splats count.
pub fn size(path: &Path) -> Result<(usize, u32), SceneError> {
    match Format::of(path)? {
        Format::Ply => ply::size(path),
        Format::CompressedPly => compressed::size(path),
        Format::Spz => spz::size(path),
    }
}

/// The world position that the positions of a model are relative to; zero where the format cannot tell it.
pub fn origin(path: &Path) -> Result<DVec3, SceneError> {
    match Format::of(path)? {
        Format::Ply | Format::CompressedPly => ply::origin(path),
        Format::Spz => Ok(DVec3::ZERO),
    }
}

/// Reads a model into a frame, without its unusable splats. Its length is checked before anything is allocated.
pub fn read(path: &Path, frame: &LocalFrame) -> Result<Splats, SceneError> {
    let (count, sh_degree) = size(path)?;
    let mut all = Splats::with_capacity(count, sh_degree);
    read_parts(path, frame, READ_AT_ONCE, |part| all.extend(part))?;
    Ok(all)
}

/// As [`read`], in parts, so that they need not fit into the memory: calls `visit` with at most `most` splats at a time, in
/// the order of the file.
pub fn read_parts(
    path: &Path,
    frame: &LocalFrame,
    most: usize,
    mut visit: impl FnMut(&Splats),
) -> Result<(), SceneError> {
    visit_parts(path, frame, most, &mut visit).map(drop)
}

/// A line for the user, if some splats of a model are left out because they are infinite or not a number, or have a scale or
/// rotation that cannot be rendered. Reads the whole file. `None` too if it cannot be read: reading the model tells why.
pub fn unusable_note(path: &Path) -> Option<String> {
    let unusable = visit_parts(path, &LocalFrame::WORLD, READ_AT_ONCE, &mut |_| ()).ok()?;
    let splats = if unusable == 1 { "1 splat is" } else { &format!("{unusable} splats are") };
    (unusable > 0).then(|| format!("{}: {splats} infinite or not a number, and left out", path.display()))
}

fn visit_parts(
    path: &Path,
    frame: &LocalFrame,
    most: usize,
    visit: &mut dyn FnMut(&Splats),
) -> Result<usize, SceneError> {
    let mut parts = Parts::new(frame, most, visit);
    match Format::of(path)? {
        Format::Ply => ply::read_into(path, &mut parts)?,
        Format::CompressedPly => compressed::read_into(path, &mut parts)?,
        Format::Spz => spz::read_into(path, &mut parts)?,
    }
    Ok(parts.end())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::*;

    fn splats() -> Splats {
        let mut splats = Splats::with_capacity(3, 0);
        for x in [1.0, f32::NAN, 3.0] {
            splats.push([x, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [-4.0; 3], 0.0, &[0.0; 3]);
        }
        splats
    }

    #[test]
    fn formats_are_told_by_content_and_unusable_splats_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        ply::write(&path, &splats(), &LocalFrame::at(DVec3::X * 1000.0)).unwrap();
        assert_eq!(size(&path).unwrap(), (3, 0));
        assert!(unusable_note(&path).unwrap().contains(": 1 splat is infinite"));
        assert_eq!(origin(&path).unwrap(), DVec3::X * 1000.0);
        let read_x = |frame: &LocalFrame| {
            read(&path, frame).unwrap().means.iter().map(|mean| mean[0]).collect::<Vec<_>>()
        };
        assert_eq!(read_x(&LocalFrame::WORLD), [1001.0, 1003.0]);
        let (mut parts, frame) = (Vec::new(), LocalFrame::at(DVec3::X * 1000.0));
        read_parts(&path, &frame, 1, |part| parts.push((part.len(), part.means[0][0]))).unwrap();
        assert_eq!(parts, [(1, 1.0), (1, 3.0)]);
        for version in [spz::Version::V2, spz::Version::V4] {
            spz::write(&path, &splats().without(&[1]), version).unwrap();
            assert_eq!((size(&path).unwrap(), unusable_note(&path)), ((2, 0), None));
            assert_eq!(origin(&path).unwrap(), DVec3::ZERO);
            assert_eq!(read_x(&LocalFrame::at(DVec3::X)), [0.0, 2.0]);
        }
        for other in [&b""[..], b"glTF"] {
            fs::write(&path, other).unwrap();
            let error = read(&path, &LocalFrame::WORLD).unwrap_err().to_string();
            assert!(error.contains("neither PLY nor SPZ"), "{error}");
        }
    }
}
