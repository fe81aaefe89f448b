//! Tests with files of every supported kind, and with damaged or forged files.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::PathBuf;

use image::{ExtendedColorType, ImageEncoder};

use super::*;

/// A smooth picture, which JPEG compression changes little.
fn smooth(size_px: [u32; 2]) -> Picture {
    let [width, height] = size_px;
    let at = |x: u32, y: u32| [255 * x / width, 255 * y / height, 128].map(|v| v as u8);
    Picture::new(size_px, (0..height).flat_map(|y| (0..width).flat_map(move |x| at(x, y))).collect())
}

fn png(bytes: &[u8], size_px: [u32; 2], color: ExtendedColorType) -> Vec<u8> {
    let mut file = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut file);
    encoder.write_image(bytes, size_px[0], size_px[1], color).unwrap();
    file
}

fn jpeg(picture: &Picture) -> Vec<u8> {
    let path = tempfile::tempdir().unwrap();
    let path = path.path().join("a.jpg");
    picture.write_jpeg(&path, 95).unwrap();
    fs::read(path).unwrap()
}

thread_local! {
    /// One temporary folder per test: creating one for each file would take most of the test's
    /// time.
    static FOLDER: tempfile::TempDir = tempfile::tempdir().unwrap();
}

fn read_bytes(file: &[u8]) -> Result<Picture, SceneError> {
    let path = FOLDER.with(|folder| folder.path().join("a.jpg"));
    // The old file is removed first, because on some file systems overwriting a file waits for the
    // disk.
    let _ = fs::remove_file(&path);
    fs::write(&path, file).unwrap();
    let header = Picture::size_of(&path);
    let picture = Picture::read(&path);
    if let Ok(picture) = &picture {
        assert_eq!(picture.size_px, header.unwrap());
    }
    picture
}

fn complaint(file: &[u8]) -> String {
    let text = read_bytes(file).unwrap_err().to_string();
    assert!(text.contains("a.jpg") && !text.contains('\n'), "{text}");
    text
}

#[test]
fn png_keeps_every_byte() {
    let folder = tempfile::tempdir().unwrap();
    let path: PathBuf = folder.path().join("a.png");
    let picture = smooth([33, 7]);
    picture.write_png(&path).unwrap();
    assert_eq!(Picture::read(&path).unwrap(), picture);
    assert_eq!(Picture::size_of(&path).unwrap(), [33, 7]);
    assert_eq!(Picture::read_fitted(&path, [11, 2]).unwrap(), picture.resized([11, 2]));
}

#[test]
fn jpeg_changes_smooth_pictures_little() {
    let picture = smooth([64, 40]);
    let again = read_bytes(&jpeg(&picture)).unwrap();
    assert_eq!(again.size_px, [64, 40]);
    let difference = picture.rgb.iter().zip(&again.rgb).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(difference.unwrap() <= 12, "{difference:?}");
}

#[test]
fn other_colors_become_rgb() {
    use ExtendedColorType::*;
    let wide = |values: &[u16]| values.iter().flat_map(|v| v.to_ne_bytes()).collect::<Vec<u8>>();
    for (color, bytes, expected) in [
        (L8, vec![7, 200], [7, 7, 7, 200, 200, 200]),
        (La8, vec![100, 255, 100, 51], [100, 100, 100, 20, 20, 20]),
        (Rgba8, vec![10, 20, 30, 0, 250, 100, 5, 128], [0, 0, 0, 125, 50, 3]),
        (L16, wide(&[257, 65_535]), [1, 1, 1, 255, 255, 255]),
        (Rgb16, wide(&[0, 257, 25_700, 65_535, 128, 129]), [0, 1, 100, 255, 0, 1]),
        (Rgba16, wide(&[65_535, 0, 25_700, 65_535, 65_535, 1, 2, 0]), [255, 0, 100, 0, 0, 0]),
    ] {
        assert_eq!(read_bytes(&png(&bytes, [2, 1], color)).unwrap().rgb, expected, "{color:?}");
    }
}

/// The expected scratch bytes per pixel were measured once, with files of 12 megapixels.
#[test]
fn scratch_bytes_follow_the_colour_type() {
    use ExtendedColorType::*;
    let size_px = [1_000, 1_000];
    for (color, bytes_per_pixel, scratch_per_pixel) in
        [(L8, 1, 4), (La8, 2, 5), (Rgb8, 3, 3), (Rgba8, 4, 7), (L16, 2, 9), (Rgb16, 6, 13), (Rgba16, 8, 15)]
    {
        let file = png(&vec![0; bytes_per_pixel * 1_000_000], size_px, color);
        let path = FOLDER.with(|folder| folder.path().join("b.png"));
        fs::write(&path, file).unwrap();
        let beside = |size_px| Picture::scratch_bytes(&path, size_px, Shrinking::AfterDecoding).unwrap();
        let whole = beside(size_px) - scratch_per_pixel * 1_000_000;
        assert!(whole < 2_000_000, "{color:?}: {whole}");
        assert!(beside([10, 10]) < 2_000_000, "{color:?}: rows");
    }
}

#[test]
fn a_png_has_the_same_pixels_row_by_row() {
    use ExtendedColorType::*;
    let noise =
        |count: u32| (0..count).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect::<Vec<u8>>();
    let path = FOLDER.with(|folder| folder.path().join("rows.png"));
    for (color, bytes_per_pixel) in
        [(L8, 1), (La8, 2), (Rgb8, 3), (Rgba8, 4), (L16, 2), (La16, 4), (Rgb16, 6), (Rgba16, 8)]
    {
        fs::write(&path, png(&noise(bytes_per_pixel * 61 * 43), [61, 43], color)).unwrap();
        for size_px in [[20, 14], [61, 1], [7, 43], [70, 50]] {
            let whole = Picture::read(&path).unwrap().resized(size_px);
            assert_eq!(Picture::read_fitted(&path, size_px).unwrap(), whole, "{color:?} {size_px:?}");
        }
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(Picture::read_fitted(&path, [20, 14]).is_err(), "{color:?}: half of the file");
    }
}

#[test]
fn a_jpeg_that_is_shrunk_while_it_is_decoded_hardly_differs() {
    let path = FOLDER.with(|folder| folder.path().join("scaled.jpg"));
    let picture = smooth([411, 300]);
    picture.write_jpeg(&path, 95).unwrap();
    for size_px in [[300, 219], [205, 150], [100, 73], [51, 37], [40, 30]] {
        let exact = Picture::read_fitted(&path, size_px).unwrap();
        let scaled = Picture::read_shrunk(&path, size_px, Shrinking::WhileDecoding).unwrap();
        let squares = exact.rgb.iter().zip(&scaled.rgb).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
        let rms = (squares.sum::<f64>() / exact.rgb.len() as f64).sqrt();
        assert!(scaled.size_px == size_px && rms < 1.5, "{size_px:?}: {rms:.2} levels");
        let bytes = |shrinking| Picture::scratch_bytes(&path, size_px, shrinking).unwrap();
        let [exact, scaled] = [Shrinking::AfterDecoding, Shrinking::WhileDecoding].map(bytes);
        assert!(scaled < exact || size_px == [300, 219], "{size_px:?}: {scaled} of {exact} bytes");
    }
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let cut = Picture::read_shrunk(&path, [40, 30], Shrinking::WhileDecoding).unwrap_err();
    assert!(cut.to_string().contains("cut short"), "{cut}");
}

/// A forged file has its pixels behind, and in front of, megabytes of profiles. Its orientation is told.
#[test]
fn profiles_change_neither_pixels_nor_memory() {
    let path = FOLDER.with(|folder| folder.path().join("profiles.jpg"));
    let picture = smooth([160, 120]);
    // One entry of a TIFF: the tag 0x112, a number of 16 bits, once, 6.
    let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
    picture.write_photograph(&path, 95, exif).unwrap();
    let read = || Picture::read_shrunk(&path, [40, 30], Shrinking::WhileDecoding).unwrap();
    let scratch = || Picture::scratch_bytes(&path, [40, 30], Shrinking::WhileDecoding).unwrap();
    let (expected, bytes) = (read(), scratch());
    assert_eq!(Picture::orientation(&path), Some(6));
    let profile = [&b"\xFF\xE2\x10\x02ICC_PROFILE\0\x01\xFF"[..], &[0; 4082]].concat();
    let file = fs::read(&path).unwrap();
    fs::write(&path, [&file[..2], &profile.repeat(999), &file[2..]].concat()).unwrap();
    assert!(read() == expected && scratch() == bytes);
    assert_eq!(Picture::orientation(&path), Some(6));
}

#[test]
fn metadata_of_a_png_changes_neither_pixels_nor_memory() {
    let path = FOLDER.with(|folder| folder.path().join("metadata.png"));
    let picture = smooth([160, 120]);
    picture.write_png(&path).unwrap();
    let scratch = || Picture::scratch_bytes(&path, [40, 30], Shrinking::AfterDecoding).unwrap();
    let (shrunk, bytes) = (picture.resized([40, 30]), scratch());
    let content = vec![7; 4 << 20];
    let data = [&(content.len() as u32).to_be_bytes()[..], b"eXIf", &content, b"sum."].concat();
    let file = fs::read(&path).unwrap();
    // Behind the first chunk, and before the last one.
    let (first, last) = (33, file.len() - 12);
    let parts = [&file[..first], &data, &file[first..last], &data, &file[last..]];
    fs::write(&path, parts.concat()).unwrap();
    assert!(Picture::read(&path).unwrap() == picture);
    assert!(Picture::read_fitted(&path, [40, 30]).unwrap() == shrunk && scratch() == bytes);
    assert_eq!(Picture::orientation(&path), Some(1));
}

#[test]
fn unit_colors_are_rounded_and_clamped() {
    let picture = Picture::from_unit([2, 1], &[-1.0, 0.5, 2.0, 1.0 / 255.0, f32::NAN, 0.499 / 255.0]);
    assert_eq!(picture.rgb, [0, 128, 255, 1, 0, 0]);
    let all = Picture::new([16, 16], (0..768).map(|i| i as u8).collect());
    assert_eq!(Picture::from_unit([16, 16], &all.to_unit()), all);
}

#[test]
fn files_that_are_not_pictures_are_refused_with_a_reason() {
    assert!(complaint(b"").contains("is empty (0 bytes)"));
    assert!(complaint(b"GIF89a, perhaps").contains("is neither JPEG, PNG"));
    assert!(complaint(b"\x89PiNG\r\n\x1a\n and so on").contains("is neither JPEG, PNG"));
    assert!(complaint(b"\xff").contains("ends within its header"));
    assert!(complaint(b"\xff\xd8\xff\xe0\0\0").contains("damaged JPEG"));
    let folder = FOLDER.with(|folder| Picture::read(folder.path()).unwrap_err().to_string());
    assert!(folder.ends_with("is a folder, not a file"), "{folder}");
    let text = Picture::read(Path::new("nowhere.jpg")).unwrap_err().to_string();
    assert_eq!(text, "nowhere.jpg: there is no such file or folder");
}

#[test]
fn a_forged_size_is_refused_before_decoding() {
    let mut file = png(&[0; 3], [1, 1], ExtendedColorType::Rgb8);
    for (width, height) in [(0_u32, 5_u32), (1 << 20, 1 << 20), (u32::MAX, u32::MAX), (60_000, 4_000)] {
        file[16..20].copy_from_slice(&width.to_be_bytes());
        file[20..24].copy_from_slice(&height.to_be_bytes());
        assert!(complaint(&file).contains(&format!("claims {width} × {height} pixels")));
    }
}

#[test]
fn a_jpeg_cut_anywhere_is_refused() {
    let whole = jpeg(&smooth([24, 16]));
    for length in 0..whole.len() {
        complaint(&whole[..length]);
    }
    // Bytes after the end marker are ignored: cameras append thumbnails and padding.
    assert_eq!(read_bytes(&[&whole[..], b"\0\0padding"].concat()).unwrap(), read_bytes(&whole).unwrap());
}

#[test]
fn a_png_cut_anywhere_is_refused_or_complete() {
    let picture = smooth([9, 5]);
    let whole = png(&picture.rgb, [9, 5], ExtendedColorType::Rgb8);
    for length in 0..whole.len() {
        if let Ok(read) = read_bytes(&whole[..length]) {
            assert_eq!(read, picture, "cut to {length} of {} bytes", whole.len());
        }
    }
    assert!(read_bytes(&whole[..whole.len() / 2]).is_err());
}

#[test]
fn a_flipped_byte_never_panics() {
    for whole in [jpeg(&smooth([24, 16])), png(&smooth([9, 5]).rgb, [9, 5], ExtendedColorType::Rgb8)] {
        for at in 0..whole.len() {
            for flip in [0x01, 0x10, 0xFF] {
                let mut file = whole.clone();
                file[at] ^= flip;
                let _ = read_bytes(&file);
            }
        }
    }
}

#[test]
fn files_that_were_cut_short_are_found_without_decoding_them() {
    let picture = Picture::new([40, 30], (0..40 * 30 * 3).map(|i| (i % 251) as u8).collect());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.jpg");
    for file in [jpeg(&picture), png(&picture.rgb, [40, 30], ExtendedColorType::Rgb8)] {
        fs::write(&path, &file).unwrap();
        assert_eq!(Picture::size_of_whole(&path).unwrap(), [40, 30]);
        fs::write(&path, &file[..file.len() - 100]).unwrap();
        assert!(Picture::size_of(&path).is_ok());
        let error = Picture::size_of_whole(&path).unwrap_err().to_string();
        assert!(error.contains("cut short"), "{error}");
    }
}

/// WebP without loss, TIFF and BMP keep every byte; their headers tell size and memory.
#[test]
fn pictures_of_other_formats_are_read() {
    let picture = smooth([40, 30]);
    for format in [image::ImageFormat::WebP, image::ImageFormat::Tiff, image::ImageFormat::Bmp] {
        let mut file = std::io::Cursor::new(Vec::new());
        let pixels = image::RgbImage::from_raw(40, 30, picture.rgb.clone()).unwrap();
        pixels.write_to(&mut file, format).unwrap();
        let file = file.into_inner();
        assert_eq!(read_bytes(&file).unwrap(), picture, "{format:?}");
        for end in (0..file.len()).step_by(97) {
            let _ = read_bytes(&file[..end]); // an error or a picture, no panic
        }
        assert!(read_bytes(&file[..40]).is_err(), "{format:?}");
    }
}
