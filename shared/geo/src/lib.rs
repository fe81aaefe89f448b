//! Where on the earth a model lies.
//!
//! The world of a georeferenced site is *ENU*: x east, y north, z up, metres, about the *origin* of the site, a point on the
//! ellipsoid of WGS 84. So an `f32` holds millimetres, and models of several drones lie where GPS says.
//!
//! - [`Geodetic`]: latitude, longitude and height above the ellipsoid.
//! - [`SiteFrame`]: converts between ENU and these.
//! - [`Projection`]: a coordinate system of maps by its EPSG number, for what is delivered.
//! - [`Geoid`]: how high the geoid lies above the ellipsoid, by a grid that the user gives.
//! - [`Georeference`]: the content of `geo.json`, which lies beside a dataset or a model.
//! - [`PhotoInfo`], [`read_geo_txt`], [`read_gcp_list`]: what photographs and lists beside them tell about places.
//! - [`fit()`]: the [`Similarity`] that takes a reconstruction to where these places say.
//!
//! What it knows nothing about: pixels, cameras, splats, how a reconstruction is made. Heights are ellipsoidal where
//! nothing else is said; no geoid is built in.
//!
//! Where to start reading: [`SiteFrame`].
//!
//! ```
//! use cosurf_geo::{Geodetic, Projection, SiteFrame};
//! use glam::DVec3;
//!
//! let origin = Geodetic { latitude_deg: 30.1712, longitude_deg: -98.0897, height_m: 300.0 };
//! let site = SiteFrame::new(origin)?;
//! let place = site.geodetic_from_enu(DVec3::new(100.0, 0.0, 5.0));
//! assert!((place.height_m - 305.0).abs() < 0.01);
//! let utm = Projection::utm_of(&origin);
//! assert_eq!(utm.epsg(), 32614);
//! let [west, east] = [origin, place].map(|place| utm.project(&place).expect("inside the zone").x);
//! assert!((east - west - 100.0).abs() < 0.1);
//! # Ok::<(), cosurf_geo::GeoError>(())
//! ```

mod crs;
mod ellipsoid;
mod error;
mod fit;
mod gcp;
mod geo_txt;
mod geoid;
mod georeference;
mod photo;
mod projection;
mod similarity;
mod site;
mod table;

pub use ellipsoid::Geodetic;
pub use error::GeoError;
pub use fit::{Fit, Judged, Sighting, Up, fit, median};
pub use gcp::{ControlPoint, Mark, read_gcp_list};
pub use geo_txt::{PhotoPlace, read_geo_txt};
pub use geoid::Geoid;
pub use georeference::{
    DroneResiduals, FitUncertainty, Georeference, GpsResiduals, PointResidual, Residuals,
};
pub use photo::{Gps, GpsAccuracy, PhotoInfo};
pub use projection::Projection;
pub use similarity::Similarity;
pub use site::SiteFrame;
