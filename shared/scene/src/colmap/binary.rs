//! The binary form of a model, little-endian. Every count is checked against the number of bytes
//! left in the file before anything is allocated.

use std::io::{self, BufRead, ErrorKind, Read, Seek};
use std::path::Path;

use super::model::{Assembly, Image, Intrinsics, Point, Undistortion, pose, refuse_distortion, with_file};
use crate::error::Refusal;
use crate::sieve::Sieve;
use crate::{SceneError, View};

/// Names of COLMAP's camera models. The index is the model's number
/// (colmap/src/colmap/sensor/models.h).
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

/// The fewest bytes of a camera: id, model, width and height, three parameters.
const CAMERA_BYTES: u64 = 4 + 4 + 16 + 24;
/// The fewest bytes of an image: id, pose, camera id, an empty name, the count of its 2D points.
const IMAGE_BYTES: u64 = 4 + 56 + 4 + 1 + 8;
/// Bytes of a 2D point: its position, and the id of its 3D point.
const POINT_2D_BYTES: u64 = 16 + 8;
/// The fewest bytes of a 3D point: id, position, colour, error, the length of its track.
const POINT_3D_BYTES: u64 = 8 + 24 + 3 + 8 + 8;
/// Bytes of an element of a track: the image's id, and the index of the 2D point in the image.
const TRACK_BYTES: u64 = 4 + 4;

/// Longest accepted picture name, bytes, including the zero byte that ends it; Linux limits paths to
/// the same length.
const NAME_BYTES_MAX: u64 = 4096;

pub(super) fn read<R: BufRead + Seek>(
    model: &Path,
    undistortion: &Undistortion,
    sieve: &mut Sieve,
    open: impl Fn(&Path) -> io::Result<(R, u64)>,
) -> Result<Vec<View>, SceneError> {
    let open = |path: &Path| open(path).map(|(file, left_bytes)| Input { file, left_bytes });
    let mut out = Assembly::new(sieve);
    with_file(model, "cameras.bin", |path| read_cameras(open(path)?, undistortion, &mut out))?;
    with_file(model, "images.bin", |path| read_images(open(path)?, &mut out))?;
    with_file(model, "points3D.bin", |path| match open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        input => read_points(input?, &mut out),
    })?;
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
        "PINHOLE" | "SIMPLE_RADIAL" => input.f64s::<4>()?.to_vec(),
        "RADIAL" => input.f64s::<5>()?.to_vec(),
        "OPENCV" => input.f64s::<8>()?.to_vec(),
        "FULL_OPENCV" => input.f64s::<12>()?.to_vec(),
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
    input.skip(8)?; // the point's id
    let position = input.f64s()?;
    let rgb = input.array()?;
    input.skip(8)?; // the point's reprojection error
    let length = input.count(TRACK_BYTES)?;
    let mut image_ids = Vec::with_capacity(length as usize);
    for _ in 0..length {
        image_ids.push(input.u32()?);
        input.skip(4)?; // the index of the 2D point
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

/// A file, and the number of bytes in it that are not read yet.
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

    /// Reads the number of records that follow, each of at least `bytes` bytes. Refuses a number of
    /// records that the rest of the file cannot hold.
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
        // The cast is exact: the file has at least this many bytes, and no file is longer than an
        // `i64` can count.
        Ok(self.file.seek_relative(bytes as i64)?)
    }

    /// Reads a name and the zero byte that ends it.
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
/// Number of records that an `images.bin` tells; `None` if it cannot be read.
pub(super) fn count_images(path: &Path) -> Option<u64> {
    let mut bytes = [0; 8];
    std::fs::File::open(path).ok()?.read_exact(&mut bytes).ok()?;
    Some(u64::from_le_bytes(bytes))
}
