//! `geo.txt` of ODM: where each photograph was taken, for cameras that write no GPS, or a better one than theirs.
//!
//! The first line names the coordinate system; each further one is `photograph x y [z ...]`.

use std::path::Path;

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;
use crate::photo::Gps;
use crate::table::{Table, number};

/// A photograph's name and place.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoPlace {
    /// Name of the photograph's file.
    pub name: String,
    /// Where it was taken.
    pub gps: Gps,
}

/// Reads a `geo.txt`.
pub fn read_geo_txt(path: &Path) -> Result<Vec<PhotoPlace>, GeoError> {
    let table = Table::read(path)?;
    let read = |(at, line): &(usize, String)| {
        let refuse =
            |reason: String| GeoError::Refused { path: path.into(), reason: format!("line {at}: {reason}") };
        let words: Vec<&str> = line.split_whitespace().collect();
        let [name, x, y, rest @ ..] = &words[..] else {
            return Err(refuse("write `photograph x y z`".into()));
        };
        let (Some(x), Some(y)) = (number(x), number(y)) else {
            return Err(refuse("x and y must be numbers".into()));
        };
        let height_m = rest.first().and_then(|word| number(word));
        let place =
            table.crs.place(x, y, height_m.unwrap_or(0.0)).map_err(|error| refuse(error.to_string()))?;
        let Geodetic { latitude_deg, longitude_deg, .. } = place;
        let gps = Gps { latitude_deg, longitude_deg, height_m, accuracy: None };
        Ok(PhotoPlace { name: (*name).to_owned(), gps })
    };
    table.lines.iter().map(read).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn read(text: &str) -> Result<Vec<PhotoPlace>, GeoError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("geo.txt");
        std::fs::write(&path, text).unwrap();
        read_geo_txt(&path)
    }

    #[test]
    fn places_are_read_with_and_without_heights() {
        let places =
            read("EPSG:4326\n# a comment\n\nA.JPG -98.5 30.25 310.5 1 2 3\nB.JPG -98.5 30.25\n").unwrap();
        assert_eq!([&*places[0].name, &*places[1].name], ["A.JPG", "B.JPG"]);
        assert!((places[0].gps.latitude_deg - 30.25).abs() < 1e-12);
        assert_eq!([places[0].gps.height_m, places[1].gps.height_m], [Some(310.5), None]);
    }

    #[test]
    fn wrong_lines_are_named() {
        for (text, told) in [
            ("", "geo.txt: is empty"),
            ("A.JPG 1 2 3\n", "coordinate system"),
            ("EPSG:4326\nA.JPG 1\n", "line 2: write"),
            ("EPSG:4326\n\nA.JPG x 2\n", "line 3: x and y"),
            ("EPSG:4326\nA.JPG 30 98\n", "line 2: latitude 98°"),
            ("EPSG:4326\nA.JPG nan 1\n", "line 2: x and y"),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
    }
}
