//! Reads picture files, and writes JPEG and PNG.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::codecs::png::{PngDecoder, PngEncoder};
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageError, ImageFormat, ImageReader, Limits,
};

use super::chunks::Chunks;
use super::header::{PictureHeader, Way};
use super::pixels::Picture;
use super::resize::area_average_of;
use super::rgb::{alpha_as_grey, rgb_over_black};
use super::segments::Segments;
use super::shrinking::Shrinking;
use super::{png_rows, scaled};
use crate::{SceneError, atomic};

/// Limit on the bytes of a JPEG's head without most of its metadata: many times what tables and EXIF take.
const HEAD_BYTES_MAX: u64 = 1 << 20;

/// Decodes a file to RGB. Errors: a file that is empty, cut short or damaged.
pub(super) fn read(path: &Path) -> Result<Picture, SceneError> {
    read_whole(path, &PictureHeader::read(path)?, rgb_over_black)
}

/// The opacity as a grey picture of `size_px`; `None` if the file has no transparency.
pub(super) fn read_alpha(path: &Path, size_px: [u32; 2]) -> Result<Option<Picture>, SceneError> {
    let header = PictureHeader::read(path)?;
    if !header.has_alpha {
        return Ok(None);
    }
    if header.way(size_px, Shrinking::AfterDecoding) == Way::Rows {
        return png_rows::read(path, &header, size_px, alpha_as_grey).map(Some);
    }
    let picture = read_whole(path, &header, alpha_as_grey)?;
    Ok(Some(if picture.size_px == size_px { picture } else { picture.resized(size_px) }))
}

/// As [`read`], resampled to `size_px` while or after the picture is decoded.
pub(super) fn read_fitted(
    path: &Path,
    size_px: [u32; 2],
    shrinking: Shrinking,
) -> Result<Picture, SceneError> {
    let header = PictureHeader::read(path)?;
    let picture = match header.way(size_px, shrinking) {
        Way::Whole => read_whole(path, &header, rgb_over_black)?,
        Way::Rows => return png_rows::read(path, &header, size_px, rgb_over_black),
        Way::Scaled(divisor) => {
            check_end(path, &header)?;
            let scaled = scaled::read(path, header.size_px, divisor)?;
            return Ok(area_average_of(&scaled, header.size_px, divisor, size_px));
        }
    };
    Ok(if picture.size_px == size_px { picture } else { picture.resized(size_px) })
}

/// An error if a JPEG is cut short. Decoders would fill the missing pixels with grey.
fn check_end(path: &Path, header: &PictureHeader) -> Result<(), SceneError> {
    let file = File::open(path).map(BufReader::new).map_err(|cause| SceneError::io(path, cause))?;
    if has_end(file, header.data_offset).unwrap_or(false) { Ok(()) } else { Err(cut_short(path)) }
}

fn read_whole(
    path: &Path,
    header: &PictureHeader,
    rgb_of: fn(DynamicImage) -> Vec<u8>,
) -> Result<Picture, SceneError> {
    let open = || File::open(path).map(BufReader::new).map_err(|cause| SceneError::io(path, cause));
    if header.format == ImageFormat::Jpeg {
        check_end(path, header)?;
    }
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(header.decode_bytes);
    let file = open()?;
    let image = match header.format {
        ImageFormat::Png => decode_png(file, limits),
        format => {
            let mut reader = ImageReader::with_format(file, format);
            reader.limits(limits);
            reader.decode()
        }
    };
    let image = image.map_err(|error| {
        let error = error.to_string().replace('\n', " ");
        let reason = format!("cannot be decoded ({error}); fetch the picture again or leave it out");
        SceneError::malformed(path, reason)
    })?;
    Ok(Picture::new([image.width(), image.height()], rgb_of(image)))
}

fn decode_png(file: BufReader<File>, limits: Limits) -> Result<DynamicImage, ImageError> {
    let chunks = Chunks::of_pixels(file).map_err(ImageError::IoError)?;
    DynamicImage::from_decoder(PngDecoder::with_limits(BufReader::new(chunks), limits)?)
}

fn cut_short(path: &Path) -> SceneError {
    let reason = "ends before its last pixel; it was cut short, fetch the picture again or leave it out";
    SceneError::malformed(path, reason)
}

/// Width and height; an error if the end of the file is missing. The pixels are not decoded.
pub(super) fn size_of_whole(path: &Path) -> Result<[u32; 2], SceneError> {
    let header = PictureHeader::read(path)?;
    let file = File::open(path).map(BufReader::new).map_err(|cause| SceneError::io(path, cause))?;
    let is_whole = match header.format {
        ImageFormat::Jpeg => has_end(file, header.data_offset),
        ImageFormat::Png => has_png_end(file),
        _ => Ok(true), // these formats have no mark at their end
    };
    if is_whole.unwrap_or(false) { Ok(header.size_px) } else { Err(cut_short(path)) }
}

/// The EXIF orientation, 1 to 8; `None` if the file cannot be read.
pub(super) fn orientation(path: &Path) -> Option<u8> {
    let header = PictureHeader::read(path).ok()?;
    let file = File::open(path).map(BufReader::new).ok()?;
    let orientation = match header.format {
        ImageFormat::Jpeg => {
            // The decoder reads the whole input into memory.
            let mut head = Vec::new();
            Segments::of_head(file).take(HEAD_BYTES_MAX).read_to_end(&mut head).ok()?;
            JpegDecoder::new(Cursor::new(head)).ok()?.orientation()
        }
        ImageFormat::Png => {
            let chunks = BufReader::new(Chunks::with_exif(file).ok()?);
            PngDecoder::new(chunks).ok()?.orientation()
        }
        format => ImageReader::with_format(file, format).into_decoder().ok()?.orientation(),
    };
    Some(orientation.ok()?.to_exif())
}

/// Whether a PNG ends with its last chunk: the name IEND and a checksum.
fn has_png_end(mut input: impl BufRead + Seek) -> io::Result<bool> {
    input.seek(SeekFrom::End(-8))?;
    let mut name = [0; 4];
    input.read_exact(&mut name)?;
    Ok(name == *b"IEND")
}

/// Whether a JPEG has an end marker somewhere after `offset`, bytes from the start of the file.
fn has_end(mut input: impl BufRead + Seek, offset: u64) -> io::Result<bool> {
    input.seek(SeekFrom::Start(offset))?;
    let mut last = 0;
    loop {
        let bytes = input.fill_buf()?;
        if bytes.is_empty() {
            return Ok(false);
        }
        for &byte in bytes {
            if (last, byte) == (0xFF, 0xD9) {
                return Ok(true);
            }
            last = byte;
        }
        let read = bytes.len();
        input.consume(read);
    }
}

/// Writes a PNG file, atomically.
pub(super) fn write_png(picture: &Picture, path: &Path) -> Result<(), SceneError> {
    let [width, height] = picture.size_px;
    atomic::write(path, |out| {
        let encoder = PngEncoder::new(out);
        encoder.write_image(&picture.rgb, width, height, ExtendedColorType::Rgb8).map_err(into_io)
    })
}

/// Writes a JPEG file of `quality` 1 to 100, atomically. No EXIF is written if `exif` is empty.
pub(super) fn write_jpeg(
    picture: &Picture,
    path: &Path,
    quality: u8,
    exif: Vec<u8>,
) -> Result<(), SceneError> {
    let [width, height] = picture.size_px;
    atomic::write(path, |out| {
        let mut encoder = JpegEncoder::new_with_quality(out, quality);
        if !exif.is_empty() {
            encoder.set_exif_metadata(exif).map_err(io::Error::other)?;
        }
        encoder.write_image(&picture.rgb, width, height, ExtendedColorType::Rgb8).map_err(into_io)
    })
}

fn into_io(error: ImageError) -> io::Error {
    match error {
        ImageError::IoError(error) => error,
        other => io::Error::other(other),
    }
}
