//! What a drone's camera writes into its photographs beside the pixels.

use std::io::{self, Cursor};

use cosurf_geo::Geodetic;
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};

/// Parts into which a second of arc is divided: 0.3 mm on the ground.
const PARTS_OF_SECOND: f64 = 100_000.0;

/// The EXIF of a photograph that was taken `seconds` after the start at `place`, in the order of bytes of the TIFF format.
pub(super) fn exif(place: &Geodetic, focal_mm: f64, seconds: u32) -> io::Result<Vec<u8>> {
    let text = |tag, text: &str| field(tag, Value::Ascii(vec![text.as_bytes().to_vec()]));
    let numbers = |tag, of: Vec<Rational>| field(tag, Value::Rational(of));
    let hemisphere = |is_positive: bool, [positive, negative]: [&'static str; 2]| {
        if is_positive { positive } else { negative }
    };
    let (latitude, longitude) = (place.latitude_deg, place.longitude_deg);
    let fields = [
        text(Tag::Make, "cosurf"),
        text(Tag::Model, "town"),
        field(Tag::Orientation, Value::Short(vec![1])),
        text(
            Tag::DateTimeOriginal,
            &format!("2026:06:01 {:02}:{:02}:{:02}", 10 + seconds / 3600, seconds / 60 % 60, seconds % 60),
        ),
        numbers(Tag::FocalLength, vec![rational(focal_mm, 1000.0)]),
        field(Tag::GPSVersionID, Value::Byte(vec![2, 3, 0, 0])),
        text(Tag::GPSLatitudeRef, hemisphere(latitude >= 0.0, ["N", "S"])),
        numbers(Tag::GPSLatitude, degrees(latitude)),
        text(Tag::GPSLongitudeRef, hemisphere(longitude >= 0.0, ["E", "W"])),
        numbers(Tag::GPSLongitude, degrees(longitude)),
        field(Tag::GPSAltitudeRef, Value::Byte(vec![u8::from(place.height_m < 0.0)])),
        numbers(Tag::GPSAltitude, vec![rational(place.height_m.abs(), 1000.0)]),
        text(Tag::GPSMapDatum, "WGS-84"),
    ];
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut bytes = Cursor::new(Vec::new());
    writer.write(&mut bytes, false).map_err(io::Error::other)?;
    Ok(bytes.into_inner())
}

fn field(tag: Tag, value: Value) -> Field {
    Field { tag, ifd_num: In::PRIMARY, value }
}

fn rational(value: f64, denom: f64) -> Rational {
    Rational { num: (value * denom).round() as u32, denom: denom as u32 }
}

/// Degrees, minutes and seconds.
fn degrees(degrees: f64) -> Vec<Rational> {
    let parts = (degrees.abs() * 3600.0 * PARTS_OF_SECOND).round() as u64;
    let per_minute = (60.0 * PARTS_OF_SECOND) as u64;
    let minutes = parts / per_minute;
    let seconds = Rational { num: (parts % per_minute) as u32, denom: PARTS_OF_SECOND as u32 };
    let whole = |num: u64| Rational { num: num as u32, denom: 1 };
    vec![whole(minutes / 60), whole(minutes % 60), seconds]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn places_are_read_back() {
        let place = Geodetic { latitude_deg: -33.912_345_6, longitude_deg: 18.423_456_7, height_m: 123.456 };
        let bytes = exif(&place, 8.8, 3_725).unwrap();
        let read = exif::Reader::new().read_raw(bytes).unwrap();
        let value = |tag| read.get_field(tag, In::PRIMARY).unwrap().display_value().to_string();
        assert_eq!(value(Tag::GPSLatitudeRef), "S");
        assert_eq!(value(Tag::DateTimeOriginal), "2026-06-01 11:02:05");
        let angle = |tag| match &read.get_field(tag, In::PRIMARY).unwrap().value {
            Value::Rational(of) => of[0].to_f64() + of[1].to_f64() / 60.0 + of[2].to_f64() / 3600.0,
            other => panic!("{other:?}"),
        };
        assert!((angle(Tag::GPSLatitude) - 33.912_345_6).abs() < 2e-9);
        assert!((angle(Tag::GPSLongitude) - 18.423_456_7).abs() < 2e-9);
        assert_eq!(value(Tag::GPSAltitude), "123.456");
    }
}
