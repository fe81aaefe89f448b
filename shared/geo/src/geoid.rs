//! Heights above a geoid, which surveyors write as heights above the sea: the height above the ellipsoid minus the geoid's
//! *undulation* there, which a grid tells.
//!
//! Grids are those of PROJ: GeoTIFF (PROJ's specification "Geodetic TIFF grids", GTG) and `.gtx` (NOAA). Between the grid's
//! values it interpolates bilinearly, as PROJ's `vgridshift` does. Only the surroundings of a site are read.
//!
//! What it knows nothing about: which geoid a country uses.

mod geotiff;
mod gtx;
mod raster;

use std::path::{Path, PathBuf};

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;
use raster::{Raster, Window};

/// How far around a site a grid is read, degrees: at least 10 km wherever drones fly.
const REACH_DEG: f64 = 0.5;
/// EPSG numbers of heights by grids that do not tell them.
const KNOWN: [(&str, u16); 2] = [("egm96_15.gtx", 5773), ("egm08_25.gtx", 3855)];

/// A geoid about a site.
#[derive(Debug)]
pub struct Geoid {
    path: PathBuf,
    vertical_epsg: Option<u16>,
    window: Window,
}

impl Geoid {
    /// Reads the surroundings of a place from a grid. An error if the file is no grid of undulations, or does not cover the
    /// place.
    pub fn read(path: &Path, around: &Geodetic) -> Result<Self, GeoError> {
        around.check()?;
        let is = |end: &str| path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(end));
        let (raster, told): (Box<dyn Raster>, _) = match () {
            () if is("gtx") => (Box::new(gtx::Gtx::open(path)?), None),
            () if is("tif") || is("tiff") => {
                let grid = geotiff::Grid::open(path, around)?;
                let told = grid.vertical_epsg();
                (Box::new(grid), told)
            }
            () => {
                return Err(GeoError::refused(
                    path,
                    "is no grid of a geoid by its name; give a .tif of PROJ or a .gtx file",
                ));
            }
        };
        let window =
            Window::read(raster, around, REACH_DEG).map_err(|reason| GeoError::refused(path, &reason))?;
        let known = || KNOWN.iter().find(|(name, _)| path.ends_with(name)).map(|(_, epsg)| *epsg);
        Ok(Self { path: path.into(), vertical_epsg: told.or_else(known), window })
    }

    /// How high the geoid lies above the ellipsoid, metres. An error if the grid has no value there.
    pub fn undulation_m(&self, place: &Geodetic) -> Result<f64, GeoError> {
        let found = self.window.value(place.longitude_deg, place.latitude_deg);
        found.ok_or_else(|| {
            let Geodetic { latitude_deg, longitude_deg, .. } = place;
            let reason = format!(
                "has no value at latitude {latitude_deg:.5}°, longitude {longitude_deg:.5}°, or that is more than {REACH_DEG}° from the site; give a grid that covers the site"
            );
            GeoError::refused(&self.path, &reason)
        })
    }

    /// EPSG number of the heights above this geoid, if the grid tells it.
    pub fn vertical_epsg(&self) -> Option<u16> {
        self.vertical_epsg
    }

    /// What heights above this geoid are, in words.
    pub fn heights(&self) -> String {
        let number = self.vertical_epsg.map_or(String::new(), |epsg| format!(", EPSG:{epsg}"));
        format!("metres above the geoid of {}{number}", self.name())
    }

    /// The vertical coordinate system as well-known text (WKT 1), for files that want it.
    pub fn wkt(&self) -> String {
        let name: String = self.name().chars().filter(|c| c.is_ascii_graphic() && *c != '"').collect();
        let authority =
            self.vertical_epsg.map_or(String::new(), |epsg| format!(r#",AUTHORITY["EPSG","{epsg}"]"#));
        format!(
            r#"VERT_CS["height above the geoid of {name}",VERT_DATUM["geoid of {name}",2005],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]{authority}]"#
        )
    }

    fn name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

#[cfg(test)]
mod tests;
