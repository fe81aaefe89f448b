//! Heights of lists that are above a geoid become heights above the ellipsoid, which the frame of a site has.
//!
//! What it knows nothing about: EXIF and XMP; their heights stay what the receiver says.

use std::path::Path;

use cosurf_geo::{GeoError, Geodetic, Geoid};

use super::photographs::Photographs;

/// Adds the geoid's undulation to the heights of `gcp_list.txt` and `geo.txt`.
pub(super) fn raise(photographs: &mut Photographs, grid: &Path) -> Result<(), GeoError> {
    let control = photographs.control.iter_mut().map(|point| {
        let Geodetic { latitude_deg, longitude_deg, .. } = point.place;
        (latitude_deg, longitude_deg, &mut point.place.height_m)
    });
    let listed = photographs.usable.iter_mut().filter(|photograph| photograph.is_listed);
    let listed = listed.filter_map(|photograph| photograph.gps.as_mut());
    let listed = listed.filter_map(|gps| Some((gps.latitude_deg, gps.longitude_deg, gps.height_m.as_mut()?)));
    let mut geoid = None;
    for (latitude_deg, longitude_deg, height_m) in control.chain(listed) {
        let place = Geodetic { latitude_deg, longitude_deg, height_m: *height_m };
        let geoid = match &mut geoid {
            Some(known) => known,
            none => none.insert(Geoid::read(grid, &place)?),
        };
        *height_m += geoid.undulation_m(&place)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use cosurf_scene::Picture;

    use super::*;

    #[test]
    fn heights_of_lists_are_raised_by_the_undulation() {
        let folder = tempfile::tempdir().unwrap();
        for i in 0..3 {
            Picture::new([8, 6], vec![9 * i as u8; 144])
                .write_jpeg(&folder.path().join(format!("{i}.jpg")), 90)
                .unwrap();
        }
        let at = |name: &str| folder.path().join(name);
        fs::write(at("geo.txt"), "EPSG:4326\n0.jpg 16.25 53.25 100\n1.jpg 16.25 53.25\n").unwrap();
        fs::write(at("gcp_list.txt"), "EPSG:4326\n16.5 53.5 70 1 2 0.jpg gate\n").unwrap();
        // Four values about the site, from the south-west: 30, 32, 34 and 36 m.
        let mut grid = Vec::new();
        [53.0, 16.0, 1.0, 1.0].iter().for_each(|number| grid.extend(f64::to_be_bytes(*number)));
        [2_u32, 2].iter().for_each(|count| grid.extend(count.to_be_bytes()));
        [30.0, 32.0, 34.0, 36.0].iter().for_each(|value| grid.extend(f32::to_be_bytes(*value)));
        fs::write(at("geoid.gtx"), grid).unwrap();
        let mut photographs = Photographs::read(folder.path()).unwrap();
        raise(&mut photographs, &at("geoid.gtx")).unwrap();
        assert_eq!(photographs.control[0].place.height_m, 103.0);
        let heights: Vec<_> =
            photographs.usable.iter().map(|its| its.gps.and_then(|gps| gps.height_m)).collect();
        assert_eq!(heights, [Some(131.5), None, None]);
        let error = raise(&mut photographs, &at("absent.gtx")).unwrap_err().to_string();
        assert!(error.contains("absent.gtx"), "{error}");
    }
}
