//! Tests with files assembled by hand from the published format, of round trips, and with damaged
//! or forged files.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::Write as _;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use super::steps::COLOR_SCALE;
use super::*;

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
    gzip.write_all(bytes).unwrap();
    gzip.finish().unwrap()
}

/// The splats of a file, or the reason of the error.
fn read_bytes(bytes: &[u8]) -> Result<Splats, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    fs::write(&path, bytes).unwrap();
    read(&path).map_err(|error| error.to_string())
}

/// One splat of degree 1 at (1, -2, 3) in SPZ's axes.
fn by_hand(version: u8, quat: &[u8]) -> Vec<u8> {
    by_hand_at(version, &[0x00, 0x10, 0x00, 0x00, 0xe0, 0xff, 0x00, 0x30, 0x00], quat)
}

fn by_hand_at(version: u8, position: &[u8], quat: &[u8]) -> Vec<u8> {
    let header = [b'N', b'G', b'S', b'P', version, 0, 0, 0, 1, 0, 0, 0, 1, 12, 0, 0];
    let (opacity, color, scale) = ([204], [128, 255, 0], [160, 0, 255]);
    let sh = [128, 144, 112, 192, 64, 128, 136, 120, 0];
    gzip(&[&header[..], position, &opacity, &color, &scale, quat, &sh].concat())
}

#[test]
fn files_by_hand_are_read_as_the_format_says() {
    // In SPZ's axes, w is the largest component, x = 0, y = -√½ · 256/511, and z = 0. Bit 9 of each
    // group of ten bits is the sign.
    let packed = (3u32 << 30 | (1 << 9 | 256) << 10).to_le_bytes();
    let splats = read_bytes(&by_hand(3, &packed)).unwrap();
    assert_eq!((splats.len(), splats.sh_degree), (1, 1));
    assert_eq!(splats.means, [[1.0, 2.0, -3.0]]);
    assert_eq!(splats.log_scales, [[0.0, -10.0, 5.9375]]);
    assert!((splats.opacity_logits[0] - 4.0f32.ln()).abs() < 1e-5);
    let y = std::f32::consts::FRAC_1_SQRT_2 * 256.0 / 511.0;
    let [w, qx, qy, qz] = splats.quats[0];
    assert!((w - (1.0 - y * y).sqrt()).abs() < 1e-6 && qx == 0.0 && (qy - y).abs() < 1e-6 && qz == 0.0);
    let color = [0.5 / 255.0, 127.5 / 255.0, -127.5 / 255.0].map(|v| v / COLOR_SCALE);
    splats.sh[..3].iter().zip(color).for_each(|(a, b)| assert!((a - b).abs() < 1e-5, "{a} {b}"));
    // The harmonics of y and z change sign, that of x does not.
    assert_eq!(splats.sh[3..], [-0.0, -0.125, 0.125, -0.5, 0.5, -0.0, 0.0625, -0.0625, -1.0]);
    let old = read_bytes(&by_hand(2, &[255, 128, 0])).unwrap();
    let [w, x, y, z] = old.quats[0];
    assert!(x == 1.0 && (y + 0.5 / 127.5).abs() < 1e-6 && z == 1.0 && w == 0.0, "{:?}", old.quats);
    // Version 1 has 16-bit floats: 1, -2 and 3.
    let oldest = read_bytes(&by_hand_at(1, &[0, 0x3c, 0, 0xc0, 0, 0x42], &[255, 128, 0])).unwrap();
    assert_eq!((&oldest.means, &oldest.quats), (&vec![[1.0, 2.0, -3.0]], &old.quats));
    let infinite = read_bytes(&by_hand_at(1, &[0, 0x7c, 0, 0xc0, 0, 0x42], &[255, 128, 0])).unwrap();
    assert!(infinite.is_empty());
}

fn splats(sh_degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(50, sh_degree);
    let mut state = 1u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    for _ in 0..50 {
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|_| 0.9 * noise()).collect();
        let quat = [noise(), noise(), noise(), 0.1 + noise()];
        splats.push([100.0 * noise(), noise(), noise()], quat, [noise(), noise(), -4.0], 3.0 * noise(), &sh);
    }
    splats
}

#[test]
fn round_trips_are_exact_to_the_formats_rounding() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let versions = [Version::V2, Version::V3, Version::V4];
    for (sh_degree, version) in (0..=3).flat_map(|degree| versions.map(|version| (degree, version))) {
        let sent = splats(sh_degree);
        write(&path, &sent, version).unwrap();
        assert_eq!(size(&path).unwrap(), (50, sh_degree));
        let found = read(&path).unwrap();
        assert_eq!((found.len(), found.sh_degree, found.find_bad_value()), (50, sh_degree, None));
        for i in 0..50 {
            let near = |a: &[f32], b: &[f32], most: f32| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= most);
            assert!(near(&found.means[i], &sent.means[i], 0.5 / 4096.0 + 1e-5));
            assert!(near(&found.log_scales[i], &sent.log_scales[i], 0.5 / 16.0 + 1e-6));
            assert!(near(&found.sh_of(i)[..3], &sent.sh_of(i)[..3], 0.5 / 255.0 / COLOR_SCALE + 1e-5));
            assert!(near(&found.sh_of(i)[3..], &sent.sh_of(i)[3..], 9.0 / 128.0));
            let length = sent.quats[i].iter().map(|v| v * v).sum::<f32>().sqrt();
            let cosine: f32 = found.quats[i].iter().zip(&sent.quats[i]).map(|(a, b)| a * b / length).sum();
            let most = if version == Version::V2 { 5e-3 } else { 2e-6 };
            assert!(cosine.abs() > 1.0 - most, "{version:?}: {cosine}");
        }
    }
}

#[test]
fn parts_give_the_file_of_the_whole() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, parts] = ["whole.spz", "parts.spz"].map(|name| folder.path().join(name));
    let few = splats(2);
    let mut sent = Splats::with_capacity(9000, 2);
    (0..9000).for_each(|i| sent.push_from(&few, i % 50));
    let handed_over = std::cell::Cell::new(0);
    let source = |visit: &mut dyn FnMut(&Splats)| {
        for first in (0..9000).step_by(700) {
            let mut part = Splats::with_capacity(700, 2);
            (first..9000.min(first + 700)).for_each(|i| part.push_from(&sent, i));
            handed_over.set(handed_over.get() + part.len());
            visit(&part);
        }
        Ok(())
    };
    for version in [Version::V2, Version::V3, Version::V4] {
        write(&whole, &sent, version).unwrap();
        write_with(&parts, 2, version, &source).unwrap();
        assert!(fs::read(&whole).unwrap() == fs::read(&parts).unwrap(), "{version:?}");
        assert_eq!(handed_over.replace(0), 7 * 9000);
    }
    // After the first reading, splats are missing.
    let grown = |visit: &mut dyn FnMut(&Splats)| {
        if handed_over.get() == 0 {
            visit(&sent);
        }
        source(visit)
    };
    let before = fs::read(&parts).unwrap();
    let error = write_with(&parts, 2, Version::V3, &grown).unwrap_err().to_string();
    assert!(error.ends_with("the model changed while it was read; try again"), "{error}");
    assert!(fs::read(&parts).unwrap() == before);
}

#[test]
fn far_coordinates_get_fewer_bits_and_farther_ones_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let mut far = splats(0);
    far.means[3] = [1e6, -1e6, 0.0];
    write(&path, &far, Version::V3).unwrap();
    assert!((read(&path).unwrap().means[3][0] - 1e6).abs() < 0.5);
    far.means[3][0] = 1e7;
    assert!(write(&path, &far, Version::V4).unwrap_err().to_string().contains("PLY"));
}

/// The bytes of a file in a version.
fn file(version: Version) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    write(&path, &splats(1), version).unwrap();
    fs::read(&path).unwrap()
}

#[test]
fn harmonics_above_degree_3_are_left_out() {
    let mut bytes = Vec::new();
    GzDecoder::new(&by_hand(3, &[0; 4])[..]).read_to_end(&mut bytes).unwrap();
    bytes[12] = 4;
    bytes.truncate(bytes.len() - 9);
    bytes.extend([144; 72]);
    let splats = read_bytes(&gzip(&bytes)).unwrap();
    assert_eq!((splats.sh_degree, splats.sh.len()), (3, 48));
    assert!(splats.sh[3..].iter().all(|v| v.abs() == 0.125));
}

#[test]
fn files_that_are_not_spz_are_refused_with_a_reason() {
    let mut sane = Vec::new();
    GzDecoder::new(&file(Version::V3)[..]).read_to_end(&mut sane).unwrap();
    let spoilt = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = sane.clone();
        change(&mut bytes);
        read_bytes(&gzip(&bytes)).unwrap_err()
    };
    assert!(read_bytes(&gzip(&sane)).is_ok());
    assert!(spoilt(&|bytes| bytes[0] = 0).contains("NGSP"));
    assert!(spoilt(&|bytes| bytes[4] = 9).contains("version 9"));
    assert!(spoilt(&|bytes| bytes[4] = 4).contains("compression"));
    assert!(spoilt(&|bytes| bytes[12] = 5).contains("degree 4"));
    assert!(spoilt(&|bytes| bytes[11] = 0x7f).contains("forged"));
    assert!(spoilt(&|bytes| bytes.truncate(100)).contains("cut short"));
    assert!(read_bytes(&sane).unwrap_err().contains("compression"));
    assert!(read_bytes(b"ply\n").unwrap_err().contains("too early"));
    assert!(read_bytes(&gzip(b"ply\n")).unwrap_err().contains("gzip"));
}

/// Most damage to compressed values gives other values; only the checksum at the end tells.
#[test]
fn a_wrong_checksum_is_noticed() {
    for version in [Version::V2, Version::V3] {
        let mut bytes = file(version);
        assert!(read_bytes(&bytes).is_ok());
        let checksum = bytes.len() - 8;
        bytes[checksum] ^= 1;
        let reason = read_bytes(&bytes).unwrap_err();
        assert!(reason.contains("checksum"), "{reason}");
    }
    // The last bytes are the checksum of the last stream.
    let mut bytes = file(Version::V4);
    *bytes.last_mut().unwrap() ^= 1;
    assert!(read_bytes(&bytes).is_err());
}

#[test]
fn files_of_version_4_are_refused_if_their_table_lies() {
    let sane = file(Version::V4);
    assert_eq!((&sane[..5], sane[15], sane[16]), (&b"NGSP\x04"[..], 6, 32));
    let spoilt = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = sane.clone();
        change(&mut bytes);
        let reason = read_bytes(&bytes).unwrap_err();
        assert_eq!(reason.lines().count(), 1, "{reason}");
        reason
    };
    assert!(spoilt(&|bytes| bytes[11] = 0x7f).contains("forged"));
    assert!(spoilt(&|bytes| bytes[15] = 5).contains("streams"));
    assert!(spoilt(&|bytes| bytes[17] = 0x7f).contains("cut short"));
    assert!(
        spoilt(&|bytes| bytes[32] += 1).contains("damaged"),
        "the first stream gets a byte of the second"
    );
    assert!(spoilt(&|bytes| bytes[40] += 1).contains("wrong sizes"));
    assert!(spoilt(&|bytes| bytes.truncate(bytes.len() - 1)).contains("wrong sizes"));
    let first = 32 + 6 * 16;
    assert!(spoilt(&|bytes| bytes[first] = 0).contains("damaged"), "no zstd");
}

#[test]
fn splats_that_a_file_cannot_hold_are_counted() {
    let mut splats = Splats::with_capacity(4, 0);
    for log_scales in [[-9.9, -20.0, 5.9], [-10.1, 1.0, -12.0], [6.0, 1.0, 1.0], [-4.0; 3]] {
        splats.push([0.0; 3], [1.0, 0.0, 0.0, 0.0], log_scales, 0.0, &[0.0; 3]);
    }
    assert_eq!(resized(&splats), 2);
}
