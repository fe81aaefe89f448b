//! Coordinate systems of maps.

use glam::DVec3;
use proj4rs::Proj;
use proj4rs::transform::transform;

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;
use crate::site::SiteFrame;

/// The system of GPS: longitude and latitude, WGS 84.
const WGS_84: u16 = 4326;

/// A system that changes lengths by a larger share than this is hardly meant for the place. UTM changes them by 0.001 at the
/// edge of a zone.
const SCALE_OFF_MAX: f64 = 0.0015;
/// The EPSG numbers of the zones of UTM on WGS 84: those of the north, then those of the south.
const UTM: [std::ops::RangeInclusive<u32>; 2] = [32_601..=32_660, 32_701..=32_760];

/// A coordinate system of maps: easting, northing, and height above the ellipsoid, metres.
pub struct Projection {
    epsg: u32,
    system: Proj,
    gps: Proj,
}

impl std::fmt::Debug for Projection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "EPSG:{}", self.epsg)
    }
}

impl Projection {
    /// The system with this EPSG number. An error if it is not known, is not a projection (longitude and latitude), or is
    /// not in metres.
    pub fn new(epsg: u32) -> Result<Self, GeoError> {
        let unknown = || GeoError::UnknownSystem { epsg };
        let system = u16::try_from(epsg).ok().and_then(|code| Proj::from_epsg_code(code).ok());
        let system = system.ok_or_else(unknown)?;
        let gps = Proj::from_epsg_code(WGS_84).map_err(|_| unknown())?;
        let is_map = !system.is_latlong() && !system.is_geocent() && (system.to_meter() - 1.0).abs() < 1e-12;
        if is_map { Ok(Self { epsg, system, gps }) } else { Err(unknown()) }
    }

    /// The UTM zone of a place, on WGS 84.
    pub fn utm_of(place: &Geodetic) -> Self {
        let zone = (((place.longitude_deg + 180.0) / 6.0).floor() as i64).rem_euclid(60) as u32 + 1;
        let epsg = zone + if place.latitude_deg < 0.0 { 32_700 } else { 32_600 };
        Self::new(epsg).expect("all zones of UTM are known")
    }

    /// The number of the system.
    pub fn epsg(&self) -> u32 {
        self.epsg
    }

    /// A line that tells why the system is hardly meant for a place: it is a zone of the other hemisphere, or changes lengths
    /// there by more than 0.15 %. `None` if it fits.
    pub fn doubt(&self, place: &Geodetic) -> Result<Option<String>, GeoError> {
        let best = Self::utm_of(place);
        let of_south = usize::from(place.latitude_deg < 0.0);
        let off = self.scale_at(place)? - 1.0;
        let why = if UTM[1 - of_south].contains(&self.epsg) {
            "is a zone of the other hemisphere".to_owned()
        } else if off.abs() > SCALE_OFF_MAX {
            let than = if off > 0.0 { "longer" } else { "shorter" };
            format!("makes lengths at this place {:.1} % {than}", 100.0 * off.abs())
        } else {
            return Ok(None);
        };
        Ok(Some(format!("EPSG:{} {why}; its zone of UTM is EPSG:{}", self.epsg, best.epsg)))
    }

    /// Length on the map of a metre on the ground, the mean over a square of 100 m about a place.
    fn scale_at(&self, place: &Geodetic) -> Result<f64, GeoError> {
        let site = SiteFrame::new(*place)?;
        let at = |east_m: f64, north_m: f64| {
            let at = self.project(&site.geodetic_from_enu(DVec3::new(east_m, north_m, 0.0)))?;
            Ok::<_, GeoError>(at.truncate())
        };
        let [east, north] = [at(50.0, 0.0)? - at(-50.0, 0.0)?, at(0.0, 50.0)? - at(0.0, -50.0)?];
        Ok((east.perp_dot(north).abs() / 10_000.0).sqrt())
    }

    /// The definition of the system as well-known text (WKT 1), for files that want it.
    pub fn wkt(&self) -> &'static str {
        let code = u16::try_from(self.epsg).expect("a system has a number of 16 bits");
        crs_definitions::from_code(code).map_or("", |definition| definition.wkt)
    }

    /// Easting, northing and ellipsoidal height of a place. An error if the system does not cover it.
    pub fn project(&self, place: &Geodetic) -> Result<DVec3, GeoError> {
        let Geodetic { latitude_deg, longitude_deg, height_m } = *place;
        let mut at = (longitude_deg.to_radians(), latitude_deg.to_radians(), height_m);
        let outside = GeoError::OutsideSystem { epsg: self.epsg, latitude_deg, longitude_deg };
        match transform(&self.gps, &self.system, &mut at) {
            Ok(()) if at.0.is_finite() && at.1.is_finite() => Ok(DVec3::new(at.0, at.1, height_m)),
            _ => Err(outside),
        }
    }

    /// The place with this easting, northing and ellipsoidal height. An error if the system does not cover it.
    pub fn unproject(&self, at: DVec3) -> Result<Geodetic, GeoError> {
        let mut place = (at.x, at.y, at.z);
        let is_done = transform(&self.system, &self.gps, &mut place).is_ok();
        let place = Geodetic {
            latitude_deg: place.1.to_degrees(),
            longitude_deg: place.0.to_degrees(),
            height_m: at.z,
        };
        let Geodetic { latitude_deg, longitude_deg, .. } = place;
        match place.check() {
            Ok(()) if is_done => Ok(place),
            _ => Err(GeoError::OutsideSystem { epsg: self.epsg, latitude_deg, longitude_deg }),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Places with their eastings and northings by PROJ 9.1 (`cs2cs -f %.4f EPSG:4326 EPSG:...`, which prints those of
    /// EPSG:2180 in the other order).
    const BY_PROJ: [(u32, [f64; 2], [f64; 2]); 3] = [
        (32_614, [30.1712, -98.0897], [587647.0771, 3338105.8937]),
        (32_733, [-33.9, 18.4], [814420.3310, 6243724.8401]),
        (2_180, [53.0, 16.5], [332289.0623, 573431.0595]),
    ];

    #[test]
    fn places_have_the_coordinates_that_proj_gives_them() {
        for (epsg, [latitude_deg, longitude_deg], wanted) in BY_PROJ {
            let place = Geodetic { latitude_deg, longitude_deg, height_m: 12.0 };
            let at = Projection::new(epsg).unwrap().project(&place).unwrap();
            assert!((at.x - wanted[0]).hypot(at.y - wanted[1]) < 0.001, "EPSG:{epsg}: {at}");
        }
    }

    #[test]
    fn coordinates_survive_the_way_to_places_and_back() {
        for (epsg, [latitude_deg, longitude_deg], _) in BY_PROJ {
            let system = Projection::new(epsg).unwrap();
            let place = Geodetic { latitude_deg, longitude_deg, height_m: 12.0 };
            let back = system.unproject(system.project(&place).unwrap()).unwrap();
            assert!((back.latitude_deg - latitude_deg).abs() < 1e-9, "EPSG:{epsg}: {back:?}");
            assert!((back.longitude_deg - longitude_deg).abs() < 1e-9, "EPSG:{epsg}: {back:?}");
        }
    }

    #[test]
    fn systems_of_other_places_are_doubted() {
        let doubt = |epsg: u32, latitude_deg: f64, longitude_deg: f64| {
            let place = Geodetic { latitude_deg, longitude_deg, height_m: 40.0 };
            Projection::new(epsg).unwrap().doubt(&place).unwrap()
        };
        let berlin = |epsg: u32| doubt(epsg, 52.5, 13.4);
        assert_eq!([32_633, 25_833, 2_180].map(berlin), [None, None, None]);
        // The neighbouring zone is allowed where it is not much worse: sites may lie in two.
        assert_eq!(doubt(32_632, 52.5, 12.1), None);
        for (epsg, told) in [
            (32_733, "the other hemisphere"),
            (27_700, "% longer"),
            (3_857, "% longer"),
            (32_634, "its zone of UTM is EPSG:32633"),
        ] {
            let doubt = berlin(epsg).unwrap();
            assert!(doubt.contains(told), "{doubt}");
        }
        assert!(doubt(32_633, -20.0, 15.0).is_some_and(|doubt| doubt.contains("EPSG:32733")));
    }

    #[test]
    fn utm_zones_are_those_of_their_places() {
        let zone = |latitude_deg, longitude_deg| {
            Projection::utm_of(&Geodetic { latitude_deg, longitude_deg, height_m: 0.0 }).epsg()
        };
        assert_eq!([zone(30.0, -98.1), zone(53.0, 16.5)], [32_614, 32_633]);
        assert_eq!([zone(-1.0, -180.0), zone(1.0, 180.0), zone(1.0, 179.9)], [32_701, 32_601, 32_660]);
    }

    #[test]
    fn systems_have_their_texts() {
        let wkt = Projection::new(32_633).unwrap().wkt();
        assert!(wkt.starts_with("PROJCS[") && wkt.ends_with("AUTHORITY[\"EPSG\",\"32633\"]]"), "{wkt}");
    }

    #[test]
    fn systems_that_are_no_maps_in_metres_are_refused() {
        // Longitude and latitude; earth-centred; US survey feet; no such number.
        for epsg in [4_326, 4_978, 2_277, 1, 999_999] {
            let error = Projection::new(epsg).unwrap_err().to_string();
            assert!(error.contains(&format!("EPSG:{epsg}")), "{error}");
        }
    }
}
