//! Tests of round trips, of exact bytes, of files as other tools write them, and of damaged or
//! forged files.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::PathBuf;

use super::*;

/// `n` splats with spherical harmonics of `degree` and varied values.
fn made_up(n: usize, degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(n, degree);
    let mut last = 0.0;
    let mut next = || {
        last += 0.125;
        last - 8.0
    };
    for _ in 0..n {
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|_| next()).collect();
        let log_scale = [next(), next(), next()].map(|v: f32| v % 7.0);
        splats.push([next(), next(), next()], [next(), next(), next(), next()], log_scale, next(), &sh);
    }
    splats
}

thread_local! {
    /// One temporary folder per test: creating one for each file would take most of the test's
    /// time.
    static FOLDER: tempfile::TempDir = tempfile::tempdir().unwrap();
}

fn in_file<T>(content: &[u8], then: impl FnOnce(PathBuf) -> T) -> T {
    let path = FOLDER.with(|folder| folder.path().join("a.ply"));
    // The old file is removed first, because on some file systems overwriting a file waits for the
    // disk.
    let _ = fs::remove_file(&path);
    fs::write(&path, content).unwrap();
    then(path)
}

fn read_bytes(content: &[u8]) -> Result<Splats, SceneError> {
    in_file(content, |path| read(&path, &LocalFrame::WORLD))
}

fn bytes_of(splats: &Splats) -> Vec<u8> {
    in_file(b"", |path| {
        write(&path, splats, &LocalFrame::WORLD).unwrap();
        fs::read(path).unwrap()
    })
}

/// An ascii file of one vertex. Every property is 0.5, except those for which `changes` gives a value.
fn ascii(changes: &[(&str, &str)]) -> Vec<u8> {
    let mut header = String::from("ply\nformat ascii 1.0\nelement vertex 1\n");
    let mut row = String::new();
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    for name in names.split(' ') {
        let value = changes.iter().find(|(changed, _)| *changed == name).map_or("0.5", |(_, value)| value);
        header += &format!("property float {name}\n");
        row += &format!("{value} ");
    }
    (header + "end_header\n" + &row).into_bytes()
}

#[test]
fn every_degree_survives_the_round_trip() {
    for degree in 0..=3 {
        for n in [0, 1, 5] {
            let splats = made_up(n, degree);
            let bytes = bytes_of(&splats);
            assert_eq!(read_bytes(&bytes).unwrap(), splats, "{n} of degree {degree}");
            assert_eq!(file_bytes(n, degree, &LocalFrame::WORLD), bytes.len() as u64);
        }
    }
}

#[test]
fn files_have_the_bytes_that_3dgs_writes() {
    let mut splats = Splats::with_capacity(1, 1);
    let sh: Vec<f32> = (0..12).map(|i| i as f32).collect();
    splats.push([100.0, 101.0, 102.0], [1.0, 0.0, 0.0, 2.0], [-1.0, -2.0, -3.0], 0.25, &sh);
    let mut expected = String::from("ply\nformat binary_little_endian 1.0\nelement vertex 1\n");
    for name in "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 \
                 f_rest_6 f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
        .split_ascii_whitespace()
    {
        expected += &format!("property float {name}\n");
    }
    let mut expected = (expected + "end_header\n").into_bytes();
    // Coefficients 1 to 3 are (3, 4, 5), (6, 7, 8) and (9, 10, 11) as rgb. The file has first the
    // red values of all three, then the green, then the blue.
    for value in [
        100.0, 101.0, 102.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 6.0, 9.0, 4.0, 7.0, 10.0, 5.0, 8.0, 11.0,
        0.25, -1.0, -2.0, -3.0, 1.0, 0.0, 0.0, 2.0_f32,
    ] {
        expected.extend_from_slice(&value.to_le_bytes());
    }
    assert_eq!(bytes_of(&splats), expected);
}

#[test]
fn further_properties_stand_behind_those_of_3dgs_and_are_ignored() {
    let splats = made_up(3, 1);
    let write = |path: &Path, values: &[f32]| {
        let fill = |write: &mut dyn FnMut(&Splats, &[f32]) -> io::Result<()>| write(&splats, values);
        write_with_extra(path, 3, 1, &LocalFrame::WORLD, &["views", "error_m"], fill)
    };
    in_file(b"", |path| {
        write(&path, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        assert_eq!(read(&path, &LocalFrame::WORLD).unwrap(), splats);
        let mut found = Vec::new();
        let read = read_elements(&path, |element, rows| {
            let last = element.properties.len() - 2;
            assert_eq!((element.column("views"), element.column("error_m")), (Some(last), Some(last + 1)));
            while let Some(row) = rows.next()? {
                found.extend_from_slice(&row[last..]);
            }
            Ok(())
        });
        read.unwrap();
        assert_eq!(found, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        for values in [&[1.0; 5][..], &[1.0; 7]] {
            let error = write(&path, values).unwrap_err().to_string();
            assert!(error.contains("other numbers of values"), "{error}");
        }
    });
}

#[test]
fn other_dialects_are_read() {
    let header = "ply\r\nformat binary_little_endian 1.0\r\ncomment made by hand\r\n\
        element face 2\r\nproperty list uchar int vertex_indices\r\nproperty uchar flags\r\n\
        element vertex 1\r\nproperty double rot_3\r\nproperty float rot_1\r\nproperty float rot_2\r\n\
        property float rot_0\r\nproperty uchar f_dc_2\r\nproperty short f_dc_1\r\nproperty int f_dc_0\r\n\
        property list uchar ushort neighbours\r\nproperty float opacity\r\nproperty char scale_2\r\n\
        property float scale_1\r\nproperty float scale_0\r\nproperty uint z\r\nproperty ushort y\r\n\
        property float x\r\nelement edge 1000000\r\nproperty int unread\r\nend_header\r\n";
    let mut file = header.as_bytes().to_vec();
    file.extend([2, 1, 0, 0, 0, 2, 0, 0, 0, 9]); // a face of two corners
    file.extend([0, 9]); // an empty face
    file.extend(0.5_f64.to_le_bytes());
    for value in [0.1_f32, 0.2, 0.3] {
        file.extend(value.to_le_bytes());
    }
    file.push(200);
    file.extend((-3_i16).to_le_bytes());
    file.extend((-70_000_i32).to_le_bytes());
    file.extend([1, 255, 255]);
    file.extend(4.0_f32.to_le_bytes());
    file.push(0xFF);
    file.extend(2.0_f32.to_le_bytes());
    file.extend(3.0_f32.to_le_bytes());
    file.extend(4_000_000_000_u32.to_le_bytes());
    file.extend(65_535_u16.to_le_bytes());
    file.extend(1.5_f32.to_le_bytes());
    let mut expected = Splats::with_capacity(1, 0);
    expected.push(
        [1.5, 65_535.0, 4e9],
        [0.3, 0.1, 0.2, 0.5],
        [3.0, 2.0, -1.0],
        4.0,
        &[-70_000.0, -3.0, 200.0],
    );
    assert_eq!(read_bytes(&file).unwrap(), expected);
}

/// The origin is in the header, and the file has the world's unit whatever the frame.
#[test]
fn splats_of_a_frame_are_written_relative_to_its_origin_and_read_into_another() {
    let origin = DVec3::new(500_000.0, 5_200_000.25, 0.0);
    let splats = made_up(5, 1);
    in_file(b"", |path| {
        write(&path, &splats, &LocalFrame::at(origin)).unwrap();
        assert_eq!(super::origin(&path).unwrap(), origin);
        assert_eq!(read(&path, &LocalFrame::at(origin)).unwrap(), splats);
        let moved = read(&path, &LocalFrame::at(origin - DVec3::Y * 8.0)).unwrap();
        assert_eq!(moved.means[1][1], splats.means[1][1] + 8.0);
        let points = read_points(&path).unwrap();
        let mean = DVec3::from_array(splats.means[1].map(f64::from));
        assert_eq!(points[1].position, origin + mean);
    });
    assert_eq!(header::origin_line(DVec3::ZERO), "");
}

#[test]
fn a_comment_that_names_no_position_is_a_comment() {
    for words in ["a b c", "1 2", "1e300 0 0", "nan 0 0", "1 2 3 4"] {
        let text = String::from_utf8(ascii(&[])).unwrap();
        let text = text.replacen("1.0\n", &format!("1.0\ncomment origin {words}\n"), 1);
        assert_eq!(read_bytes(text.as_bytes()).unwrap().means, [[0.5; 3]], "{words}");
    }
}

#[test]
fn ascii_is_read() {
    let splats = read_bytes(&ascii(&[("x", "-1e2"), ("rot_3", "+7")])).unwrap();
    assert_eq!(splats.means, [[-100.0, 0.5, 0.5]]);
    assert_eq!(splats.quats, [[0.5, 0.5, 0.5, 7.0]]);
}

#[test]
fn bad_values_are_named() {
    for (changes, complaint) in [
        (&[("x", "nan")][..], "vertex 0: x is NaN"),
        (&[("y", "inf")], "vertex 0: y is inf"),
        (&[("z", "1e39")], "vertex 0: z is 1e39"),
        (&[("f_dc_2", "-inf")], "vertex 0: f_dc_2 is -inf"),
        (&[("opacity", "NaN")], "vertex 0: opacity is NaN"),
        (&[("scale_1", "-inf")], "vertex 0: scale_1 is -inf"),
        (&[("scale_0", "40")], "vertex 0: scale_0 is 40.0"),
        (&[("rot_2", "NaN")], "vertex 0: rot_2 is NaN"),
        (&[("rot_0", "0"), ("rot_1", "0"), ("rot_2", "-0.0"), ("rot_3", "1e-7")], "vertex 0: rot_0 to rot_3"),
        (&[("rot_0", "1e30")], "vertex 0: rot_0 to rot_3"),
        (&[("x", "0,5")], "vertex 0 of 1: '0,5' is not a number"),
        (&[("x", "\u{1b}[31m")], "is not a number"),
    ] {
        let text = read_bytes(&ascii(changes)).unwrap_err().to_string();
        assert!(text.contains(complaint), "{changes:?}: {text}");
        assert!(!text.contains(['\n', '\u{1b}']), "{text}");
    }
}

#[test]
fn row_counts_are_checked_against_the_files_length() {
    let good = String::from_utf8(ascii(&[])).unwrap();
    for count in ["3", "1000000000000", "18446744073709551615"] {
        for format in ["ascii", "binary_little_endian"] {
            let file = good.replace("vertex 1\n", &format!("vertex {count}\n")).replace("ascii", format);
            let text = read_bytes(file.as_bytes()).unwrap_err().to_string();
            assert!(text.contains(&format!("claims {count} rows of element vertex")), "{text}");
        }
    }
    let bare = "ply\nformat ascii 1.0\nelement none 9999999999\nelement vertex 0\nend_header\n";
    assert!(read_bytes(bare.as_bytes()).unwrap_err().to_string().contains("claims 9999999999 rows"));
}

#[test]
fn files_that_hold_no_splats_are_refused_with_a_reason() {
    let good = String::from_utf8(ascii(&[])).unwrap();
    for (file, complaint) in [
        (String::new(), "not a PLY file"),
        ("solid cube\n".into(), "not a PLY file"),
        ("ply\n".into(), "cut short"),
        (good.replace("ascii", "binary_big_endian"), "big-endian; save it again"),
        (good.replace("ascii", "gzip"), "'gzip' is not known"),
        (good.replace("format ascii 1.0\n", ""), "names no format"),
        (good.replace("float rot_3", "quad rot_3"), "type 'quad'"),
        (good.replace("float rot_3", "float rot_2"), "two properties called rot_2"),
        (good.replace("float rot_3", "float rot_5"), "no property rot_3"),
        (good.replace("float rot_3", "list uchar float rot_3"), "no property rot_3"),
        (good.replace("float rot_3", "float f_rest_0"), "1 properties f_rest_*"),
        (good.replace("vertex 1", "vertex -1"), "'-1'"),
        (good.replace("vertex 1", "splat 1"), "no element called vertex"),
        (good.replace("element vertex 1\n", ""), "before any element"),
        (good.replace("end_header\n", &"comment ".repeat(10_000)), "has no end"),
        (good.replace("end_header", "end of header"), "not understood"),
    ] {
        let text = read_bytes(file.as_bytes()).unwrap_err().to_string();
        assert!(text.contains(complaint), "{complaint}: {text}");
    }
    let nowhere = std::path::Path::new("nowhere.ply");
    let text = read(nowhere, &LocalFrame::WORLD).unwrap_err().to_string();
    assert_eq!(text, "nowhere.ply: there is no such file or folder");
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let whole = bytes_of(&made_up(2, 1));
    for length in 0..whole.len() {
        assert!(read_bytes(&whole[..length]).is_err(), "cut to {length} of {} bytes", whole.len());
    }
    let whole = ascii(&[]);
    for length in 0..whole.len() {
        // An ascii file may still be valid without its last digit or its last space.
        assert!(read_bytes(&whole[..length]).is_err() || length + 4 > whole.len(), "cut to {length}");
    }
}

#[test]
fn a_flipped_byte_never_panics() {
    let whole = bytes_of(&made_up(1, 0));
    for at in 0..whole.len() {
        for flip in [1, 0x80, 0xFF] {
            let mut file = whole.clone();
            file[at] ^= flip;
            if let Ok(splats) = read_bytes(&file) {
                assert_eq!(splats.find_bad_value(), None);
            }
        }
    }
}

#[test]
fn points_are_read() {
    let file = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 4 5 6\n-1 -2 -3 255 0 9\n";
    let points = in_file(file.as_bytes(), |path| read_points(&path)).unwrap();
    assert_eq!(points.len(), 2);
    assert_eq!((points[1].position.to_array(), points[1].rgb), ([-1.0, -2.0, -3.0], [255, 0, 9]));
    let bad = file.replace("-2", "nan");
    let text = in_file(bad.as_bytes(), |path| read_points(&path)).unwrap_err().to_string();
    assert!(text.contains("vertex 1"), "{text}");
}
