//! Embeds pictures in a page as JPEG `data:` URIs, so that the page is one file. Pictures that wait for their page take a
//! tenth of the memory that their pixels would.

use cosurf_scene::Picture;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageError};

/// JPEG quality, 1 to 100, at which the borders of JPEG's blocks are not visible.
const JPEG_QUALITY: u8 = 88;
const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/// A picture for a page, with a caption in plain text.
pub(crate) struct Captioned {
    pub(super) caption: String,
    pub(super) size_px: [u32; 2],
    /// The picture as a URI for the `src` of an `<img>`.
    pub(super) uri: String,
}

impl Captioned {
    pub(crate) fn new(caption: impl Into<String>, picture: &Picture) -> Result<Self, ImageError> {
        Ok(Self { caption: caption.into(), size_px: picture.size_px, uri: data_uri(picture)? })
    }
}

fn data_uri(picture: &Picture) -> Result<String, ImageError> {
    let mut jpeg = Vec::new();
    let [width, height] = picture.size_px;
    JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY).encode(
        &picture.rgb,
        width,
        height,
        ExtendedColorType::Rgb8,
    )?;
    Ok(format!("data:image/jpeg;base64,{}", base64(&jpeg)))
}

/// Base64 of RFC 4648 §4, with padding.
pub(super) fn base64(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |i: usize| u32::from(chunk.get(i).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for i in 0..4 {
            let digit = ALPHABET[(bits >> (18 - 6 * i) & 63) as usize];
            text.push(if i <= chunk.len() { digit as char } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Uses the test vectors of RFC 4648 §10, and bytes that give the digits `+` and `/`.
    #[test]
    fn base64_matches_the_test_vectors() {
        for (bytes, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xfb, 0xff]), "+/8=");
    }

    #[test]
    fn a_picture_becomes_a_jpeg() {
        let uri = data_uri(&Picture::new([2, 1], vec![255, 0, 0, 255, 0, 0])).unwrap();
        assert!(uri.starts_with("data:image/jpeg;base64,/9j/"), "{uri}");
    }
}
