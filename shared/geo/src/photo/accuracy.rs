//! How accurate a receiver says that its place is.

/// Largest standard deviation that a receiver may tell, metres; larger numbers are damage.
const SIGMA_M_MAX: f64 = 1000.0;
/// Heights of satellite positioning are about twice as uncertain as places: most satellites are on the sides.
const VERTICAL_PER_HORIZONTAL: f64 = 2.0;
/// `RtkFlag` of a fixed solution, which DJI calls accurate to centimetres.
const FIXED: u32 = 50;
/// Least `RtkFlag` of a floating solution, which DJI calls accurate to decimetres or metres.
const FLOATING: u32 = 32;
/// Least standard deviation that a place with a floating solution is believed to have, metres.
const FLOATING_SIGMA_M: f64 = 0.3;
/// The same for a place without a solution of RTK, which DJI calls accurate to metres.
const SINGLE_SIGMA_M: f64 = 2.0;

/// Standard deviations of a place, as its receiver tells them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GpsAccuracy {
    /// In each of east and north, metres, above 0.
    pub horizontal_m: f64,
    /// Of the height, metres, above 0.
    pub vertical_m: f64,
}

impl GpsAccuracy {
    /// Without a vertical one, it follows from the horizontal one. `None` if the horizontal one is no standard deviation.
    pub(super) fn new(horizontal_m: f64, vertical_m: Option<f64>) -> Option<Self> {
        let is_sigma = |sigma_m: &f64| *sigma_m > 0.0 && *sigma_m <= SIGMA_M_MAX;
        let vertical_m = vertical_m.filter(is_sigma).unwrap_or(VERTICAL_PER_HORIZONTAL * horizontal_m);
        is_sigma(&horizontal_m).then_some(Self { horizontal_m, vertical_m })
    }

    /// That of DJI's RTK: the kind of the solution, and what the receiver tells. Only a fixed solution is believed as told.
    /// `None` if a fixed solution tells nothing.
    ///
    /// Source: user manual of DJI Mavic 3E/3T, *Photo metadata*: `RtkFlag` is 0 without a solution, 16 for a single point,
    /// 32 to 49 for a floating and 50 for a fixed solution.
    pub(super) fn of_rtk(flag: u32, told: Option<Self>) -> Option<Self> {
        let least_m = match flag {
            FIXED => return told,
            FLOATING..FIXED => FLOATING_SIGMA_M,
            _ => SINGLE_SIGMA_M,
        };
        let least = Self { horizontal_m: least_m, vertical_m: VERTICAL_PER_HORIZONTAL * least_m };
        Some(told.map_or(least, |told| Self {
            horizontal_m: told.horizontal_m.max(least.horizontal_m),
            vertical_m: told.vertical_m.max(least.vertical_m),
        }))
    }
}
