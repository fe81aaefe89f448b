//! The ellipsoid of WGS 84, on which GPS gives places.

use std::str::FromStr;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::error::GeoError;

/// Equatorial radius, metres (WGS 84, NGA.STND.0036).
const RADIUS_M: f64 = 6_378_137.0;
/// Flattening (WGS 84).
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
const ECCENTRICITY2: f64 = FLATTENING * (2.0 - FLATTENING);
/// Heights of places where drones fly, and some room, metres.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = -12_000.0..=100_000.0;

/// A place on the earth, WGS 84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Geodetic {
    /// Degrees north, -90..=90.
    pub latitude_deg: f64,
    /// Degrees east, -180..=180.
    pub longitude_deg: f64,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
}

impl Geodetic {
    /// An error unless this is a place on or near the earth.
    pub fn check(&self) -> Result<(), GeoError> {
        let Self { latitude_deg, longitude_deg, height_m } = *self;
        let is_place =
            latitude_deg.abs() <= 90.0 && longitude_deg.abs() <= 180.0 && HEIGHTS_M.contains(&height_m);
        if is_place { Ok(()) } else { Err(GeoError::NoPlace { latitude_deg, longitude_deg, height_m }) }
    }

    /// Position in the earth-centred, earth-fixed frame (ECEF), metres.
    pub fn ecef(&self) -> DVec3 {
        let (sin_latitude, cos_latitude) = self.latitude_deg.to_radians().sin_cos();
        let (sin_longitude, cos_longitude) = self.longitude_deg.to_radians().sin_cos();
        let radius = RADIUS_M / (1.0 - ECCENTRICITY2 * sin_latitude * sin_latitude).sqrt();
        let across = (radius + self.height_m) * cos_latitude;
        let up = (radius * (1.0 - ECCENTRICITY2) + self.height_m) * sin_latitude;
        DVec3::new(across * cos_longitude, across * sin_longitude, up)
    }

    /// The place at an ECEF position, metres, by Bowring's formula (1976) with one more round: exact to a micrometre for
    /// heights of drones. The position must not be near the earth's centre.
    pub fn from_ecef(p: DVec3) -> Self {
        let across = p.x.hypot(p.y);
        let polar = RADIUS_M * (1.0 - FLATTENING);
        let second2 = ECCENTRICITY2 / (1.0 - ECCENTRICITY2);
        let mut reduced = (p.z * RADIUS_M).atan2(across * polar);
        let mut latitude = 0.0;
        for _ in 0..3 {
            let (sin, cos) = reduced.sin_cos();
            latitude =
                (p.z + second2 * polar * sin.powi(3)).atan2(across - ECCENTRICITY2 * RADIUS_M * cos.powi(3));
            reduced = ((1.0 - FLATTENING) * latitude.tan()).atan();
        }
        let (sin, cos) = latitude.sin_cos();
        let radius = RADIUS_M / (1.0 - ECCENTRICITY2 * sin * sin).sqrt();
        // Each formula is exact where the other divides by almost nothing.
        let height_m =
            if cos.abs() > 0.5 { across / cos - radius } else { p.z / sin - radius * (1.0 - ECCENTRICITY2) };
        Self { latitude_deg: latitude.to_degrees(), longitude_deg: p.y.atan2(p.x).to_degrees(), height_m }
    }
}

impl FromStr for Geodetic {
    type Err = GeoError;

    /// Parses latitude, longitude and height, separated by commas: `30.1712,-98.0897,300`.
    fn from_str(text: &str) -> Result<Self, GeoError> {
        let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
        let Some(&[latitude_deg, longitude_deg, height_m]) = numbers.as_deref() else {
            return Err(GeoError::NotThreeNumbers { text: text.into() });
        };
        let place = Self { latitude_deg, longitude_deg, height_m };
        place.check().map(|()| place)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn known_places_have_their_known_ecef_positions() {
        // The ends of the axes, from the radii of WGS 84.
        let at =
            |latitude_deg, longitude_deg, height_m| Geodetic { latitude_deg, longitude_deg, height_m }.ecef();
        assert!(at(0.0, 0.0, 0.0).distance(DVec3::new(6_378_137.0, 0.0, 0.0)) < 1e-6);
        assert!(at(0.0, 90.0, 10.0).distance(DVec3::new(0.0, 6_378_147.0, 0.0)) < 1e-6);
        assert!(at(90.0, 0.0, 0.0).distance(DVec3::new(0.0, 0.0, 6_356_752.314_245)) < 1e-6);
    }

    #[test]
    fn places_survive_the_way_to_ecef_and_back() {
        for latitude_deg in [-90.0, -89.9999, -45.0, -1e-6, 0.0, 30.1712, 53.2, 89.5, 90.0] {
            for longitude_deg in [-180.0, -98.09, 0.0, 16.5, 179.999] {
                for height_m in [-400.0, 0.0, 300.0, 9_000.0] {
                    let place = Geodetic { latitude_deg, longitude_deg, height_m };
                    let back = Geodetic::from_ecef(place.ecef());
                    assert!(back.ecef().distance(place.ecef()) < 1e-6, "{place:?} {back:?}");
                    assert!((back.height_m - height_m).abs() < 1e-6, "{place:?} {back:?}");
                    assert!((back.latitude_deg - latitude_deg).abs() < 1e-10, "{place:?} {back:?}");
                }
            }
        }
    }

    #[test]
    fn places_are_written_as_three_numbers() {
        let place = Geodetic { latitude_deg: -53.3, longitude_deg: 16.4, height_m: -0.5 };
        assert_eq!("-53.3, 16.4,-0.5".parse::<Geodetic>().unwrap(), place);
        for (text, told) in [
            ("53.3,16.4", "not three numbers"),
            ("53.3,16.4,x", "not three numbers"),
            ("53.3,16.4,1,2", "not three numbers"),
            ("", "not three numbers"),
            ("nan,16.4,1", "no place on the earth"),
            ("153.3,16.4,1", "no place on the earth"),
            ("53.3,16.4,inf", "no place on the earth"),
        ] {
            let error = text.parse::<Geodetic>().unwrap_err().to_string();
            assert!(error.contains(told), "{text}: {error}");
        }
    }

    #[test]
    fn what_is_no_place_is_refused() {
        let place = Geodetic { latitude_deg: 30.0, longitude_deg: -98.0, height_m: 250.0 };
        assert!(place.check().is_ok());
        for wrong in [
            Geodetic { latitude_deg: 98.0, ..place },
            Geodetic { longitude_deg: 181.0, ..place },
            Geodetic { height_m: f64::NAN, ..place },
            Geodetic { latitude_deg: f64::INFINITY, ..place },
        ] {
            assert!(wrong.check().unwrap_err().to_string().contains("no place"), "{wrong:?}");
        }
    }
}
