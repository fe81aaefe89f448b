//! A grid of values over longitude and latitude, and a window of it in memory.
//!
//! What it knows nothing about: files.

use crate::ellipsoid::Geodetic;

/// Most values of a window; the finest grids of PROJ have steps of 5 seconds, of which half a degree has 360.
const VALUES_MAX: usize = 4 << 20;
/// Largest undulation of a geoid, metres; that of the earth is below 110.
const UNDULATION_MAX_M: f32 = 200.0;

/// Where the values of a grid lie.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Layout {
    /// Longitude and latitude of the north-western value, degrees.
    pub(super) corner_deg: [f64; 2],
    /// Distance of two values to the east and to the south, degrees, above 0.
    pub(super) step_deg: [f64; 2],
    /// Number of values to the east and to the south, each at least 2.
    pub(super) size: [u32; 2],
}

impl Layout {
    /// The layout, or why it cannot be one.
    pub(super) fn checked(self) -> Result<Self, String> {
        let Self { corner_deg, step_deg, size } = self;
        let is_finite = corner_deg.iter().all(|of| of.abs() <= 720.0);
        let has_steps = step_deg.iter().all(|step| (1e-5..=30.0).contains(step));
        let has_size = size.iter().all(|side| (2..=1 << 20).contains(side));
        match is_finite && has_steps && has_size {
            true => Ok(self),
            false => Err("has no grid of longitudes and latitudes".into()),
        }
    }

    /// Column and row of a place, with fractions. Columns begin at the one that whole turns of the earth bring nearest.
    fn at(&self, longitude_deg: f64, latitude_deg: f64) -> [f64; 2] {
        let east = (longitude_deg - self.corner_deg[0]).rem_euclid(360.0);
        // Rounding must not take the western border once around the earth.
        let east = if east > 360.0 - 1e-9 { 0.0 } else { east };
        [east / self.step_deg[0], (self.corner_deg[1] - latitude_deg) / self.step_deg[1]]
    }

    /// Whether the grid goes around the earth.
    fn is_closed(&self) -> bool {
        f64::from(self.size[0]) * self.step_deg[0] > 360.0 - 0.5 * self.step_deg[0]
    }

    /// Whether a place lies between the values.
    pub(super) fn covers(&self, place: &Geodetic) -> bool {
        let [column, row] = self.at(place.longitude_deg, place.latitude_deg);
        let [width, height] = self.size.map(|side| f64::from(side - 1));
        (self.is_closed() || column <= width) && (0.0..=height).contains(&row)
    }
}

/// Something that reads the values of a grid.
pub(super) trait Raster {
    fn layout(&self) -> Layout;

    /// The value in a column from the west and a row from the north; `None` if there is none.
    fn value(&mut self, at: [u32; 2]) -> Result<Option<f32>, String>;
}

/// The values around a place.
#[derive(Debug)]
pub(super) struct Window {
    layout: Layout,
    /// First column, which may be below 0 or beyond the last of a closed grid, and first row.
    first: [i64; 2],
    size: [usize; 2],
    /// Row by row; NaN where there is none.
    values: Vec<f32>,
}

impl Window {
    /// Reads the values at most `reach_deg` from a place.
    pub(super) fn read(
        mut raster: Box<dyn Raster>,
        place: &Geodetic,
        reach_deg: f64,
    ) -> Result<Self, String> {
        let layout = raster.layout();
        if !layout.covers(place) {
            let Geodetic { latitude_deg, longitude_deg, .. } = place;
            return Err(format!(
                "does not cover latitude {latitude_deg:.5}°, longitude {longitude_deg:.5}°; give a grid that covers the site"
            ));
        }
        let middle = layout.at(place.longitude_deg, place.latitude_deg);
        let [mut first, mut last] = [[0_i64; 2]; 2];
        for axis in 0..2 {
            let reach = reach_deg / layout.step_deg[axis] + 1.0;
            let count = i64::from(layout.size[axis]);
            first[axis] = (middle[axis] - reach).floor() as i64;
            last[axis] = (middle[axis] + reach).ceil() as i64;
            if !(axis == 0 && layout.is_closed()) {
                first[axis] = first[axis].max(0);
                last[axis] = last[axis].min(count - 1);
            }
        }
        let size = [0, 1].map(|axis| (last[axis] - first[axis] + 1) as usize);
        if size[0] * size[1] > VALUES_MAX {
            return Err("is too fine for a geoid".into());
        }
        let mut values = Vec::with_capacity(size[0] * size[1]);
        for row in first[1]..=last[1] {
            for column in first[0]..=last[0] {
                let column = column.rem_euclid(i64::from(layout.size[0]));
                let value = raster.value([column as u32, row as u32])?;
                let is_one = |value: &f32| value.abs() <= UNDULATION_MAX_M;
                values.push(value.filter(is_one).unwrap_or(f32::NAN));
            }
        }
        Ok(Self { layout, first, size, values })
    }

    /// The value at a place, bilinear between the four around it; `None` outside of the window, or beside a missing value.
    pub(super) fn value(&self, longitude_deg: f64, latitude_deg: f64) -> Option<f64> {
        let [column, row] = self.layout.at(longitude_deg, latitude_deg);
        let turn = f64::from(self.layout.size[0]);
        // In a closed grid, a place may be one turn from the window.
        let turns = if self.layout.is_closed() { [0.0, -turn, turn] } else { [0.0; 3] };
        turns
            .into_iter()
            .find_map(|turn| self.within([column + turn - self.first[0] as f64, row - self.first[1] as f64]))
    }

    fn within(&self, at: [f64; 2]) -> Option<f64> {
        let mut cell = [0; 2];
        let mut share = [0.0; 2];
        for axis in 0..2 {
            let last = self.size[axis] - 1;
            if !(0.0..=last as f64).contains(&at[axis]) {
                return None;
            }
            cell[axis] = (at[axis] as usize).min(last.saturating_sub(1));
            share[axis] = at[axis] - cell[axis] as f64;
        }
        let value = |x: usize, y: usize| f64::from(self.values[(cell[1] + y) * self.size[0] + cell[0] + x]);
        let row = |y: usize| value(0, y) * (1.0 - share[0]) + value(1, y) * share[0];
        Some(row(0) * (1.0 - share[1]) + row(1) * share[1]).filter(|value| value.is_finite())
    }
}
