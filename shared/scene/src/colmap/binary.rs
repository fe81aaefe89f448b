//! The binary form, little-endian. Every count is checked against the bytes left in the file before
//! anything is allocated.

use std::io::{self, BufRead, ErrorKind, Read, Seek};
use std::path::Path;

use super::model::{Assembly, Image, Intrinsics, Point, Undistortion, pose, refuse_distortion, with_file};
use crate::error::Refusal;
use crate::{Dataset, SceneError};

/// COLMAP's camera models by their number (colmap/src/colmap/sensor/models.h).
const MODELS: [&str; 12] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
];

/// The fewest bytes of a camera: id, model, size, three parameters.
const CAMERA_BYTES: u64 = 4 + 4 + 16 + 24;
/// The fewest bytes of an image: id, pose, camera, an empty name, a count.
const IMAGE_BYTES: u64 = 4 + 56 + 4 + 1 + 8;
/// A 2D point: position and the 3D point's id.
const POINT_2D_BYTES: u64 = 16 + 8;
/// The fewest bytes of a 3D point: id, position, colour, error, a count.
const POINT_3D_BYTES: u64 = 8 + 24 + 3 + 8 + 8;
/// An element of a track: image and 2D point.
const TRACK_BYTES: u64 = 4 + 4;

/// Longest accepted name, above the limit of any file system.
const NAME_BYTES_MAX: u64 = 4096;

pub(super) fn read<R: BufRead + Seek>(
    model: &Path,
    undistortion: &Undistortion,
    open: impl Fn(&Path) -> io::Result<(R, u64)>,
) -> Result<Dataset, SceneError> {
    let open = |path: &Path| open(path).map(|(file, left_bytes)| Input { file, left_bytes });
    let mut out = Assembly::default();
    with_file(model, "cameras.bin", |path| read_cameras(open(path)?, undistortion, &mut out))?;
    with_file(model, "images.bin", |path| read_images(open(path)?, &mut out))?;
    with_file(model, "points3D.bin", |path| read_points(open(path)?, &mut out))?;
    Ok(out.end())
}

fn read_cameras<R: BufRead + Seek>(
    mut input: Input<R>,
    undistortion: &Undistortion,
    out: &mut Assembly,
) -> Result<(), Refusal> {
    let count = input.count(CAMERA_BYTES)?;
    for i in 0..count {
        read_camera(&mut input, undistortion, out).map_err(|refusal| refusal.at(Nth("camera", i, count)))?;
    }
    Ok(())
}

fn read_camera<R: BufRead + Seek>(
    input: &mut Input<R>,
    undistortion: &Undistortion,
    out: &mut Assembly,
) -> Result<(), Refusal> {
    let id = input.u32()?;
    let number = input.u32()?;
    let size_px = [input.u64()?, input.u64()?];
    let Some(&model) = MODELS.get(number as usize) else {
        return Err(refuse_distortion(&format!("number {number}"), undistortion));
    };
    let params = match model {
        "SIMPLE_PINHOLE" => input.f64s::<3>()?.to_vec(),
        "PINHOLE" => input.f64s::<4>()?.to_vec(),
        _ => Vec::new(),
    };
    out.add_camera(id, Intrinsics::new(model, size_px, &params, undistortion)?)
}

fn read_images<R: BufRead + Seek>(mut input: Input<R>, out: &mut Assembly) -> Result<(), Refusal> {
    let count = input.count(IMAGE_BYTES)?;
    for i in 0..count {
        read_image(&mut input, out).map_err(|refusal| refusal.at(Nth("image", i, count)))?;
    }
    Ok(())
}

fn read_image<R: BufRead + Seek>(input: &mut Input<R>, out: &mut Assembly) -> Result<(), Refusal> {
    let id = input.u32()?;
    let cam_from_world = pose(input.f64s()?, input.f64s()?)?;
    let camera_id = input.u32()?;
    let name = input.name()?;
    let points = input.count(POINT_2D_BYTES)?;
    input.skip(points * POINT_2D_BYTES)?;
    out.add_image(Image { id, camera_id, cam_from_world, name })
}

fn read_points<R: BufRead + Seek>(mut input: Input<R>, out: &mut Assembly) -> Result<(), Refusal> {
    let count = input.count(POINT_3D_BYTES)?;
    for i in 0..count {
        read_point(&mut input, out).map_err(|refusal| refusal.at(Nth("point", i, count)))?;
    }
    Ok(())
}

fn read_point<R: BufRead + Seek>(input: &mut Input<R>, out: &mut Assembly) -> Result<(), Refusal> {
    input.skip(8)?; // its id
    let position = input.f64s()?;
    let rgb = input.array()?;
    input.skip(8)?; // its error
    let length = input.count(TRACK_BYTES)?;
    let mut image_ids = Vec::with_capacity(length as usize);
    for _ in 0..length {
        image_ids.push(input.u32()?);
        input.skip(4)?; // the 2D point
    }
    out.add_point(Point { position, rgb, image_ids })
}

/// A record's place in an error message: its kind, its index (displayed from 1) and the count.
struct Nth(&'static str, u64, u64);

impl std::fmt::Display for Nth {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {} of {}", self.0, self.1 + 1, self.2)
    }
}

/// A file and the number of its bytes left.
struct Input<R> {
    file: R,
    left_bytes: u64,
}

impl<R: BufRead + Seek> Input<R> {
    fn take(&mut self, bytes: u64) -> Result<(), Refusal> {
        let left = self.left_bytes.checked_sub(bytes);
        self.left_bytes = left.ok_or(Refusal::Io(ErrorKind::UnexpectedEof.into()))?;
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Refusal> {
        self.take(N as u64)?;
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    fn u32(&mut self) -> Result<u32, Refusal> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, Refusal> {
        self.array().map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], Refusal> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array()?);
        }
        Ok(values)
    }

    /// Reads a count of records of at least `bytes` each; refuses a count that the file cannot hold.
    fn count(&mut self, bytes: u64) -> Result<u64, Refusal> {
        let count = self.u64()?;
        if count > self.left_bytes / bytes {
            let left = self.left_bytes;
            let reason = format!(
                "claims {count} records, but only {left} bytes follow; it was cut short or is damaged"
            );
            return Err(reason.into());
        }
        Ok(count)
    }

    fn skip(&mut self, bytes: u64) -> Result<(), Refusal> {
        self.take(bytes)?;
        // The cast is exact: the file has at least this many bytes.
        Ok(self.file.seek_relative(bytes as i64)?)
    }

    /// A name that ends with a zero byte.
    fn name(&mut self) -> Result<String, Refusal> {
        let mut name = Vec::new();
        (&mut self.file).take(NAME_BYTES_MAX).read_until(0, &mut name)?;
        self.take(name.len() as u64)?;
        match name.pop() {
            Some(0) => {}
            _ if self.left_bytes == 0 => return Err(Refusal::Io(ErrorKind::UnexpectedEof.into())),
            _ => return Err("its name is too long".into()),
        }
        String::from_utf8(name).map_err(|_| "its name is not UTF-8".into())
    }
}
