//! The order of the planes of a rendered picture: red, green, blue and remaining transmittance; then, with
//! [`Channels::Geometry`], the blended normal (xyz, camera frame, not normalised) and the blended plane distance.

use crate::backend::Channels;

pub(crate) const RGB: usize = 0;
pub(crate) const TRANSMITTANCE: usize = 3;
pub(crate) const NORMAL: usize = 4;
pub(crate) const DISTANCE: usize = 7;
pub(crate) const PLANES_COLOR: usize = 4;
pub(crate) const PLANES_GEOMETRY: usize = 8;

/// Number of planes of a rendering with these channels.
pub(crate) fn planes(channels: Channels) -> usize {
    match channels {
        Channels::Color => PLANES_COLOR,
        Channels::Geometry => PLANES_GEOMETRY,
    }
}
