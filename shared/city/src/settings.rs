//! The settings of a city, and the errors of impossible settings.

/// The settings of a city. The same settings give the same bytes on every machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CitySettings {
    /// Seed of all random choices.
    pub seed: u64,
    /// Side of the flown square in metres, 10 to 1000. Land is built around it as far as cameras see.
    pub extent_m: f64,
    /// Number of pictures, 3 to 9999: half straight down, half oblique.
    pub views: u32,
    /// Width and height of the pictures in pixels, each 16 to 8192.
    pub size_px: [u32; 2],
}

impl Default for CitySettings {
    /// The scene of the built-in mission: a small city that is built within seconds.
    fn default() -> Self {
        Self { seed: 7, extent_m: 180.0, views: 96, size_px: [320, 240] }
    }
}

/// Why a city cannot be built.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CityError {
    /// Too small for a street, too large for memory, or not a number.
    #[error("city: extent {0} m is not possible, choose 10 to 1000 m")]
    Extent(f64),
    /// Too few for a surface seen by three cameras, or too many for four digits in the names.
    #[error("city: {0} views are not possible, choose 3 to 9999")]
    Views(u32),
    /// Too small for a useful picture, or too large for memory.
    #[error("city: pictures of {} x {} px are not possible, choose 16 to 8192 a side", .0[0], .0[1])]
    Size([u32; 2]),
}

impl CitySettings {
    /// Refuses settings outside their ranges.
    pub(super) fn check(&self) -> Result<(), CityError> {
        if !(10.0..=1000.0).contains(&self.extent_m) {
            return Err(CityError::Extent(self.extent_m));
        }
        if !(3..=9999).contains(&self.views) {
            return Err(CityError::Views(self.views));
        }
        if !self.size_px.iter().all(|side| (16..=8192).contains(side)) {
            return Err(CityError::Size(self.size_px));
        }
        Ok(())
    }
}
