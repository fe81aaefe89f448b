//! The pixels of the map, and where the world lies below them.
//!
//! Pixels are squares of the coordinate system whose corners are multiples of their side, so maps of one site with the
//! same side fit on each other. They are worked on in tiles of [`TILE_PX`].
//!
//! What it knows nothing about: what pixels show.

use cosurf_geo::GeoError;
use glam::DVec2;

use super::error::SurveyError;
use super::place::{Column, Place};

/// Side of a tile, px; also that of the blocks of the GeoTIFFs. A multiple of [`BLOCK_PX`].
pub(super) const TILE_PX: u32 = 512;
/// The conversion to the world is exact at the corners of blocks with this side, px, and bilinear between: with pixels
/// of 0.1 m that errs by less than a micrometre, because the scale of a projection changes over kilometres.
const BLOCK_PX: u32 = 32;
/// Largest side of a map, px: 10 GB of heights on the disk if both sides are as long.
const SIDE_MAX_PX: u64 = 50_000;

/// The pixels of a map.
#[derive(Debug)]
pub(super) struct Lattice {
    place: Place,
    gsd_m: f64,
    /// Column and row of the first pixel, counted eastwards and southwards from the origin of the coordinate system.
    first: [i64; 2],
    size_px: [u32; 2],
    /// World height at which columns are exact, metres: that of most of the surface.
    ground_m: f64,
}

/// The ground that a map should show.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extent {
    /// Least easting and northing, metres.
    pub(super) low: DVec2,
    /// Greatest easting and northing, metres; below `low` if there is nothing to show.
    pub(super) high: DVec2,
    /// World height of half of the ground, metres.
    pub(super) median_m: f64,
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Window {
    /// Column and row of its first pixel.
    pub(super) at: [u32; 2],
    /// Width and height, px.
    pub(super) size: [u32; 2],
}

impl Window {
    /// Number of its pixels.
    pub(super) fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Position in the map, px, of the middle of its `index`-th pixel, row by row.
    pub(super) fn middle_of(&self, index: usize) -> DVec2 {
        let [x, y] = [index as u32 % self.size[0], index as u32 / self.size[0]];
        DVec2::new(f64::from(self.at[0] + x), f64::from(self.at[1] + y)) + 0.5
    }
}

impl Lattice {
    /// The smallest map with pixels of the side `gsd_m` that shows all of the extent.
    pub(super) fn around(place: Place, extent: &Extent, gsd_m: f64) -> Result<Self, SurveyError> {
        let Extent { low, high, median_m } = *extent;
        if !low.cmple(high).all() {
            return Err(SurveyError::NothingSeen);
        }
        let sides = high - low;
        if gsd_m > sides.max_element() {
            return Err(SurveyError::TooCoarse { gsd_m, sides_m: sides.to_array() });
        }
        let cell = |metres: f64| (metres / gsd_m).floor();
        let [west, east] = [low.x, high.x].map(cell);
        // Rows go south, northings go north.
        let [north, south] = [-high.y, -low.y].map(cell);
        let size = [east - west + 1.0, south - north + 1.0];
        let longest = size[0].max(size[1]);
        if longest > SIDE_MAX_PX as f64 {
            let enough_m = two_digits_up(gsd_m * longest / (SIDE_MAX_PX - 2) as f64);
            let size_px = size.map(|side| side as u64);
            return Err(SurveyError::TooLarge { gsd_m, size_px, side_max_px: SIDE_MAX_PX, enough_m });
        }
        let size_px = size.map(|side| side as u32);
        Ok(Self { place, gsd_m, first: [west as i64, north as i64], size_px, ground_m: median_m })
    }

    pub(super) fn place(&self) -> &Place {
        &self.place
    }

    /// Side of a pixel in the coordinate system, metres.
    pub(super) fn gsd_m(&self) -> f64 {
        self.gsd_m
    }

    /// Width and height of the map, px.
    pub(super) fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Easting and northing of a position in the map, px from its north-western corner.
    pub(super) fn map_from_px(&self, px: DVec2) -> DVec2 {
        let at = DVec2::new(self.first[0] as f64, self.first[1] as f64) + px;
        DVec2::new(at.x, -at.y) * self.gsd_m
    }

    /// Position in the map, px from its north-western corner, of an easting and northing.
    pub(super) fn px_from_map(&self, map: DVec2) -> DVec2 {
        DVec2::new(map.x, -map.y) / self.gsd_m - DVec2::new(self.first[0] as f64, self.first[1] as f64)
    }

    /// The columns at the centres of a window's pixels, row by row. Its first pixel must begin a block.
    pub(super) fn columns(&self, window: Window) -> Result<Vec<Column>, GeoError> {
        let [across, down] = window.size.map(|side| side.div_ceil(BLOCK_PX) as usize);
        let corner = |x: usize, y: usize| {
            let px = DVec2::new(f64::from(window.at[0]), f64::from(window.at[1]))
                + DVec2::new(x as f64, y as f64) * f64::from(BLOCK_PX);
            self.place.column(self.map_from_px(px), self.ground_m)
        };
        let corners: Vec<Column> = (0..=down)
            .flat_map(|y| (0..=across).map(move |x| (x, y)))
            .map(|(x, y)| corner(x, y))
            .collect::<Result<_, _>>()?;
        let mut columns = Vec::with_capacity(window.pixels());
        for y in 0..window.size[1] {
            let (row, v) = ((y / BLOCK_PX) as usize, share(y));
            for x in 0..window.size[0] {
                let (column, u) = ((x / BLOCK_PX) as usize, share(x));
                let first = row * (across + 1) + column;
                let north = mix(corners[first], corners[first + 1], u);
                let south = mix(corners[first + across + 1], corners[first + across + 2], u);
                columns.push(mix(north, south, v));
            }
        }
        Ok(columns)
    }

    /// The area on the ground that a pixel covers, square metres: projections stretch it.
    pub(super) fn pixel_area_m2(&self, px: DVec2) -> Result<f64, GeoError> {
        let at = |step: DVec2| Ok(self.place.column(self.map_from_px(px + step), self.ground_m)?.at);
        let (east, south) = (at(DVec2::X)? - at(-DVec2::X)?, at(DVec2::Y)? - at(-DVec2::Y)?);
        Ok(0.25 * east.perp_dot(south).abs())
    }
}

/// Where the centre of a pixel lies between the edges of its block, 0 to 1.
fn share(px: u32) -> f64 {
    (f64::from(px % BLOCK_PX) + 0.5) / f64::from(BLOCK_PX)
}

fn mix(a: Column, b: Column, share: f64) -> Column {
    Column { at: a.at.lerp(b.at, share), lift_m: a.lift_m + (b.lift_m - a.lift_m) * share }
}

/// Rounds up to two significant digits.
pub(super) fn two_digits_up(value: f64) -> f64 {
    round_with(value, f64::ceil)
}

/// Rounds to two significant digits.
pub(super) fn two_digits(value: f64) -> f64 {
    round_with(value, f64::round)
}

fn round_with(value: f64, round: impl Fn(f64) -> f64) -> f64 {
    let exponent = 1 - value.log10().floor() as i32;
    // Dividing by a power of ten gives the nearest number to a decimal fraction; multiplying by 0.1 does not.
    match exponent {
        0.. => round(value * 10f64.powi(exponent)) / 10f64.powi(exponent),
        _ => round(value / 10f64.powi(-exponent)) * 10f64.powi(-exponent),
    }
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec3;

    use super::super::place::tests::place;
    use super::*;

    /// The extent of some places in the world.
    fn extent(places: &[DVec3]) -> Extent {
        let map = |at: &DVec3| place().map_from_enu(*at).unwrap().truncate();
        let low = places.iter().map(map).fold(DVec2::INFINITY, DVec2::min);
        let high = places.iter().map(map).fold(DVec2::NEG_INFINITY, DVec2::max);
        Extent { low, high, median_m: places.first().map_or(0.0, |at| at.z) }
    }

    /// A map of the ground between two corners, world metres, at z = 5 m.
    pub(in crate::survey) fn lattice(west_south: [f64; 2], east_north: [f64; 2], gsd_m: f64) -> Lattice {
        let places = [west_south, east_north].map(|[x, y]| DVec3::new(x, y, 5.0));
        Lattice::around(place(), &extent(&places), gsd_m).unwrap()
    }

    #[test]
    fn columns_are_exact_to_a_hundredth_of_a_millimetre() {
        let lattice = lattice([900.0, -400.0], [1000.0, -250.0], 0.1);
        let window = Window { at: [512, 1024], size: [450, 400] };
        let columns = lattice.columns(window).unwrap();
        for (x, y) in [(0, 0), (15, 16), (16, 15), (449, 399), (31, 32), (400, 17)] {
            let px = DVec2::new(f64::from(512 + x) + 0.5, f64::from(1024 + y) + 0.5);
            let exact = lattice.place.column(lattice.map_from_px(px), 5.0).unwrap();
            let got = columns[(y * 450 + x) as usize];
            assert!(got.at.distance(exact.at) < 1e-5 && (got.lift_m - exact.lift_m).abs() < 1e-5, "{x} {y}");
        }
    }

    #[test]
    fn pixels_are_aligned_to_multiples_of_their_side_and_cover_the_ground() {
        let lattice = lattice([0.0, 0.0], [40.0, 30.0], 0.25);
        let corner = lattice.map_from_px(DVec2::ZERO);
        assert_eq!((corner / 0.25).fract(), DVec2::ZERO);
        for (x, y) in [(0.0, 0.0), (40.0, 30.0)] {
            let map = lattice.place.map_from_enu(DVec3::new(x, y, 5.0)).unwrap().truncate();
            let px = lattice.px_from_map(map);
            let size = lattice.size_px().map(f64::from);
            assert!(px.x >= 0.0 && px.y >= 0.0 && px.x < size[0] && px.y < size[1], "{px}");
            assert!(lattice.map_from_px(px).distance(map) < 1e-6);
        }
        // UTM 33 at 1.4° from its middle: its scale is 0.9996 · (1 + d² / 2 r²), with d = 93 km. The ground is 75 m
        // above the ellipsoid, which stretches it by h / r.
        let area_m2 = lattice.pixel_area_m2(DVec2::splat(9.0)).unwrap();
        assert!((area_m2 / 0.0625 - 1.000_611).abs() < 3e-6, "{area_m2}");
    }

    #[test]
    fn maps_that_are_too_large_are_refused_with_what_would_do() {
        let wide = extent(&[DVec3::ZERO, DVec3::new(9000.0, 100.0, 0.0)]);
        let error = Lattice::around(place(), &wide, 0.01).unwrap_err().to_string();
        assert!(error.contains("use --gsd 0.18 or more"), "{error}");
        assert!(Lattice::around(place(), &wide, 0.18).is_ok());
        let error = Lattice::around(place(), &wide, 10_000.0).unwrap_err().to_string();
        assert!(error.contains("pixels of 10000 m are larger than the surface"), "{error}");
        let none = Lattice::around(place(), &extent(&[]), 0.1).unwrap_err();
        assert!(matches!(none, SurveyError::NothingSeen), "{none}");
    }

    #[test]
    fn lengths_are_rounded_to_two_digits() {
        assert_eq!([0.04321, 0.996, 123.0, 1.0].map(two_digits), [0.043, 1.0, 120.0, 1.0]);
        assert_eq!([0.04321, 121.0, 0.05].map(two_digits_up), [0.044, 130.0, 0.05]);
    }
}
