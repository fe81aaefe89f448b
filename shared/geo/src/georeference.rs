//! `geo.json`: where on the earth a dataset or a model lies, and how well that is known.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::ellipsoid::Geodetic;
use crate::error::GeoError;
use crate::projection::Projection;
use crate::site::SiteFrame;

/// Where a dataset or a model lies whose world is ENU about an origin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Georeference {
    /// The origin of the site.
    pub origin: Geodetic,
    /// EPSG number of the coordinate system of what is delivered.
    pub epsg: u32,
    /// How well the place is known.
    #[serde(flatten)]
    pub residuals: Residuals,
    /// Of a model that was merged from several: how well the place of each is known. `residuals` is then empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub drones: Vec<DroneResiduals>,
}

/// How well a place is known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Residuals {
    /// How well the photographs' GPS agrees with their poses; absent if the place does not come from GPS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gps: Option<GpsResiduals>,
    /// The points on the ground that the place was fitted to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub control: Vec<PointResidual>,
    /// How well the frame is known; absent if it was not fitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uncertainty: Option<FitUncertainty>,
    /// Points on the ground that were held out, to tell how accurate the rest is.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub check: Vec<PointResidual>,
}

/// How well the place of one of several merged models is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DroneResiduals {
    /// The folder that the model came from.
    pub name: String,
    /// How well its place is known.
    #[serde(flatten)]
    pub residuals: Residuals,
}

/// How well the GPS of photographs agrees with their poses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GpsResiduals {
    /// Number of photographs with a pose and GPS.
    pub photographs: usize,
    /// Number of these whose receiver told how accurate its place is.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub with_accuracy: usize,
    /// Number of photographs with a pose and GPS that agree with most of the others.
    pub agreeing: usize,
    /// Root mean square of the horizontal differences of those that agree, metres.
    pub horizontal_rms_m: f64,
    /// Root mean square of the differences of height of those that agree, metres.
    pub vertical_rms_m: f64,
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

/// How well a fitted frame is known: standard deviations that follow from the residuals.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FitUncertainty {
    /// Of the direction of up, degrees.
    pub tilt_deg: f64,
    /// Of the direction of north, degrees.
    pub heading_deg: f64,
    /// Of lengths, as a share of the length.
    pub scale_share: f64,
    /// Of east and north of the middle of the dataset, metres.
    pub horizontal_m: f64,
    /// Of the height of the middle of the dataset, metres.
    pub vertical_m: f64,
}

/// A point on the ground that was measured, and where the photographs show it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointResidual {
    /// Its name.
    pub name: String,
    /// Number of photographs in which it was marked.
    pub photographs: usize,
    /// Where the photographs show it, minus where it was measured: east, north, up, metres.
    pub residual_m: [f64; 3],
}

impl PointResidual {
    /// Root mean square of the residuals: east, north, up, metres. Not a number without points.
    pub fn rms_m(points: &[Self]) -> [f64; 3] {
        [0, 1, 2].map(|axis| {
            let squares = points.iter().map(|point| point.residual_m[axis].powi(2));
            (squares.sum::<f64>() / points.len() as f64).sqrt()
        })
    }
}

impl Georeference {
    /// Name of the file in the folder of a dataset or a model.
    pub const FILE: &str = "geo.json";

    /// A place without any statement of its accuracy, in the UTM zone of the origin.
    pub fn at(origin: Geodetic) -> Result<Self, GeoError> {
        origin.check()?;
        let epsg = Projection::utm_of(&origin).epsg();
        Ok(Self { origin, epsg, residuals: Residuals::default(), drones: Vec::new() })
    }

    /// Moves what tells how well the place is known from `self`: one entry called `name`, or those of the models that it was
    /// merged from, or none if nothing is known.
    pub fn take_residuals(&mut self, name: &str) -> Vec<DroneResiduals> {
        let mut all = std::mem::take(&mut self.drones);
        all.iter_mut().for_each(|drone| drone.name = format!("{name}/{}", drone.name));
        let residuals = std::mem::take(&mut self.residuals);
        if residuals != Residuals::default() {
            all.push(DroneResiduals { name: name.into(), residuals });
        }
        all
    }

    /// The georeference in a folder; `None` if it has none. Other programs write other files of this name: one without
    /// `origin` is none.
    pub fn of_folder(folder: &Path) -> Result<Option<Self>, GeoError> {
        let path = folder.join(Self::FILE);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = read_bytes(&path)?;
        let is_foreign = serde_json::from_slice(&bytes)
            .is_ok_and(|fields: serde_json::Map<String, serde_json::Value>| !fields.contains_key("origin"));
        if is_foreign { Ok(None) } else { Self::parse(&path, &bytes).map(Some) }
    }

    /// Reads and checks a file.
    pub fn read(path: &Path) -> Result<Self, GeoError> {
        Self::parse(path, &read_bytes(path)?)
    }

    fn parse(path: &Path, bytes: &[u8]) -> Result<Self, GeoError> {
        let malformed = |cause| GeoError::Malformed { path: path.into(), cause };
        let its: Self = serde_json::from_slice(bytes).map_err(malformed)?;
        its.origin.check()?;
        Projection::new(its.epsg)?;
        Ok(its)
    }

    /// The content of the file.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("numbers and texts") + "\n"
    }

    /// The frame of the site.
    pub fn site(&self) -> Result<SiteFrame, GeoError> {
        SiteFrame::new(self.origin)
    }

    /// The coordinate system of what is delivered.
    pub fn projection(&self) -> Result<Projection, GeoError> {
        Projection::new(self.epsg)
    }
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, GeoError> {
    fs::read(path).map_err(|cause| GeoError::Io { path: path.into(), cause })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn example() -> Georeference {
        let origin = Geodetic { latitude_deg: 30.1712, longitude_deg: -98.0897, height_m: 301.5 };
        let residual = PointResidual { name: "A".into(), photographs: 3, residual_m: [0.01, -0.02, 0.05] };
        let gps = GpsResiduals {
            photographs: 75,
            with_accuracy: 0,
            agreeing: 70,
            horizontal_rms_m: 2.5,
            vertical_rms_m: 4.0,
        };
        let residuals = Residuals { gps: Some(gps), control: vec![residual], ..Residuals::default() };
        let drones = vec![DroneResiduals { name: "east".into(), residuals: residuals.clone() }];
        Georeference { residuals, drones, ..Georeference::at(origin).unwrap() }
    }

    #[test]
    fn files_survive_the_way_to_the_disk_and_back() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Georeference::of_folder(folder.path()).unwrap(), None);
        fs::write(folder.path().join(Georeference::FILE), example().to_json()).unwrap();
        assert_eq!(Georeference::of_folder(folder.path()).unwrap(), Some(example()));
        let json: serde_json::Value = serde_json::from_str(&example().to_json()).unwrap();
        assert_eq!(
            json["gps"].get("with_accuracy"),
            None,
            "a file as before if no receiver told its accuracy"
        );
        let agreeing = [&json, &json["drones"][0]].map(|its| its["gps"]["agreeing"].as_u64());
        assert_eq!(agreeing, [Some(70); 2], "the residuals stand beside the place and the name");
        let foreign = r#"{"origin_lat": 30.1712, "origin_lon": -98.0897, "scale": 11.3}"#;
        fs::write(folder.path().join(Georeference::FILE), foreign).unwrap();
        assert_eq!(Georeference::of_folder(folder.path()).unwrap(), None, "a file of another program");
        fs::write(folder.path().join(Georeference::FILE), "{\"origin\": 3}").unwrap();
        assert!(Georeference::of_folder(folder.path()).is_err());
    }

    #[test]
    fn wrong_files_are_refused_with_their_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(Georeference::FILE);
        let text = example().to_json();
        for (wrong, told) in [
            ("{}".to_string(), "geo.json is not a georeference: missing field"),
            (text.replace("30.1712", "130.0"), "no place on the earth"),
            (text.replace("32614", "4326"), "EPSG:4326"),
        ] {
            fs::write(&path, &wrong).unwrap();
            let error = Georeference::read(&path).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
        fs::remove_file(&path).unwrap();
        assert!(Georeference::read(&path).unwrap_err().to_string().contains("geo.json"));
    }
}
