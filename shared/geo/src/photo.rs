//! What the EXIF of a photograph tells: where it was taken, and with which camera.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use exif::{Exif, In, Reader, Tag, Value};

use crate::error::GeoError;

/// EXIF lies at the beginning of a file; more is never read, bytes.
const HEAD_BYTES_MAX: u64 = 1 << 20;
/// Longest name of a camera that is kept, characters.
const NAME_CHARS_MAX: usize = 100;

/// Where GPS says that a photograph was taken, WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gps {
    /// Degrees north, -90..=90.
    pub latitude_deg: f64,
    /// Degrees east, -180..=180.
    pub longitude_deg: f64,
    /// Metres above whatever the receiver counts from, often mean sea level; `None` if not told.
    pub height_m: Option<f64>,
}

/// What the EXIF of a photograph tells; nothing if there is no EXIF, or if it is damaged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoInfo {
    /// Where it was taken.
    pub gps: Option<Gps>,
    /// Maker, model and focal length of the camera; photographs with the same have the same lens.
    pub camera: String,
}

impl PhotoInfo {
    /// Reads the beginning of a photograph. An error only if the file cannot be read.
    pub fn read(path: &Path) -> Result<Self, GeoError> {
        let failed = |cause| GeoError::Io { path: path.into(), cause };
        let mut head = Vec::new();
        File::open(path).map_err(failed)?.take(HEAD_BYTES_MAX).read_to_end(&mut head).map_err(failed)?;
        let exif = Reader::new().continue_on_error(true).read_from_container(&mut Cursor::new(head));
        let exif = exif.or_else(|error| error.distill_partial_result(|_| {}));
        Ok(exif.map(|exif| Self { gps: gps(&exif), camera: camera(&exif) }).unwrap_or_default())
    }
}

fn gps(exif: &Exif) -> Option<Gps> {
    let latitude_deg = signed_deg(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S')?;
    let longitude_deg = signed_deg(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W')?;
    // Receivers without a fix write zeros.
    let is_place = latitude_deg.abs() <= 90.0
        && longitude_deg.abs() <= 180.0
        && (latitude_deg, longitude_deg) != (0.0, 0.0);
    is_place.then(|| Gps { latitude_deg, longitude_deg, height_m: height_m(exif) })
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
    let height_m = if reference == Some(1) { -height_m } else { height_m };
    (height_m.abs() < 12_000.0).then_some(height_m)
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
mod tests {
    #![allow(clippy::unwrap_used)]
    use exif::experimental::Writer;
    use exif::{Field, Rational};

    use super::*;

    fn field(tag: Tag, value: Value) -> Field {
        Field { tag, ifd_num: In::PRIMARY, value }
    }

    fn degrees(parts: [(u32, u32); 3]) -> Value {
        Value::Rational(parts.map(|(num, denom)| Rational { num, denom }).to_vec())
    }

    fn example() -> Vec<Field> {
        vec![
            field(Tag::Model, Value::Ascii(vec![b"FC330".to_vec()])),
            field(Tag::GPSLatitudeRef, Value::Ascii(vec![b"S".to_vec()])),
            field(Tag::GPSLatitude, degrees([(33, 1), (30, 1), (1800, 100)])),
            field(Tag::GPSLongitudeRef, Value::Ascii(vec![b"E".to_vec()])),
            field(Tag::GPSLongitude, degrees([(18, 1), (15, 1), (0, 1)])),
            field(Tag::GPSAltitudeRef, Value::Byte(vec![1])),
            field(Tag::GPSAltitude, Value::Rational(vec![Rational { num: 25, denom: 10 }])),
        ]
    }

    /// EXIF as it lies in a file, in big-endian order.
    fn tiff(fields: &[Field]) -> Vec<u8> {
        let mut writer = Writer::new();
        fields.iter().for_each(|field| writer.push_field(field));
        let mut tiff = Cursor::new(Vec::new());
        writer.write(&mut tiff, false).unwrap();
        tiff.into_inner()
    }

    /// The beginning of a JPEG file, up to the end of its EXIF.
    fn jpeg(tiff: &[u8]) -> Vec<u8> {
        let length = u16::try_from(tiff.len() + 8).unwrap().to_be_bytes();
        [&[0xFF, 0xD8, 0xFF, 0xE1], &length[..], b"Exif\0\0", tiff].concat()
    }

    /// Of a file that ends after its EXIF.
    fn info(fields: &[Field]) -> PhotoInfo {
        read(&jpeg(&tiff(fields)))
    }

    fn read(bytes: &[u8]) -> PhotoInfo {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.JPG");
        std::fs::write(&path, bytes).unwrap();
        PhotoInfo::read(&path).unwrap()
    }

    #[test]
    fn south_and_below_the_sea_are_negative() {
        let its = info(&example());
        let gps = its.gps.unwrap();
        assert!(
            (gps.latitude_deg + 33.505).abs() < 1e-12 && (gps.longitude_deg - 18.25).abs() < 1e-12,
            "{gps:?}"
        );
        assert_eq!(gps.height_m, Some(-2.5));
        assert_eq!(its.camera, "FC330");
    }

    #[test]
    fn damaged_or_missing_gps_is_no_gps() {
        let with = |at: usize, value| {
            let mut fields = example();
            fields[at].value = value;
            info(&fields).gps
        };
        assert_eq!(with(2, degrees([(33, 0), (0, 1), (0, 1)])), None, "division by zero");
        assert_eq!(with(2, degrees([(133, 1), (0, 1), (0, 1)])), None, "no latitude");
        assert_eq!(with(2, Value::Ascii(vec![b"33".to_vec()])), None);
        assert_eq!(with(6, Value::Rational(vec![Rational { num: 1, denom: 0 }])).unwrap().height_m, None);
        let mut zero = example();
        zero[2].value = degrees([(0, 1); 3]);
        zero[4].value = degrees([(0, 1); 3]);
        assert_eq!(info(&zero).gps, None, "a receiver without a fix");
        for bytes in [&b""[..], b"\xFF\xD8\xFF\xE1\xFF\xFFExif\0\0MM", b"no picture", &[0; 5000]] {
            assert_eq!(read(bytes), PhotoInfo::default());
        }
    }

    #[test]
    fn lengths_that_exif_claims_are_not_believed() {
        let mut bytes = tiff(&example());
        let first = u32::from_be_bytes(bytes[4..8].try_into().unwrap()) as usize;
        let fields = usize::from(u16::from_be_bytes(bytes[first..first + 2].try_into().unwrap()));
        for field in 0..fields {
            let count = first + 2 + 12 * field + 4;
            bytes[count..count + 4].copy_from_slice(&0xFFFF_FFF0u32.to_be_bytes());
        }
        assert_eq!(read(&jpeg(&bytes)).gps, None);
    }

    #[test]
    fn of_a_large_file_only_the_beginning_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.JPG");
        std::fs::write(&path, jpeg(&tiff(&example()))).unwrap();
        // A gigabyte, of which the disk holds nothing.
        File::options().write(true).open(&path).unwrap().set_len(1 << 30).unwrap();
        assert!(PhotoInfo::read(&path).unwrap().gps.is_some());
    }
}
