//! Places that GPS tells, and whether two lists of them are of one site.

use std::collections::BTreeSet;

use cosurf_geo::{Geodetic, Gps, SiteFrame};

/// A place farther than this from another one is of another site, metres. The neighbouring zone of a map is more than a
/// hundred kilometres away.
pub(super) const ELSEWHERE_M: f64 = 10_000.0;

/// Names that are told of many.
const TOLD_MAX: usize = 3;

/// A place; at height 0 if it has none.
pub(super) fn geodetic(gps: &Gps) -> Geodetic {
    let Gps { latitude_deg, longitude_deg, height_m, .. } = *gps;
    Geodetic { latitude_deg, longitude_deg, height_m: height_m.unwrap_or(0.0) }
}

/// How far apart two places are, metres.
pub(super) fn apart_m(a: &Gps, b: &Gps) -> f64 {
    let site = SiteFrame::new(geodetic(a)).ok();
    site.map_or(0.0, |site| site.enu_from_geodetic(&geodetic(b)).truncate().length())
}

/// What is told if `geo.txt` puts photographs far from the GPS in their EXIF: so many metres.
pub(super) fn list_elsewhere(mut off_m: Vec<f64>) -> Option<(String, String)> {
    off_m.sort_by(f64::total_cmp);
    let middle_m = *off_m.get(off_m.len() / 2)?;
    let reason = || {
        format!(
            "puts photographs {:.0} km from the GPS in their EXIF; if that is not wrong, check the coordinate system in the first \
             line, and that each line has x before y",
            middle_m / 1000.0
        )
    };
    (middle_m > ELSEWHERE_M).then(|| ("geo.txt".to_owned(), reason()))
}

/// A few names of many, in their order, for a line.
pub(super) fn a_few<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: BTreeSet<&str> = names.collect();
    let more = if names.len() > TOLD_MAX { ", …" } else { "" };
    let told: Vec<&str> = names.into_iter().take(TOLD_MAX).collect();
    format!("{}{more}", told.join(", "))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_list_of_places_in_another_zone_is_told() {
        let at = |longitude_deg| Gps { latitude_deg: 53.0, longitude_deg, height_m: None, accuracy: None };
        let off_m = |longitude_deg| apart_m(&at(16.0), &at(longitude_deg));
        assert_eq!(list_elsewhere(vec![off_m(16.1), off_m(16.1), off_m(22.0)]), None, "one is wrong");
        let told = list_elsewhere(vec![off_m(22.0); 3]).unwrap().1;
        assert!(told.starts_with("puts photographs 402 km from the GPS"), "{told}");
        assert_eq!(list_elsewhere(Vec::new()), None);
    }
}
