//! Factors between SPZ's numbers and those of the 3DGS PLY, as SPZ's library defines them (github.com/nianticlabs/spz).

/// A colour byte is `255 · (0.5 + COLOR_SCALE · sh[0])`. This also covers colours that cannot be displayed, because
/// higher harmonics may bring such a colour back into the displayable range.
pub(super) const COLOR_SCALE: f32 = 0.15;
/// A byte of a scale is `LOG_SCALE_STEPS · (log_scale - LOG_SCALE_MIN)`.
pub(super) const LOG_SCALE_MIN: f32 = -10.0;
/// See [`LOG_SCALE_MIN`].
pub(super) const LOG_SCALE_STEPS: f32 = 16.0;
/// Factors between the coefficients in SPZ's axes and in those of the 3DGS PLY, by harmonic. A harmonic changes sign
/// if it is odd in y and z together.
pub(super) const SH_SIGNS: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];
/// Factors between the coordinates xyz in SPZ's axes and in those of the 3DGS PLY.
pub(super) const AXIS_SIGNS: [f32; 3] = [1.0, -1.0, -1.0];
