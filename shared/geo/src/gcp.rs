//! `gcp_list.txt` of ODM: points on the ground that were measured, and where photographs show them.
//!
//! The first line names the coordinate system; each further one is a mark:
//! `east north height pixel_x pixel_y photograph [name]`. Names that begin with [`CHECK`] are of check points, as in WebODM.

use std::path::Path;

use glam::DVec2;

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;
use crate::table::{Table, number};

/// Marks of one unnamed point repeat its east and north within this, in the units of the list.
const SAME: f64 = 1e-6;

/// Names of points that only check begin so, in letters of any case: `CHK-1`, `chk_gate`, `CHK7`.
const CHECK: &str = "chk";

/// A point on the ground that was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct ControlPoint {
    /// Its name; `1`, `2` and so on if the list gives none.
    pub name: String,
    /// Where it was measured. If the marks repeat it with several heights, the height is their mean.
    pub place: Geodetic,
    /// Where photographs show it.
    pub marks: Vec<Mark>,
}

impl ControlPoint {
    /// Whether its name says that it is a check point: it judges a fit, and has no part in it.
    pub fn is_check(&self) -> bool {
        let Some((begin, rest)) = self.name.split_at_checked(CHECK.len()) else { return false };
        begin.eq_ignore_ascii_case(CHECK) && !rest.starts_with(char::is_alphabetic)
    }
}

/// Where a photograph shows a point.
#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    /// Name of the photograph's file.
    pub photograph: String,
    /// Position in the stored picture, pixels from its top-left corner.
    pub at_px: DVec2,
}

/// A line of the list.
struct Line {
    /// Its number, from 1.
    number: usize,
    at: [f64; 3],
    mark: Mark,
    name: Option<String>,
}

/// Reads a `gcp_list.txt`. Marks with one name, or without a name but with the same east and north, are of one point. A name
/// with two places is refused: nobody can tell which one is meant.
pub fn read_gcp_list(path: &Path) -> Result<Vec<ControlPoint>, GeoError> {
    let table = Table::read(path)?;
    let mut points: Vec<(Option<String>, Vec<Line>)> = Vec::new();
    for (at, text) in &table.lines {
        let refused = |reason: String| GeoError::Refused { path: path.into(), reason };
        let line = parse(*at, text).map_err(|reason| refused(format!("line {at}: {reason}")))?;
        match points.iter_mut().find(|(name, lines)| *name == line.name && is_same(&lines[0], &line)) {
            Some((Some(name), lines)) if !has_same_place(&lines[0], &line) => {
                return Err(refused(format!(
                    "line {at}: point {name} has another place than in line {}; give each point one place, and a name of \
                     its own",
                    lines[0].number
                )));
            }
            Some((_, lines)) => lines.push(line),
            None => points.push((line.name.clone(), vec![line])),
        }
    }
    let points = points.into_iter().enumerate();
    points
        .map(|(i, (name, lines))| {
            let [x, y, _] = lines[0].at;
            let height_m = lines.iter().map(|line| line.at[2]).sum::<f64>() / lines.len() as f64;
            let place = table.crs.place(x, y, height_m);
            let place =
                place.map_err(|error| GeoError::Refused { path: path.into(), reason: error.to_string() })?;
            let name = name.unwrap_or_else(|| (i + 1).to_string());
            Ok(ControlPoint { name, place, marks: lines.into_iter().map(|line| line.mark).collect() })
        })
        .collect()
}

/// Whether two lines with equal names, or without names, are of one point.
fn is_same(a: &Line, b: &Line) -> bool {
    a.name.is_some() || has_same_place(a, b)
}

fn has_same_place(a: &Line, b: &Line) -> bool {
    (a.at[0] - b.at[0]).abs() <= SAME && (a.at[1] - b.at[1]).abs() <= SAME
}

/// Reads a line. An error is what is wrong with it.
fn parse(number_of_line: usize, text: &str) -> Result<Line, &'static str> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let numbers: Vec<f64> = words.iter().take(5).map_while(|word| number(word)).collect();
    let ([east, north, height, x, y], Some([photograph, rest @ ..])) = (&numbers[..], words.get(5..)) else {
        return Err("write `east north height pixel_x pixel_y photograph name`");
    };
    if *x < 0.0 || *y < 0.0 {
        return Err("a pixel is negative; pixels count from the picture's top-left corner, x first");
    }
    let mark = Mark { photograph: (*photograph).to_owned(), at_px: DVec2::new(*x, *y) };
    let name = rest.first().map(|name| (*name).to_owned());
    Ok(Line { number: number_of_line, at: [*east, *north, *height], mark, name })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn read(text: &str) -> Result<Vec<ControlPoint>, GeoError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gcp_list.txt");
        std::fs::write(&path, text).unwrap();
        read_gcp_list(&path)
    }

    #[test]
    fn marks_are_gathered_into_points() {
        let text = "EPSG:2180\n332289.0623 573431.0595 70 1 2 a.jpg\n332289.0623 573431.0595 71 3 4 b.jpg\n\
                    332300 573431 70 5 6 a.jpg\n332300 573431 70 7 8 a.jpg gate\n";
        let points = read(text).unwrap();
        let names: Vec<_> = points.iter().map(|point| (&*point.name, point.marks.len())).collect();
        assert_eq!(names, [("1", 2), ("2", 1), ("gate", 1)]);
        let place = points[0].place;
        assert!(
            (place.latitude_deg - 53.0).abs() < 1e-7 && (place.longitude_deg - 16.5).abs() < 1e-7,
            "{place:?}"
        );
        assert_eq!(place.height_m, 70.5);
        assert_eq!(points[0].marks[1], Mark { photograph: "b.jpg".into(), at_px: DVec2::new(3.0, 4.0) });
    }

    #[test]
    fn a_name_has_one_place() {
        let list = |second: &str| format!("EPSG:2180\n332300 573431 70 5 6 a.jpg P\n{second} 5 6 b.jpg P\n");
        assert_eq!(read(&list("332300 573431 71")).unwrap()[0].marks.len(), 2, "heights may differ");
        for other in ["332330 573431 70", "332300 573434 70"] {
            let error = read(&list(other)).unwrap_err().to_string();
            assert!(error.contains("line 3: point P has another place than in line 2"), "{error}");
        }
    }

    #[test]
    fn check_points_are_told_by_their_names() {
        let is_check = |name: &str| {
            read(&format!("EPSG:2180\n332300 573431 70 5 6 a.jpg {name}\n")).unwrap()[0].is_check()
        };
        assert!(["CHK-1", "chk_gate", "Chk7", "CHK"].into_iter().all(is_check));
        assert!(
            ["1", "CH", "checker", "chkdam", "GCP-CHK", "Überweg", ""]
                .into_iter()
                .all(|name| !is_check(name))
        );
    }

    #[test]
    fn wrong_lines_are_named() {
        for text in
            ["EPSG:2180\n1 2 3 4 5\n", "EPSG:2180\n1 2 x 4 5 a.jpg\n", "EPSG:2180\n1 2 3 inf 5 a.jpg\n"]
        {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains("gcp_list.txt: line 2: write"), "{error}");
        }
        let error = read("EPSG:2180\n332300 573431 3 -5 5 a.jpg\n").unwrap_err().to_string();
        assert!(error.contains("line 2: a pixel is negative"), "{error}");
        assert!(read("here\n").unwrap_err().to_string().contains("coordinate system"));
    }
}
