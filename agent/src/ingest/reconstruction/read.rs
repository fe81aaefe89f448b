//! Reads the text form: `cameras.txt`, `images.txt` and `points3D.txt`.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

use cosurf_scene::{Pose, SceneError};
use glam::{DQuat, DVec2, DVec3};

use super::{Posed, Reconstruction, TieMark, TiePoint};
use crate::ingest::error::IngestError;
use crate::ingest::lens::Lens;

/// A photograph, and the points that it shows: their numbers in the files, and where.
struct Photograph {
    posed: Posed,
    seen: Vec<(u64, DVec2)>,
}

impl Reconstruction {
    /// Reads a folder.
    pub(crate) fn read(folder: &Path) -> Result<Self, IngestError> {
        let (mut lenses, mut index_of_lens) = (Vec::new(), HashMap::new());
        each_line(&folder.join("cameras.txt"), |line| {
            if !line.is_empty() && !line.starts_with('#') {
                let (id, lens) = Lens::parse(line)?;
                index_of_lens.insert(id, lenses.len());
                lenses.push(lens);
            }
            Some(())
        })?;
        let mut photographs = read_photographs(&folder.join("images.txt"), &index_of_lens)?;
        photographs.sort_by(|a, b| a.posed.name.cmp(&b.posed.name));
        let (mut points, mut index_of_point) = (Vec::new(), HashMap::new());
        each_line(&folder.join("points3D.txt"), |line| {
            if !line.is_empty() && !line.starts_with('#') {
                let (id, point) = parse_point(line)?;
                index_of_point.insert(id, points.len() as u32);
                points.push(point);
            }
            Some(())
        })?;
        let mut marks = Vec::new();
        for (photograph, its) in (0..).zip(&photographs) {
            marks.extend(its.seen.iter().filter_map(|(id, at_px)| {
                Some(TieMark { point: *index_of_point.get(id)?, photograph, at_px: *at_px })
            }));
        }
        marks.sort_by_key(|mark| (mark.point, mark.photograph));
        let posed = photographs.into_iter().map(|photograph| photograph.posed).collect();
        Ok(Self { posed, lenses, points, marks })
    }
}

/// Each photograph has two lines. The second, its points, may be empty.
fn read_photographs(
    path: &Path,
    index_of_lens: &HashMap<u32, usize>,
) -> Result<Vec<Photograph>, IngestError> {
    let mut photographs = Vec::new();
    let mut pending = None;
    each_line(path, |line| {
        if let Some(posed) = pending.take() {
            photographs.push(Photograph { posed, seen: parse_seen(line)? });
        } else if !line.is_empty() && !line.starts_with('#') {
            pending = Some(parse_posed(line, index_of_lens)?);
        }
        Some(())
    })?;
    photographs.extend(pending.map(|posed| Photograph { posed, seen: Vec::new() }));
    Ok(photographs)
}

/// Reads a file line by line; `None` from `read` means that it is damaged.
fn each_line(path: &Path, mut read: impl FnMut(&str) -> Option<()>) -> Result<(), IngestError> {
    let failed = |cause| SceneError::io(path, cause);
    let file = BufReader::new(File::open(path).map_err(failed)?);
    for (number, line) in (1..).zip(file.lines()) {
        let line: String = line.map_err(failed)?;
        if read(line.trim()).is_none() {
            let reason = format!("line {number} is not as COLMAP writes it; remove the folder and run again");
            return Err(SceneError::malformed(path, reason).into());
        }
    }
    Ok(())
}

/// The next word, a finite number.
fn number<'a>(words: &mut impl Iterator<Item = &'a str>) -> Option<f64> {
    words.next()?.parse().ok().filter(|number: &f64| number.is_finite())
}

/// `id qw qx qy qz tx ty tz camera name`. The name may have spaces.
fn parse_posed(line: &str, index_of_lens: &HashMap<u32, usize>) -> Option<Posed> {
    let mut words = line.splitn(10, ' ');
    let _id = words.next()?;
    let mut next = || number(&mut words);
    let [w, x, y, z] = [next()?, next()?, next()?, next()?];
    let translation = DVec3::new(next()?, next()?, next()?);
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let lens = *index_of_lens.get(&words.next()?.parse().ok()?)?;
    let name = words.next()?.to_owned();
    let cam_from_world = Pose { rotation: rotation.normalize(), translation };
    (rotation.length() > 1e-6).then_some(Posed { name, cam_from_world, lens })
}

/// `x y point` for each feature; the point is -1 for most.
fn parse_seen(line: &str) -> Option<Vec<(u64, DVec2)>> {
    let mut words = line.split_ascii_whitespace();
    let mut seen = Vec::new();
    while let Some(x) = words.next() {
        let [y, point] = [words.next()?, words.next()?];
        if point != "-1" {
            let mut at = [x, y].into_iter();
            seen.push((point.parse().ok()?, DVec2::new(number(&mut at)?, number(&mut at)?)));
        }
    }
    Some(seen)
}

/// `id x y z red green blue error track`.
fn parse_point(line: &str) -> Option<(u64, TiePoint)> {
    let mut words = line.split_ascii_whitespace();
    let id = words.next()?.parse().ok()?;
    let position = DVec3::new(number(&mut words)?, number(&mut words)?, number(&mut words)?);
    let mut rgb = [0; 3];
    for channel in &mut rgb {
        *channel = words.next()?.parse().ok()?;
    }
    Some((id, TiePoint { position, rgb }))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn photographs_without_points_and_names_with_spaces_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("cameras.txt", "# Camera list\n3 OPENCV 640 480 500 500 320 240 0 0 0 0\n");
        write(
            "images.txt",
            "# Image list\n7 1 0 0 0 0 0 2 3 b ü.JPG\n\n1 0 1 0 0 0 0 2 3 100MEDIA/a.jpg\n1.5 2.5 -1 3 4.5 9\n",
        );
        write("points3D.txt", "# Points\n9 1 2 -3 10 20 30 0.5 1 1\n");
        let found = Reconstruction::read(folder.path()).unwrap();
        let names: Vec<&str> = found.posed.iter().map(|posed| &*posed.name).collect();
        assert_eq!(names, ["100MEDIA/a.jpg", "b ü.JPG"]);
        let (eye, ray, focal_px) = found.sight(&found.posed[1], DVec2::new(320.0, 240.0)).unwrap();
        assert_eq!((eye, ray, focal_px), (DVec3::new(0.0, 0.0, -2.0), DVec3::Z, 500.0));
        let mark = TieMark { point: 0, photograph: 0, at_px: DVec2::new(3.0, 4.5) };
        assert_eq!(found.marks, [mark]);
        assert_eq!(found.points[0].position, DVec3::new(1.0, 2.0, -3.0));
        for (name, text) in [
            ("images.txt", "7 1 0 0 0 0 0 x 3 b.JPG\n"),
            ("images.txt", "7 1 0 0 0 0 0 1 4 b.JPG\n\n"),
            ("points3D.txt", "9 1 2 inf 10 20 30 0.5\n"),
        ] {
            let whole = std::fs::read_to_string(folder.path().join(name)).unwrap();
            write(name, text);
            let error = Reconstruction::read(folder.path()).err().unwrap().to_string();
            assert!(error.contains(&format!("{name}: line 1")), "{error}");
            write(name, &whole);
        }
    }
}
