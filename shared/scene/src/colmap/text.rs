//! The text form of a model: one record per line. Blank lines, and lines that begin with `#`, are
//! skipped. In `images.txt` each record is followed by a line of 2D points, which may be blank; it
//! is skipped too.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;
use std::str::{FromStr, SplitAsciiWhitespace};

use super::model::{Assembly, Image, Intrinsics, Point, Undistortion, pose, with_file};
use crate::error::Refusal;
use crate::sieve::Sieve;
use crate::{SceneError, View};

/// Longest accepted line, bytes: enough for the track of a point that a million pictures see.
const LINE_BYTES_MAX: u64 = 1 << 24;

pub(super) fn read<R: BufRead>(
    model: &Path,
    undistortion: &Undistortion,
    sieve: &mut Sieve,
    open: impl Fn(&Path) -> io::Result<(R, u64)>,
) -> Result<Vec<View>, SceneError> {
    let open = |path: &Path| open(path).map(|(file, _)| file);
    let mut out = Assembly::new(sieve);
    with_file(model, "cameras.txt", |path| {
        each_record(open(path)?, false, |record| read_camera(record, undistortion, &mut out))
    })?;
    with_file(model, "images.txt", |path| {
        each_record(open(path)?, true, |record| read_image(record, &mut out))
    })?;
    with_file(model, "points3D.txt", |path| match open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        file => each_record(file?, false, |record| read_point(record, &mut out)),
    })?;
    Ok(out.end())
}

/// Number of records of an `images.txt`; `None` if it cannot be read.
pub(super) fn count_images(path: &Path) -> Option<u64> {
    let mut count = 0;
    let file = BufReader::new(File::open(path).ok()?);
    each_record(file, true, |_| {
        count += 1;
        Ok(())
    })
    .ok()?;
    Some(count)
}

/// Calls `read` with the line of each record. With `skip_next`, skips the line after each record.
fn each_record(
    mut file: impl BufRead,
    skip_next: bool,
    mut read: impl FnMut(&str) -> Result<(), Refusal>,
) -> Result<(), Refusal> {
    let mut line = Vec::new();
    let mut number = 1_u64;
    while (&mut file).take(LINE_BYTES_MAX).read_until(b'\n', &mut line)? > 0 {
        let place = format_args!("line {number}");
        let skipped = read_line(&line, &mut read).map_err(|refusal| refusal.at(place))?;
        if !skipped && skip_next {
            file.skip_until(b'\n')?;
            number += 1;
        }
        number += 1;
        line.clear();
    }
    Ok(())
}

/// Calls `read` with the line, unless the line is blank or a comment. Returns whether the line was
/// skipped.
fn read_line(line: &[u8], read: &mut impl FnMut(&str) -> Result<(), Refusal>) -> Result<bool, Refusal> {
    if line.len() as u64 == LINE_BYTES_MAX {
        return Err("the line is too long".into());
    }
    let line = std::str::from_utf8(line).map_err(|_| "the line is not UTF-8")?.trim_ascii();
    let skipped = line.is_empty() || line.starts_with('#');
    if !skipped {
        read(line)?;
    }
    Ok(skipped)
}

fn read_camera(record: &str, undistortion: &Undistortion, out: &mut Assembly) -> Result<(), Refusal> {
    let mut words = Words(record.split_ascii_whitespace());
    let id = words.next("camera id")?;
    let model: String = words.next("camera model")?;
    let size_px = [words.next("width")?, words.next("height")?];
    let params = words.rest("parameter")?;
    out.add_camera(id, Intrinsics::new(&model, size_px, &params, undistortion)?)
}

fn read_image(record: &str, out: &mut Assembly) -> Result<(), Refusal> {
    // The name comes after nine numbers and may contain spaces, so it is the whole rest of the line.
    let mut rest = record;
    for _ in 0..9 {
        rest = rest.trim_ascii_start();
        rest = &rest[rest.find(|c: char| c.is_ascii_whitespace()).unwrap_or(rest.len())..];
    }
    let mut words = Words(record.split_ascii_whitespace());
    let id = words.next("image id")?;
    let cam_from_world = pose(words.array("rotation")?, words.array("translation")?)?;
    let camera_id = words.next("camera id")?;
    out.add_image(Image { id, camera_id, cam_from_world, name: rest.trim_ascii_start().into() })
}

fn read_point(record: &str, out: &mut Assembly) -> Result<(), Refusal> {
    let mut words = Words(record.split_ascii_whitespace());
    let _: u64 = words.next("point id")?;
    let position = words.array("position")?;
    let rgb = words.array("colour")?;
    let _: f64 = words.next("error")?;
    let track: Vec<u32> = words.rest("track")?;
    if !track.len().is_multiple_of(2) {
        return Err("the track is not a list of pairs".into());
    }
    out.add_point(Point { position, rgb, image_ids: track.into_iter().step_by(2).collect() })
}

/// The words of a record, each parsed when it is asked for.
struct Words<'a>(SplitAsciiWhitespace<'a>);

impl Words<'_> {
    fn next<T: FromStr>(&mut self, what: &str) -> Result<T, Refusal> {
        let word = self.0.next().ok_or_else(|| format!("the {what} is missing"))?;
        word.parse().map_err(|_| format!("the {what} cannot be '{}'", word.escape_default()).into())
    }

    fn array<T: FromStr + Copy + Default, const N: usize>(&mut self, what: &str) -> Result<[T; N], Refusal> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = self.next(what)?;
        }
        Ok(values)
    }

    fn rest<T: FromStr>(&mut self, what: &str) -> Result<Vec<T>, Refusal> {
        let mut values = Vec::new();
        while self.0.clone().next().is_some() {
            values.push(self.next(what)?);
        }
        Ok(values)
    }
}
