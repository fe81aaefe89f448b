//! What the EXIF and the XMP of a photograph tell: where it was taken, how accurate that is, and with which camera.

mod accuracy;
mod place;
mod xmp;

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use exif::{Exif, In, Reader, Tag, Value};

use crate::error::GeoError;
pub use accuracy::GpsAccuracy;
pub use place::Gps;
use xmp::Xmp;

/// EXIF and XMP lie at the beginning of a file; more is never read, bytes.
const HEAD_BYTES_MAX: u64 = 1 << 20;
/// Longest name of a camera that is kept, characters.
const NAME_CHARS_MAX: usize = 100;
/// Height above or below the sea at which no photograph of a drone is taken, metres.
const HEIGHT_M_MAX: f64 = 12_000.0;

/// What the EXIF and the XMP of a photograph tell; nothing if there are none, or if they are damaged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoInfo {
    /// Where it was taken: by EXIF, or else by XMP.
    pub gps: Option<Gps>,
    /// Whether EXIF tells the place, so that programs that read no XMP find it.
    pub has_exif_gps: bool,
    /// Maker, model and focal length of the camera; photographs with the same have the same lens.
    pub camera: String,
}

impl PhotoInfo {
    /// Reads the beginning of a photograph. An error only if the file cannot be read.
    pub fn read(path: &Path) -> Result<Self, GeoError> {
        let failed = |cause| GeoError::Io { path: path.into(), cause };
        let mut head = Vec::new();
        File::open(path).map_err(failed)?.take(HEAD_BYTES_MAX).read_to_end(&mut head).map_err(failed)?;
        let xmp = Xmp::read(&head);
        let exif = Reader::new().continue_on_error(true).read_from_container(&mut Cursor::new(head));
        let exif = exif.or_else(|error| error.distill_partial_result(|_| {})).ok();
        let by_exif = exif.as_ref().and_then(gps);
        let accuracy = xmp.accuracy.or_else(|| {
            let horizontal_m = *rationals(exif.as_ref()?, Tag::GPSHPositioningError)?.first()?;
            GpsAccuracy::new(horizontal_m, None)
        });
        Ok(Self {
            gps: by_exif.or(xmp.gps).map(|gps| Gps { accuracy, ..gps }),
            has_exif_gps: by_exif.is_some(),
            camera: exif.as_ref().map(camera).unwrap_or_default(),
        })
    }
}

impl Gps {
    /// A place without an accuracy; `None` if the numbers are none of a place.
    fn new(latitude_deg: f64, longitude_deg: f64, height_m: Option<f64>) -> Option<Self> {
        // Receivers without a fix write zeros.
        let is_place = latitude_deg.abs() <= 90.0
            && longitude_deg.abs() <= 180.0
            && (latitude_deg, longitude_deg) != (0.0, 0.0);
        let height_m = height_m.filter(|height_m| height_m.abs() < HEIGHT_M_MAX);
        is_place.then_some(Self { latitude_deg, longitude_deg, height_m, accuracy: None })
    }
}

fn gps(exif: &Exif) -> Option<Gps> {
    let latitude_deg = signed_deg(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S')?;
    let longitude_deg = signed_deg(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W')?;
    Gps::new(latitude_deg, longitude_deg, height_m(exif))
}

/// Degrees, minutes and seconds as degrees; negative if the reference is `negative`.
fn signed_deg(exif: &Exif, tag: Tag, reference: Tag, negative: u8) -> Option<f64> {
    let parts = rationals(exif, tag)?;
    let degrees = parts.iter().zip([1.0, 60.0, 3600.0]).map(|(part, unit)| part / unit).sum::<f64>();
    let is_negative = match &exif.get_field(reference, In::PRIMARY)?.value {
        Value::Ascii(texts) => texts.first()?.first()?.eq_ignore_ascii_case(&negative),
        _ => return None,
    };
    Some(if is_negative { -degrees } else { degrees }).filter(|degrees| degrees.is_finite())
}

fn height_m(exif: &Exif) -> Option<f64> {
    let height_m = *rationals(exif, Tag::GPSAltitude)?.first()?;
    let reference =
        exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).and_then(|field| field.value.get_uint(0));
    // EXIF 2.3: 1 is below sea level.
    Some(if reference == Some(1) { -height_m } else { height_m })
}

/// The numbers of a field; `None` if there are none, or one is not finite.
fn rationals(exif: &Exif, tag: Tag) -> Option<Vec<f64>> {
    let Value::Rational(values) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let values: Vec<f64> = values.iter().take(3).map(exif::Rational::to_f64).collect();
    (!values.is_empty() && values.iter().all(|value| value.is_finite())).then_some(values)
}

fn camera(exif: &Exif) -> String {
    let text = |tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(texts) => Some(String::from_utf8_lossy(texts.first()?).trim().to_owned()),
        _ => None,
    };
    let focal_mm = rationals(exif, Tag::FocalLength).map(|focal| format!("{:.2} mm", focal[0]));
    let parts = [text(Tag::Make), text(Tag::Model), focal_mm];
    parts.into_iter().flatten().collect::<Vec<_>>().join(" ").chars().take(NAME_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests;
