#![allow(clippy::unwrap_used)]
use super::*;

/// A JPEG with this packet behind a comment and before the pixels.
fn jpeg(packet: &[u8]) -> Vec<u8> {
    let length = u16::try_from(SIGNATURE.len() + packet.len() + 2).unwrap().to_be_bytes();
    let before = [0xFF, 0xD8, 0xFF, 0xFE, 0, 4, b'h', b'i', 0xFF, 0xFF, 0xE1];
    [&before[..], &length, SIGNATURE, packet, &[0xFF, 0xDA, 0, 2]].concat()
}

fn read(packet: &str) -> Xmp {
    Xmp::read(&jpeg(packet.as_bytes()))
}

fn description(attributes: &str, elements: &str) -> String {
    format!(
        r#"<?xpacket begin="﻿" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
        <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description {attributes}
        xmlns:d="http://www.dji.com/drone-dji/1.0/" xmlns:c="http://pix4d.com/camera/1.0">{elements}</rdf:Description>
        </rdf:RDF></x:xmpmeta><?xpacket end="w"?>"#
    )
}

fn rtk(flag: &str, sigmas: [&str; 3]) -> Option<GpsAccuracy> {
    let [lon, lat, hgt] = sigmas;
    read(&description(
        &format!(r#"d:RtkFlag="{flag}" d:RtkStdLon="{lon}" d:RtkStdLat="{lat}" d:RtkStdHgt="{hgt}""#),
        "",
    ))
    .accuracy
}

fn accuracy(horizontal_m: f64, vertical_m: f64) -> Option<GpsAccuracy> {
    Some(GpsAccuracy { horizontal_m, vertical_m })
}

#[test]
fn places_are_read_from_attributes_and_from_elements() {
    let attributes = r#"d:GpsLatitude="-33.5" d:GpsLongtitude="+18.25" d:AbsoluteAltitude="1e9""#;
    let gps = read(&description(attributes, "")).gps.unwrap();
    assert_eq!((gps.latitude_deg, gps.longitude_deg, gps.height_m), (-33.5, 18.25, None), "no such height");
    let elements =
        "<d:GpsLatitude> 53.5 </d:GpsLatitude><d:GpsLongitude>16</d:GpsLongitude><d:RtkFlag>16</d:RtkFlag>";
    let its = read(&description("", elements));
    assert_eq!((its.gps.unwrap().latitude_deg, its.accuracy), (53.5, accuracy(2.0, 4.0)));
    assert_eq!(read(&description("", "").replace("drone-dji", "else")), Xmp::default());
    let foreign = description(attributes, "").replace("www.dji.com", "www.example.com");
    assert_eq!(read(&foreign), Xmp::default(), "the same names in another namespace");
}

#[test]
fn only_a_fixed_solution_is_believed_as_told() {
    let good = ["0.011", "0.014", "0.03"];
    assert_eq!(rtk("50", good), accuracy(0.014, 0.03));
    assert_eq!(rtk("34", good), accuracy(0.3, 0.6));
    assert_eq!(rtk("16", good), accuracy(2.0, 4.0));
    assert_eq!(rtk("0", good), accuracy(2.0, 4.0));
    assert_eq!(rtk("34", ["1.5", "1.2", "3.5"]), accuracy(1.5, 3.5), "worse than the least");
    let sense_fly = r#"c:GPSXYAccuracy="1.2" c:GPSZAccuracy="1.7""#;
    assert_eq!(read(&description(sense_fly, "")).accuracy, accuracy(1.2, 1.7));
}

#[test]
fn numbers_that_are_no_accuracy_change_nothing() {
    for wrong in ["nan", "inf", "-0.01", "0", "1e30", "1e999", "", "x", "0,01"] {
        assert_eq!(rtk("50", [wrong, "0.014", "0.03"]), None, "{wrong}");
        assert_eq!(rtk("50", ["0.014", wrong, "0.03"]), None, "{wrong}");
        assert_eq!(rtk("50", ["0.014", "0.011", wrong]), accuracy(0.014, 0.028), "{wrong}");
        assert_eq!(
            rtk("16", [wrong; 3]),
            accuracy(2.0, 4.0),
            "the flag still says how bad the place is: {wrong}"
        );
        assert_eq!(rtk(wrong, ["0.014", "0.011", "0.03"]).is_some(), wrong == "0", "without a flag: {wrong}");
        let place = format!(r#"d:GpsLatitude="{wrong}" d:GpsLongitude="0""#);
        assert!(read(&description(&place, "")).gps.is_none_or(|gps| gps.latitude_deg == -0.01), "{wrong}");
    }
    for flag in ["-50", "5e1", "4294967346"] {
        assert_eq!(rtk(flag, ["0.014", "0.011", "0.03"]), None, "{flag}");
    }
}

#[test]
fn packets_that_are_forged_tell_nothing() {
    let good = description(r#"d:RtkFlag="50" d:RtkStdLon="0.01" d:RtkStdLat="0.01" d:RtkStdHgt="0.02""#, "");
    assert!(read(&good).accuracy.is_some() && read(&format!("{good}\0\0")).accuracy.is_some());
    let bomb = r#"<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>"#;
    assert_eq!(read(&format!("{bomb}{good}")), Xmp::default());
    let many = good.replace("</rdf:Description>", &format!("{}</rdf:Description>", "<a/>".repeat(11_000)));
    assert_eq!(read(&many), Xmp::default());
    for deep in
        ["<a>".repeat(20_000), "<a>".repeat(9_000) + &"</a>".repeat(7_000), good[..good.len() - 40].into()]
    {
        assert_eq!(read(&deep), Xmp::default());
    }
    let mut bytes = jpeg(good.as_bytes());
    assert_ne!(Xmp::read(&bytes), Xmp::default());
    assert_eq!(Xmp::read(&bytes[..bytes.len() - 5]), Xmp::default(), "cut short");
    bytes[11] = 0xFF;
    assert_eq!(Xmp::read(&bytes), Xmp::default(), "a segment that claims to be longer than the file");
    bytes[11..13].copy_from_slice(&[0, 1]);
    assert_eq!(Xmp::read(&bytes), Xmp::default(), "a segment shorter than its length");
    for other in [&b""[..], b"\xFF\xD8", b"\xFF\xD8\xFF", b"\x89PNG", &[0xFF; 3000]] {
        assert_eq!(Xmp::read(other), Xmp::default());
    }
    let latin = good.replace("W5M0", "\u{e9}");
    let latin: Vec<u8> = latin.chars().map(|c| if c == '\u{e9}' { 0xE9 } else { c as u8 }).collect();
    assert_eq!(Xmp::read(&jpeg(&latin)), Xmp::default(), "not UTF-8");
}
