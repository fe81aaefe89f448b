//! The frame of a site.

use glam::{DAffine3, DMat3, DVec3};

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;

/// The frame of a site: x east, y north, z up, metres, about an origin. It is a flat frame: at 1 km from the origin, the
/// ellipsoid is 8 cm below the plane z = 0, and the conversions here know that.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SiteFrame {
    origin: Geodetic,
    origin_ecef: DVec3,
    /// The rows are the directions of east, north and up, ECEF.
    enu_from_ecef: DMat3,
}

impl SiteFrame {
    /// The frame about `origin`. An error if that is no place.
    pub fn new(origin: Geodetic) -> Result<Self, GeoError> {
        origin.check()?;
        let (sin_latitude, cos_latitude) = origin.latitude_deg.to_radians().sin_cos();
        let (sin_longitude, cos_longitude) = origin.longitude_deg.to_radians().sin_cos();
        let east = DVec3::new(-sin_longitude, cos_longitude, 0.0);
        let north = DVec3::new(-sin_latitude * cos_longitude, -sin_latitude * sin_longitude, cos_latitude);
        let up = DVec3::new(cos_latitude * cos_longitude, cos_latitude * sin_longitude, sin_latitude);
        let enu_from_ecef = DMat3::from_cols(east, north, up).transpose();
        Ok(Self { origin, origin_ecef: origin.ecef(), enu_from_ecef })
    }

    /// The origin.
    pub fn origin(&self) -> Geodetic {
        self.origin
    }

    /// The mapping from the frame to the earth-centred, earth-fixed frame (ECEF), metres.
    pub fn ecef_from_enu(&self) -> DAffine3 {
        DAffine3::from_mat3_translation(self.enu_from_ecef.transpose(), self.origin_ecef)
    }

    /// A place in the frame, metres.
    pub fn enu_from_geodetic(&self, place: &Geodetic) -> DVec3 {
        self.enu_from_ecef * (place.ecef() - self.origin_ecef)
    }

    /// The place at a position in the frame, metres.
    pub fn geodetic_from_enu(&self, enu: DVec3) -> Geodetic {
        Geodetic::from_ecef(self.enu_from_ecef.transpose() * enu + self.origin_ecef)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn site() -> SiteFrame {
        SiteFrame::new(Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 }).unwrap()
    }

    #[test]
    fn east_north_and_up_are_where_they_should_be() {
        let site = site();
        let origin = site.origin();
        let near = |place: Geodetic| site.enu_from_geodetic(&place);
        let north = near(Geodetic { latitude_deg: origin.latitude_deg + 1e-5, ..origin });
        // A degree of latitude has 111.3 km there.
        assert!(north.x.abs() < 1e-6 && (north.y - 1.113).abs() < 0.001 && north.z.abs() < 1e-6, "{north}");
        let east = near(Geodetic { longitude_deg: origin.longitude_deg + 1e-5, ..origin });
        assert!((east.x - 0.667).abs() < 0.001 && east.y.abs() < 1e-6, "{east}");
        let up = near(Geodetic { height_m: 75.0, ..origin });
        assert!(up.distance(DVec3::new(0.0, 0.0, 5.0)) < 1e-8, "{up}");
    }

    #[test]
    fn positions_survive_the_way_to_the_earth_and_back() {
        let site = site();
        for enu in [DVec3::ZERO, DVec3::new(2_000.0, -3_000.0, 120.0), DVec3::new(-1.0, 0.5, -20.0)] {
            let back = site.enu_from_geodetic(&site.geodetic_from_enu(enu));
            assert!(back.distance(enu) < 1e-6, "{enu} {back}");
            let ecef = site.ecef_from_enu().transform_point3(enu);
            assert!(ecef.distance(site.geodetic_from_enu(enu).ecef()) < 1e-6, "{enu} {ecef}");
        }
        // The earth falls away below the plane: by d² / 2 r.
        let far = site.geodetic_from_enu(DVec3::new(1_000.0, 0.0, 0.0));
        assert!((far.height_m - 70.0 - 0.078).abs() < 0.001, "{far:?}");
    }
}
