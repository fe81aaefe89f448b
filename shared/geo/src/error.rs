//! Why a place or a file is refused.

use std::path::{Path, PathBuf};

/// Why a place, a coordinate system or a file is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GeoError {
    /// A latitude, longitude or height is not a place on the earth.
    #[error(
        "latitude {latitude_deg}°, longitude {longitude_deg}°, height {height_m} m is no place on the earth: give degrees, latitude first, and metres"
    )]
    NoPlace {
        /// Degrees.
        latitude_deg: f64,
        /// Degrees.
        longitude_deg: f64,
        /// Metres above the ellipsoid.
        height_m: f64,
    },
    /// A text is not a place.
    #[error(
        "'{text}' is not three numbers; write latitude, longitude and height, for example 53.3,16.4,70.5"
    )]
    NotThreeNumbers {
        /// The text.
        text: String,
    },
    /// A coordinate system is not known, or is not one of maps in metres.
    #[error(
        "EPSG:{epsg} is not a known map projection in metres; for UTM on WGS 84 it is 32600 + zone in the north, 32700 + zone in the south"
    )]
    UnknownSystem {
        /// Its number.
        epsg: u32,
    },
    /// A place lies outside of what a coordinate system covers.
    #[error("EPSG:{epsg} does not cover latitude {latitude_deg}°, longitude {longitude_deg}°")]
    OutsideSystem {
        /// Its number.
        epsg: u32,
        /// Degrees.
        latitude_deg: f64,
        /// Degrees.
        longitude_deg: f64,
    },
    /// A file cannot be read or written.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        cause: std::io::Error,
    },
    /// A file is not what its name says.
    #[error("{path} is not a georeference: {cause}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        cause: serde_json::Error,
    },
    /// The first line of a list of places names no coordinate system that is known.
    #[error(
        "'{line}' names no coordinate system that cosurf knows; write EPSG:4326, EPSG: with the number of a map, 'WGS84 UTM 14N' or a string of PROJ that begins with +proj="
    )]
    UnknownCrs {
        /// The line.
        line: String,
    },
    /// A file that somebody else wrote cannot be used.
    #[error("{path}: {reason}")]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do about it.
        reason: String,
    },
    /// Too little is known to say where a reconstruction lies.
    #[error("{0}")]
    NoFit(&'static str),
}

impl GeoError {
    /// The refusal of a file that somebody else wrote.
    pub(crate) fn refused(path: &Path, reason: &str) -> Self {
        Self::Refused { path: path.into(), reason: reason.into() }
    }
}
