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
    [&[0xFF, 0xD8][..], &app1(b"Exif\0\0", tiff)].concat()
}

fn app1(signature: &[u8], content: &[u8]) -> Vec<u8> {
    let length = u16::try_from(signature.len() + content.len() + 2).unwrap().to_be_bytes();
    [&[0xFF, 0xE1], &length[..], signature, content].concat()
}

/// The beginning of a JPEG file with EXIF, and with attributes of DJI in XMP.
fn with_xmp(fields: &[Field], attributes: &str) -> PhotoInfo {
    let packet = format!(
        r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
        <rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>"#
    );
    let xmp = app1(b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes());
    read(&[jpeg(&tiff(fields)), xmp].concat())
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

const RTK: &str = r#"drone-dji:GpsLatitude="+53.5" drone-dji:GpsLongitude="+16.25" drone-dji:AbsoluteAltitude="+120.5"
    drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="0.014" drone-dji:RtkStdHgt="0.03""#;

#[test]
fn xmp_tells_the_accuracy_and_only_an_absent_place() {
    let both = with_xmp(&example(), RTK);
    let gps = both.gps.unwrap();
    assert!((gps.latitude_deg + 33.505).abs() < 1e-12 && both.has_exif_gps, "EXIF counts: {gps:?}");
    assert_eq!(gps.accuracy, Some(GpsAccuracy { horizontal_m: 0.014, vertical_m: 0.03 }));
    let only_xmp = with_xmp(&example()[..1], RTK);
    let gps = only_xmp.gps.unwrap();
    assert_eq!((gps.latitude_deg, gps.longitude_deg, gps.height_m), (53.5, 16.25, Some(120.5)));
    assert!(!only_xmp.has_exif_gps && gps.accuracy.is_some());
    assert_eq!(info(&example()).gps.unwrap().accuracy, None);
}

#[test]
fn exif_tells_a_horizontal_error() {
    let with = |num, denom| {
        let error = field(Tag::GPSHPositioningError, Value::Rational(vec![Rational { num, denom }]));
        [example(), vec![error]].concat()
    };
    let accuracy = |fields: &[Field]| info(fields).gps.unwrap().accuracy;
    assert_eq!(accuracy(&with(25, 10)), Some(GpsAccuracy { horizontal_m: 2.5, vertical_m: 5.0 }));
    for (num, denom) in [(0, 1), (1, 0), (0, 0), (u32::MAX, 1)] {
        assert_eq!(accuracy(&with(num, denom)), None, "{num}/{denom}");
    }
    let gps = with_xmp(&with(25, 10), RTK).gps.unwrap();
    assert_eq!(gps.accuracy.unwrap().horizontal_m, 0.014, "RTK tells more than EXIF");
}
