//! Pairs of photographs that may show the same ground, where COLMAP cannot find them by EXIF alone.

use std::collections::BTreeSet;

use glam::DVec2;

use super::photographs::Photograph;

/// Neighbours of each photograph by GPS. COLMAP's documentation takes 50; 16 are the eight around it in a grid, twice.
pub(super) const NEIGHBOURS: usize = 16;
/// Photographs that follow one in the order of names, and are matched with it whatever GPS says.
const FOLLOWING: usize = 4;
/// Metres of a degree of latitude, near enough for finding neighbours.
const METRES_PER_DEGREE: f64 = 111_320.0;

/// The pairs, as lines of two names for COLMAP's `matches_importer`.
pub(super) fn pairs(photographs: &[Photograph]) -> String {
    let places: Vec<Option<DVec2>> = photographs
        .iter()
        .map(|photograph| {
            let gps = photograph.gps?;
            let east = gps.longitude_deg * gps.latitude_deg.to_radians().cos();
            Some(DVec2::new(east, gps.latitude_deg) * METRES_PER_DEGREE)
        })
        .collect();
    let mut pairs = BTreeSet::new();
    for a in 0..photographs.len() {
        let following = a + 1..(a + 1 + FOLLOWING).min(photographs.len());
        pairs.extend(following.chain(neighbours(&places, a)).map(|b| (a.min(b), a.max(b))));
    }
    let name = |i: usize| &photographs[i].name;
    pairs.into_iter().map(|(a, b)| format!("{} {}\n", name(a), name(b))).collect()
}

fn neighbours(places: &[Option<DVec2>], of: usize) -> Vec<usize> {
    let Some(here) = places[of] else { return Vec::new() };
    let others = places.iter().enumerate().filter(|(i, _)| *i != of);
    let mut others: Vec<(f64, usize)> =
        others.filter_map(|(i, place)| Some((place.as_ref()?.distance_squared(here), i))).collect();
    if others.len() > NEIGHBOURS {
        others.select_nth_unstable_by(NEIGHBOURS, |a, b| a.0.total_cmp(&b.0));
        others.truncate(NEIGHBOURS);
    }
    others.into_iter().map(|(_, i)| i).collect()
}

#[cfg(test)]
mod tests {
    use cosurf_geo::Gps;

    use super::*;

    #[test]
    fn photographs_are_paired_with_near_and_following_ones() {
        let photograph = |i: usize| Photograph {
            name: format!("{i:03}.jpg"),
            size_px: [4, 3],
            camera: String::new(),
            // Two lines to and fro, and one photograph without GPS.
            gps: (i != 50).then(|| Gps {
                latitude_deg: 53.0 + 0.0001 * (if i < 30 { i } else { 59 - i.min(59) }) as f64,
                longitude_deg: 16.5 + if i < 30 { 0.0 } else { 0.0003 },
                height_m: None,
                accuracy: None,
            }),
            has_exif_gps: false,
            is_listed: false,
            state: [0; 2],
            mask: None,
        };
        let photographs: Vec<_> = (0..60).map(photograph).collect();
        let pairs = pairs(&photographs);
        for pair in ["000.jpg 001.jpg\n", "000.jpg 059.jpg\n", "049.jpg 050.jpg\n", "050.jpg 054.jpg\n"] {
            assert!(pairs.contains(pair), "{pair}");
        }
        assert!(!pairs.contains("000.jpg 030.jpg"), "the other end of the flight");
        assert!(pairs.lines().count() <= 60 * (NEIGHBOURS + FOLLOWING));
    }
}
