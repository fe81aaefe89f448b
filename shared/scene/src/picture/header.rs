//! Reads the headers of picture files: the picture's size, and a bound on the memory for decoding
//! it. Only a few hundred bytes are read of a JPEG or PNG, so thousands of pictures are checked quickly. A
//! forged size is refused before anything is allocated.

use std::io::{self, BufRead, BufReader, Read, Seek};
use std::path::Path;

use image::{ColorType, ImageDecoder, ImageFormat, ImageReader};

use super::scaled;
use super::shrinking::Shrinking;
use crate::{SceneError, files};

/// Largest accepted number of pixels, more than any drone's camera has.
const PIXELS_MAX: u64 = 1 << 28;

/// Most pixels per byte of a PNG file: 8 pixels of one bit each, compressed 1032-fold, which is the
/// limit of deflate.
const PNG_PIXELS_PER_BYTE_MAX: u64 = 8 * 1032;

/// Most pixels per byte of a JPEG file: a block of 8 × 8 pixels takes at least one bit.
const JPEG_PIXELS_PER_BYTE_MAX: u64 = 8 * 64;

/// What the header of a picture file says, checked against the file's length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PictureHeader {
    pub(super) format: ImageFormat,
    pub(super) size_px: [u32; 2],
    /// Upper bound on the bytes that decoding allocates, including the decoded picture.
    pub(super) decode_bytes: u64,
    /// Offset of a JPEG's first compressed pixels from the start of the file, bytes; 0 for PNG.
    pub(super) data_offset: u64,
    /// Whether the pixels come in the order of rows or blocks, so that the picture can be shrunk while it is decoded.
    is_in_order: bool,
    /// Whether pixels may be transparent.
    pub(super) has_alpha: bool,
}

/// How a picture is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    /// Decoded whole.
    Whole,
    /// A PNG, row by row.
    Rows,
    /// A JPEG at one part in so many of its width and height.
    Scaled(u32),
}

/// Upper bound on the bytes of a few rows of so many pixels, and tables.
fn rows_bytes(width: u32) -> u64 {
    256 * u64::from(width) + (1 << 18)
}

/// What the header of a picture file says, unchecked.
struct Facts {
    format: ImageFormat,
    size_px: [u32; 2],
    bytes_per_pixel: u64,
    data_offset: u64,
    is_in_order: bool,
    has_alpha: bool,
}

impl PictureHeader {
    /// Reads the header of `path`, and refuses sizes that a file of this length cannot hold.
    pub(super) fn read(path: &Path) -> Result<Self, SceneError> {
        let io = |cause| SceneError::io(path, cause);
        let malformed = |reason: String| SceneError::malformed(path, reason);
        let file = files::open(path)?;
        let file_bytes = file.metadata().map_err(io)?.len();
        if file_bytes == 0 {
            return Err(malformed("is empty (0 bytes); fetch the picture again or leave it out".into()));
        }
        let facts = read_facts(&mut BufReader::new(file)).map_err(|cause| match cause.kind() {
            io::ErrorKind::UnexpectedEof => {
                malformed("ends within its header; fetch the picture again or leave it out".into())
            }
            io::ErrorKind::InvalidData => malformed(cause.to_string()),
            _ => io(cause),
        })?;
        let [width, height] = facts.size_px;
        let pixels = u64::from(width) * u64::from(height);
        let densest = match facts.format {
            ImageFormat::Png => PNG_PIXELS_PER_BYTE_MAX,
            ImageFormat::Jpeg => JPEG_PIXELS_PER_BYTE_MAX,
            _ => PIXELS_MAX, // a picture of one colour takes next to nothing
        };
        if pixels == 0 || pixels > PIXELS_MAX || pixels > file_bytes.saturating_mul(densest) {
            return Err(malformed(format!(
                "claims {width} × {height} pixels in {file_bytes} bytes; the file is damaged, fetch it again"
            )));
        }
        Ok(Self {
            format: facts.format,
            size_px: facts.size_px,
            // Decoders of JPEG keep what is before the pixels twice.
            decode_bytes: file_bytes + facts.data_offset + pixels * facts.bytes_per_pixel + rows_bytes(width),
            data_offset: facts.data_offset,
            is_in_order: facts.is_in_order,
            has_alpha: facts.has_alpha,
        })
    }

    /// How the picture is read to get it at the size `size_px`.
    pub(super) fn way(&self, size_px: [u32; 2], shrinking: Shrinking) -> Way {
        match (self.format, shrinking) {
            (ImageFormat::Png, _) if self.is_in_order && size_px != self.size_px => Way::Rows,
            (ImageFormat::Jpeg, Shrinking::WhileDecoding) if self.is_in_order => {
                match scaled::divisor(self.size_px, size_px) {
                    1 => Way::Whole,
                    divisor => Way::Scaled(divisor),
                }
            }
            _ => Way::Whole,
        }
    }

    /// Upper bound on the bytes of rows and tables of a decoder.
    pub(super) fn rows_bytes(&self) -> u64 {
        rows_bytes(self.size_px[0])
    }

    /// Upper bound on the bytes that decoding allocates to give the picture at the size `size_px`, besides that picture.
    pub(super) fn scratch_bytes(&self, size_px: [u32; 2], shrinking: Shrinking) -> u64 {
        match self.way(size_px, shrinking) {
            Way::Whole => self.decode_bytes,
            Way::Rows => self.rows_bytes(),
            Way::Scaled(divisor) => {
                // Its planes, which end at whole blocks, and the picture made of them; then a shrunk one.
                let [width, height] =
                    scaled::scaled_px(self.size_px, divisor).map(|side| u64::from(side) + 16);
                2 * 3 * width * height + self.rows_bytes()
            }
        }
    }
}

fn read_facts(input: &mut (impl BufRead + Seek)) -> io::Result<Facts> {
    match u16::from_be_bytes(read_array(input)?) {
        0xFFD8 => read_jpeg(input),
        0x8950 => read_png(input),
        0x5249 => read_other(input, ImageFormat::WebP),
        0x4949 | 0x4D4D => read_other(input, ImageFormat::Tiff),
        0x424D => read_other(input, ImageFormat::Bmp),
        _ => Err(invalid(UNKNOWN)),
    }
}

const UNKNOWN: &str = "is neither JPEG, PNG, WebP, TIFF nor BMP; convert it to JPEG or PNG";
/// Upper bound on the bytes per pixel that decoders of other formats take for themselves: those of WebP have planes of
/// brightness and colour, and a copy with alpha.
const DECODER_BYTES_PER_PIXEL: u64 = 10;

/// Lets the library read the head of a file of another format, which it knows by its first two bytes.
fn read_other(input: &mut (impl BufRead + Seek), format: ImageFormat) -> io::Result<Facts> {
    input.rewind()?;
    let failed = |error: image::ImageError| match error {
        image::ImageError::IoError(error) => error,
        error => invalid(&format!(
            "cannot be read ({}); convert it to JPEG or PNG",
            error.to_string().replace('\n', " ")
        )),
    };
    let decoder = ImageReader::with_format(input, format).into_decoder().map_err(failed)?;
    let (width, height) = decoder.dimensions();
    let color = decoder.color_type();
    let converted = if matches!(color, ColorType::Rgb8) { 0 } else { 4 + 3 };
    let bytes_per_pixel = u64::from(color.bytes_per_pixel()) + converted + DECODER_BYTES_PER_PIXEL;
    let size_px = [width, height];
    let has_alpha = color.has_alpha();
    Ok(Facts { format, size_px, bytes_per_pixel, data_offset: 0, is_in_order: false, has_alpha })
}

pub(super) fn invalid(reason: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

fn read_array<const N: usize>(input: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    input.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// Reads the rest of a PNG's signature, and its chunks up to the first that holds pixels.
fn read_png(input: &mut (impl Read + Seek)) -> io::Result<Facts> {
    let rest: [u8; 14] = read_array(input)?;
    if rest != *b"NG\r\n\x1a\n\0\0\0\rIHDR" {
        return Err(invalid(UNKNOWN));
    }
    let width = u32::from_be_bytes(read_array(input)?);
    let height = u32::from_be_bytes(read_array(input)?);
    let [depth, color, _, _, interlace]: [u8; 5] = read_array(input)?;
    let has_alpha = has_transparency(input)? || matches!(color, 4 | 6);
    let channels = if matches!(color, 0 | 4) { 1 } else { 3 } + u64::from(has_alpha);
    let bytes_per_pixel = match (depth, channels) {
        (16, _) => 2 * channels + 4 + 3,
        (_, 3) => 3,
        (_, _) => channels + 3,
    };
    Ok(Facts {
        format: ImageFormat::Png,
        size_px: [width, height],
        bytes_per_pixel,
        data_offset: 0,
        is_in_order: interlace == 0,
        has_alpha,
    })
}

/// Whether a `tRNS` chunk before the pixels makes some colour transparent. `input` must be at the
/// checksum of the first chunk.
fn has_transparency(input: &mut (impl Read + Seek)) -> io::Result<bool> {
    let mut skip = 4;
    loop {
        input.seek_relative(skip)?;
        let length = u32::from_be_bytes(read_array(input)?);
        match &read_array(input)? {
            b"tRNS" => return Ok(true),
            b"IDAT" => return Ok(false),
            _ => skip = i64::from(length) + 4,
        }
    }
}

/// Reads a JPEG's segments up to the first scan.
fn read_jpeg(input: &mut (impl BufRead + Seek)) -> io::Result<Facts> {
    let mut frame = None;
    loop {
        let marker = read_marker(input)?;
        let length = u16::from_be_bytes(read_array(input)?);
        let length = i64::from(length.checked_sub(2).ok_or_else(|| invalid(DAMAGED))?);
        let next = input.stream_position()? as i64 + length;
        match marker {
            // Start of frame. The three excluded markers stand for tables and for an extension.
            0xC0..=0xCF if !matches!(marker, 0xC4 | 0xC8 | 0xCC) => frame = Some(read_frame(input, marker)?),
            // Start of scan.
            0xDA => {
                let frame = frame.ok_or_else(|| invalid(DAMAGED))?;
                let [components] = read_array(input)?;
                return Ok(Facts {
                    format: ImageFormat::Jpeg,
                    size_px: frame.size_px,
                    bytes_per_pixel: frame.bytes_per_pixel(components),
                    data_offset: next as u64,
                    is_in_order: !frame.is_in_scans(components) && matches!(frame.components, 1 | 3),
                    has_alpha: false,
                });
            }
            _ => {}
        }
        let here = input.stream_position()? as i64;
        input.seek_relative(next - here)?;
    }
}

const DAMAGED: &str = "is a damaged JPEG; fetch the picture again or leave it out";

/// Reads a marker and the padding in front of it; returns the marker's second byte.
fn read_marker(input: &mut impl Read) -> io::Result<u8> {
    let [first] = read_array(input)?;
    if first != 0xFF {
        return Err(invalid(DAMAGED));
    }
    loop {
        match read_array(input)? {
            [0xFF] => {}
            [marker @ 0xC0..=0xFE] if !matches!(marker, 0xD0..=0xD9) => return Ok(marker),
            _ => return Err(invalid(DAMAGED)),
        }
    }
}

/// The contents of a JPEG's start-of-frame segment.
struct Frame {
    size_px: [u32; 2],
    components: u8,
    progressive: bool,
}

impl Frame {
    /// Bytes per pixel that decoding allocates, including the conversion of grey to RGB. If the data
    /// of a pixel is spread over several scans, the decoder also keeps the 16-bit DCT coefficients.
    fn bytes_per_pixel(&self, scan_components: u8) -> u64 {
        let components = u64::from(self.components);
        let coefficients = if self.is_in_scans(scan_components) { 2 * components } else { 0 };
        coefficients + if components == 1 { 1 + 3 } else { 3 }
    }

    /// Whether the data of a pixel is spread over several scans. `scan_components` is the number of components of the first.
    fn is_in_scans(&self, scan_components: u8) -> bool {
        self.progressive || scan_components < self.components
    }
}

fn read_frame(input: &mut impl Read, marker: u8) -> io::Result<Frame> {
    let [_precision, h0, h1, w0, w1, components] = read_array(input)?;
    let size_px = [u16::from_be_bytes([w0, w1]).into(), u16::from_be_bytes([h0, h1]).into()];
    Ok(Frame { size_px, components, progressive: matches!(marker, 0xC2 | 0xC6 | 0xCA | 0xCE) })
}
