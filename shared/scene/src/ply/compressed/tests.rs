//! Tests with files assembled by hand in the layout of splat-transform.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::PathBuf;

use super::*;
use crate::{LocalFrame, Splats, model};

/// A file with splats in one chunk that reaches from -1 to 3 along each axis; all words are given.
fn bytes(words: &[[u32; 4]], has_colors: bool, sh: Option<&[u8]>) -> Vec<u8> {
    let mut text = String::from("ply\nformat binary_little_endian 1.0\ncomment by hand\nelement chunk 1\n");
    let bounds = &BOUNDS[..if has_colors { BOUNDS.len() } else { BOUNDS_MIN }];
    bounds.iter().for_each(|name| text += &format!("property float {name}\n"));
    text += &format!("element vertex {}\n", words.len());
    WORDS.iter().for_each(|name| text += &format!("property uint {name}\n"));
    if let Some(sh) = sh {
        text += &format!("element sh {}\n", words.len());
        (0..sh.len() / words.len()).for_each(|i| text += &format!("property uchar f_rest_{i}\n"));
    }
    let values =
        [-1.0f32, -1.0, -1.0, 3.0, 3.0, 3.0, -8.0, -8.0, -8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0];
    let mut bytes = (text + "end_header\n").into_bytes();
    bytes.extend(values[..bounds.len()].iter().flat_map(|value| value.to_le_bytes()));
    bytes.extend(words.iter().flatten().flat_map(|word| word.to_le_bytes()));
    bytes.extend(sh.unwrap_or_default());
    bytes
}

fn read_bytes(bytes: &[u8]) -> Result<Splats, String> {
    let folder = tempfile::tempdir().unwrap();
    let path: PathBuf = folder.path().join("a.compressed.ply");
    fs::write(&path, bytes).unwrap();
    model::read(&path, &LocalFrame::WORLD).map_err(|error| error.to_string())
}

/// At (-1, 1, 3); half turned about z; opaque.
const WORD: [u32; 4] = [512 << 11 | 2047, 2 << 30 | 1023 << 20 | 512 << 10 | 512, 2047 << 21, 0xff_00_80_ff];

#[test]
fn files_by_hand_are_read_as_the_format_says() {
    let sh: Vec<u8> = (0..9).map(|i| if i == 0 { 255 } else { 128 + i }).collect();
    let splats = read_bytes(&bytes(&[WORD], true, Some(&sh))).unwrap();
    assert_eq!((splats.len(), splats.sh_degree), (1, 1));
    let near = |found: &[f32], wanted: &[f32]| found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 0.01);
    assert!(near(&splats.means[0], &[-1.0, 1.0, 3.0]), "{:?}", splats.means);
    assert!(near(&splats.log_scales[0], &[0.0, -8.0, -8.0]), "{:?}", splats.log_scales);
    // The largest component is the third, y; w is the first of the others and at its most, the root of a half.
    let half = 0.5f32.sqrt();
    assert!(near(&splats.quats[0], &[half, 0.0, half, 0.0]), "{:?}", splats.quats);
    assert!(splats.opacity_logits[0] > 10.0, "{:?}", splats.opacity_logits);
    assert!(near(&splats.sh[..3], &[1.5 / SH_C0, -0.5 / SH_C0, (2.0 * 128.0 / 255.0 - 0.5) / SH_C0]));
    // The file has all of red first; splats have the colours of a coefficient together.
    let at = |i: f32| (128.5 + i) / 32.0 - 4.0;
    assert!(near(
        &splats.sh[3..],
        &[4.0, at(3.0), at(6.0), at(1.0), at(4.0), at(7.0), at(2.0), at(5.0), at(8.0)]
    ));
    let plain = read_bytes(&bytes(&[WORD], false, None)).unwrap();
    assert_eq!(plain.sh_degree, 0);
    assert!(near(&plain.sh, &[0.5 / SH_C0, -0.5 / SH_C0, (128.0 / 255.0 - 0.5) / SH_C0]));
}

#[test]
fn files_that_lie_are_refused_in_one_line() {
    let sane = bytes(&[WORD; 3], true, Some(&[128; 72]));
    assert_eq!(read_bytes(&sane).unwrap().len(), 3);
    let changed = |from: &str, to: &str| {
        let at = sane.windows(from.len()).position(|bytes| bytes == from.as_bytes()).unwrap();
        let mut bytes = sane.clone();
        bytes.splice(at..at + from.len(), to.bytes());
        let reason = read_bytes(&bytes).unwrap_err();
        assert_eq!(reason.lines().count(), 1, "{reason}");
        reason
    };
    assert!(changed("vertex 3", "vertex 18446744073709551615").contains("forged"));
    assert!(changed("vertex 3", "vertex 4").contains("forged"));
    assert!(changed("chunk 1", "chunk 0").contains("0 chunks"));
    assert!(changed("element sh 3", "element sh 2").contains("sh"));
    assert!(changed("uchar f_rest_0", "char f_rest_0").contains("sh"));
    assert!(changed("element chunk", "element chuck").contains("chunk"));
    assert!(changed("uint packed_color", "int packed_color").contains("vertex"));
    assert!(changed("binary_little_endian", "ascii").contains("ascii"));
    let cut = read_bytes(&sane[..sane.len() - 1]).unwrap_err();
    assert!(cut.contains("cut short"), "{cut}");
}
