//! The place of a photograph.

use super::accuracy::GpsAccuracy;

/// Where GPS says that a photograph was taken, WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gps {
    /// Degrees north, -90..=90.
    pub latitude_deg: f64,
    /// Degrees east, -180..=180.
    pub longitude_deg: f64,
    /// Metres above whatever the receiver counts from, often mean sea level; `None` if not told.
    pub height_m: Option<f64>,
    /// How accurate the receiver says that the place is; `None` if not told.
    pub accuracy: Option<GpsAccuracy>,
}
