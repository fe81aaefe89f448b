//! The coordinate systems that lists of places name in their first lines.

use proj4rs::Proj;
use proj4rs::transform::transform;

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;

/// The system of GPS: longitude and latitude, WGS 84.
const WGS_84: u16 = 4326;
/// Longest line that may name a system, bytes.
const LINE_BYTES_MAX: usize = 1000;

/// The coordinate system of a list: x is east or longitude, y is north or latitude, as ODM writes them.
pub(crate) struct Crs {
    system: Proj,
    gps: Proj,
}

impl Crs {
    /// The system that a line names: `EPSG:32614`, `WGS84 UTM 14N`, or a string of PROJ.
    pub(crate) fn parse(line: &str) -> Result<Self, GeoError> {
        let unknown = || GeoError::UnknownCrs { line: line.chars().take(100).collect() };
        if line.len() > LINE_BYTES_MAX {
            return Err(unknown());
        }
        let system = match numbered(line) {
            Some(epsg) => Proj::from_epsg_code(epsg).ok(),
            None if line.starts_with('+') => Proj::from_proj_string(line).ok(),
            None => None,
        };
        let system = system.filter(|system| !system.is_geocent()).ok_or_else(unknown)?;
        let gps = Proj::from_epsg_code(WGS_84).map_err(|_| unknown())?;
        Ok(Self { system, gps })
    }

    /// The place at a position of the list. Its height is taken as the ellipsoidal height, metres.
    pub(crate) fn place(&self, x: f64, y: f64, height_m: f64) -> Result<Geodetic, GeoError> {
        let mut at =
            if self.system.is_latlong() { (x.to_radians(), y.to_radians(), 0.0) } else { (x, y, 0.0) };
        let is_done = transform(&self.system, &self.gps, &mut at).is_ok();
        let place = Geodetic {
            latitude_deg: if is_done { at.1.to_degrees() } else { f64::NAN },
            longitude_deg: at.0.to_degrees(),
            height_m,
        };
        place.check()?;
        Ok(place)
    }
}

/// The EPSG number that a line such as `EPSG:4326` or `WGS84 UTM 14N` stands for.
fn numbered(line: &str) -> Option<u16> {
    let words: Vec<String> = line.split_whitespace().map(str::to_ascii_uppercase).collect();
    match &words.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [number] => number.strip_prefix("EPSG:")?.parse().ok(),
        ["WGS84", "UTM", zone] => {
            let (number, base) = match (zone.strip_suffix('N'), zone.strip_suffix('S')) {
                (Some(number), _) => (number, 32_600),
                (_, Some(number)) => (number, 32_700),
                _ => return None,
            };
            let number: u16 = number.parse().ok()?;
            (1..=60).contains(&number).then_some(base + number)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn one_place_has_three_names() {
        // By PROJ 9.1: `cs2cs EPSG:4326 EPSG:32614`.
        let (x, y) = (587647.0771, 3338105.8937);
        for line in
            ["EPSG:32614", "epsg:32614", "WGS84 UTM 14N", "+proj=utm +zone=14 +datum=WGS84 +units=m +no_defs"]
        {
            let place = Crs::parse(line).unwrap().place(x, y, 5.0).unwrap();
            assert!((place.latitude_deg - 30.1712).abs() < 1e-8, "{line}: {place:?}");
            assert!((place.longitude_deg + 98.0897).abs() < 1e-8, "{line}: {place:?}");
        }
        let place = Crs::parse("EPSG:4326").unwrap().place(-98.0897, 30.1712, 5.0).unwrap();
        assert!((place.latitude_deg - 30.1712).abs() < 1e-12 && place.height_m == 5.0, "{place:?}");
    }

    #[test]
    fn what_is_no_system_is_refused() {
        for line in
            ["", "EPSG:", "EPSG:99999999", "WGS84 UTM 61N", "WGS84 UTM N", "+proj=nothing", "IMG_1.jpg 1 2"]
        {
            let error = Crs::parse(line).err().unwrap().to_string();
            assert!(error.contains("coordinate system"), "{line}: {error}");
        }
        assert!(Crs::parse("EPSG:4326").unwrap().place(30.0, 98.0, 0.0).is_err(), "latitude comes second");
        assert!(Crs::parse("EPSG:32614").unwrap().place(f64::NAN, 0.0, 0.0).is_err());
    }
}
