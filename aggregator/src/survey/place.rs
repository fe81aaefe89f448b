//! Where the world of a model lies in a coordinate system of maps.
//!
//! What it knows nothing about: pixels and models.

use std::path::Path;

use cosurf_geo::{GeoError, Geodetic, Geoid, Georeference, Projection, SiteFrame};
use glam::{DAffine3, DVec2, DVec3};

/// What heights of maps are without a geoid; EPSG has no projection with ellipsoidal heights.
const ELLIPSOIDAL: &str = "metres above the ellipsoid of WGS 84";

/// The mapping between the frame of a site (ENU, metres) and a map (easting, northing, metres; height above the geoid, or
/// above the ellipsoid if there is none, metres).
#[derive(Debug)]
pub(super) struct Place {
    site: SiteFrame,
    projection: Projection,
    geoid: Option<Geoid>,
}

/// A vertical line of the world, above a point of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Column {
    /// Where it stands in the frame of the site: east and north, metres.
    pub(super) at: DVec2,
    /// The height of its points on the map, minus their world z, metres.
    pub(super) lift_m: f64,
}

impl Place {
    /// The place of a site. `geoid` is the grid that heights are above.
    pub(super) fn new(georeference: &Georeference, geoid: Option<&Path>) -> Result<Self, GeoError> {
        let geoid = geoid.map(|file| Geoid::read(file, &georeference.origin)).transpose()?;
        Ok(Self { site: georeference.site()?, projection: georeference.projection()?, geoid })
    }

    /// What the heights of the map are, in words.
    pub(super) fn heights(&self) -> String {
        self.geoid.as_ref().map_or_else(|| ELLIPSOIDAL.into(), Geoid::heights)
    }

    /// EPSG number of the heights, if they have one.
    pub(super) fn vertical_epsg(&self) -> Option<u16> {
        self.geoid.as_ref()?.vertical_epsg()
    }

    /// The coordinate system as well-known text (WKT 1), with that of the heights if there is a geoid.
    pub(super) fn wkt(&self) -> String {
        let horizontal = self.projection.wkt();
        match &self.geoid {
            Some(geoid) => {
                format!(
                    r#"COMPD_CS["EPSG:{} with heights",{horizontal},{}]"#,
                    self.projection.epsg(),
                    geoid.wkt()
                )
            }
            None => horizontal.into(),
        }
    }

    pub(super) fn projection(&self) -> &Projection {
        &self.projection
    }

    /// The origin of the site.
    pub(super) fn origin(&self) -> Geodetic {
        self.site.origin()
    }

    /// The mapping from the frame of the site to ECEF, metres.
    pub(super) fn ecef_from_enu(&self) -> DAffine3 {
        self.site.ecef_from_enu()
    }

    /// Easting, northing and height on the map of a position in the world.
    pub(super) fn map_from_enu(&self, enu: DVec3) -> Result<DVec3, GeoError> {
        let place = self.site.geodetic_from_enu(enu);
        Ok(self.projection.project(&place)? - DVec3::Z * self.undulation_m(&place)?)
    }

    /// How high above the ellipsoid the map's heights begin, metres.
    fn undulation_m(&self, place: &Geodetic) -> Result<f64, GeoError> {
        self.geoid.as_ref().map_or(Ok(0.0), |geoid| geoid.undulation_m(place))
    }

    /// Easting and northing of a longitude and latitude, degrees.
    pub(super) fn map_from_degrees(&self, longitude_deg: f64, latitude_deg: f64) -> Result<DVec2, GeoError> {
        let place = Geodetic { latitude_deg, longitude_deg, height_m: self.site.origin().height_m };
        place.check()?;
        Ok(self.projection.project(&place)?.truncate())
    }

    /// Longitude and latitude, degrees, of an easting and northing.
    pub(super) fn degrees_from_map(&self, at: DVec2) -> Result<[f64; 2], GeoError> {
        let place = self.projection.unproject(at.extend(self.site.origin().height_m))?;
        Ok([place.longitude_deg, place.latitude_deg])
    }

    /// The column at an easting and northing. Lines of equal easting and northing are not quite parallel to the world's z
    /// axis: 1 km from the origin they lean by 0.16 mm per metre. The column is exact at the world height `z_m`.
    pub(super) fn column(&self, at: DVec2, z_m: f64) -> Result<Column, GeoError> {
        let mut height_m = self.site.origin().height_m + z_m;
        let mut enu = DVec3::ZERO;
        let mut undulation_m = 0.0;
        // The second round corrects the height by how far the ellipsoid has fallen away from the plane z = 0.
        for _ in 0..2 {
            let place = self.projection.unproject(at.extend(height_m))?;
            enu = self.site.enu_from_geodetic(&place);
            undulation_m = self.undulation_m(&place)?;
            height_m += z_m - enu.z;
        }
        Ok(Column { at: enu.truncate(), lift_m: height_m - z_m - undulation_m })
    }
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A site in Poland, 70 m above the ellipsoid, in UTM zone 33.
    pub(in crate::survey) fn place() -> Place {
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        Place::new(&Georeference::at(origin).unwrap(), None).unwrap()
    }

    #[test]
    fn columns_lead_back_to_the_places_on_the_map() {
        let place = place();
        for enu in [DVec3::new(0.0, 0.0, 12.0), DVec3::new(1500.0, -900.0, 12.0)] {
            let map = place.map_from_enu(enu).unwrap();
            let column = place.column(map.truncate(), enu.z).unwrap();
            assert!(column.at.distance(enu.truncate()) < 1e-5, "{enu}: {column:?}");
            assert!((column.lift_m + enu.z - map.z).abs() < 1e-5, "{enu}: {column:?}");
        }
    }

    #[test]
    fn maps_and_columns_agree_about_heights_above_a_geoid() {
        let folder = tempfile::tempdir().unwrap();
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        let grid = crate::testing::geoid(folder.path());
        let above = Place::new(&Georeference::at(origin).unwrap(), Some(&grid)).unwrap();
        for enu in [DVec3::new(0.0, 0.0, 12.0), DVec3::new(1500.0, -900.0, 12.0)] {
            let (map, ellipsoidal) = (above.map_from_enu(enu).unwrap(), place().map_from_enu(enu).unwrap());
            let at = above.site.geodetic_from_enu(enu);
            let wanted_m = crate::testing::undulation_m(at.longitude_deg, at.latitude_deg);
            assert!(
                (ellipsoidal.z - map.z - wanted_m).abs() < 1e-5 && wanted_m > 20.0,
                "{map} {ellipsoidal}"
            );
            let column = above.column(map.truncate(), enu.z).unwrap();
            assert!((column.lift_m + enu.z - map.z).abs() < 1e-5, "{enu}: {column:?}");
        }
        assert!(above.wkt().starts_with("COMPD_CS[") && above.wkt().contains("VERT_CS["), "{}", above.wkt());
        assert!(above.heights().contains("geoid of egm96_15.gtx, EPSG:5773"), "{}", above.heights());
    }

    #[test]
    fn degrees_are_longitude_first() {
        let place = place();
        let at = place.map_from_degrees(16.4, 53.3).unwrap();
        assert!(at.distance(place.map_from_enu(DVec3::ZERO).unwrap().truncate()) < 1e-3);
        let [longitude, latitude] = place.degrees_from_map(at).unwrap();
        assert!((longitude - 16.4).abs() < 1e-8 && (latitude - 53.3).abs() < 1e-8);
        assert!(place.map_from_degrees(16.4, 153.3).is_err());
    }
}
