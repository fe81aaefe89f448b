//! A JPEG without the segments that say nothing about its pixels. Decoders keep profiles and other metadata, and a forged
//! file has hundreds of megabytes of them.
//!
//! What it knows nothing about: how pixels are decoded.

use std::io::{self, BufRead, Read};

/// The segments of the camera's data (EXIF) and of XMP.
const APP1: u8 = 0xE1;
/// Number of them that a head keeps: that of EXIF may come behind some of XMP.
const APP1_KEPT: u32 = 4;
/// Start of a scan: compressed pixels follow its segment.
const SCAN: u8 = 0xDA;
/// End of the picture.
const END: u8 = 0xD9;

/// Reads a JPEG, without what is left out, up to the end of its picture.
pub(super) struct Segments<R> {
    input: R,
    /// Number of segments [`APP1`] that are still kept.
    app1_left: u32,
    /// Whether the file ends, for the reader, before the compressed pixels.
    is_head_only: bool,
    /// Bytes that come before those of the input.
    pending: Vec<u8>,
    place: Place,
}

/// Where the input is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Before a marker.
    Marker,
    /// In a segment that is kept, so many bytes before its end.
    Segment { left: u64, is_scan: bool },
    /// In compressed pixels.
    Pixels,
    /// Behind the picture.
    End,
}

impl<R: BufRead> Segments<R> {
    /// All that decoding the pixels needs: nothing of metadata.
    pub(super) fn of_pixels(input: R) -> Self {
        Self { input, app1_left: 0, is_head_only: false, pending: Vec::new(), place: Place::Marker }
    }

    /// The head, up to the first compressed pixel, with the first segments of EXIF and XMP.
    pub(super) fn of_head(input: R) -> Self {
        Self { app1_left: APP1_KEPT, is_head_only: true, ..Self::of_pixels(input) }
    }

    /// Reads a marker, and skips the segments that are left out.
    fn marker(&mut self) -> io::Result<()> {
        // What is between segments is no part of them; decoders pass over it.
        while self.byte()? != 0xFF {}
        let mut code = self.byte()?;
        while code == 0xFF {
            code = self.byte()?;
        }
        self.follow(code)
    }

    /// Goes on behind a marker.
    fn follow(&mut self, code: u8) -> io::Result<()> {
        self.pending.extend([0xFF, code]);
        self.place = match code {
            END => Place::End,
            // Markers without a segment.
            0x00 | 0x01 | 0xD0..=0xD8 => Place::Marker,
            _ => return self.segment(code),
        };
        Ok(())
    }

    fn segment(&mut self, code: u8) -> io::Result<()> {
        let length = [self.byte()?, self.byte()?];
        let left = u64::from(u16::from_be_bytes(length)).saturating_sub(2);
        let is_kept = match code {
            APP1 if self.app1_left > 0 => {
                self.app1_left -= 1;
                true
            }
            // APP0 and APP14 tell how colours are stored. 0xFE is a comment.
            0xE1..=0xED | 0xEF | 0xFE => false,
            _ => true,
        };
        if is_kept {
            self.pending.extend(length);
            self.place = Place::Segment { left, is_scan: code == SCAN };
        } else {
            self.pending.truncate(self.pending.len() - 2);
            io::copy(&mut self.input.by_ref().take(left), &mut io::sink())?;
            self.place = Place::Marker;
        }
        Ok(())
    }

    /// Reads compressed pixels up to the next marker, or until `out` is full. Returns the number of bytes in `out`.
    fn pixels(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let bytes = self.input.fill_buf()?;
        let most = bytes.len().min(out.len());
        let plain = bytes[..most].iter().position(|byte| *byte == 0xFF).unwrap_or(most);
        if plain > 0 || most == 0 {
            out[..plain].copy_from_slice(&bytes[..plain]);
            self.input.consume(plain);
            return Ok(plain);
        }
        self.input.consume(1);
        match self.byte()? {
            // A byte of 0xFF among the pixels, or a restart.
            code @ (0x00 | 0xD0..=0xD7) => self.pending.extend([0xFF, code]),
            0xFF => self.pending.push(0xFF),
            code => self.follow(code)?,
        }
        Ok(0)
    }

    fn byte(&mut self) -> io::Result<u8> {
        let mut byte = [0];
        self.input.read_exact(&mut byte)?;
        Ok(byte[0])
    }
}

impl<R: BufRead> Read for Segments<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while !out.is_empty() {
            if !self.pending.is_empty() {
                let count = self.pending.len().min(out.len());
                out[..count].copy_from_slice(&self.pending[..count]);
                self.pending.drain(..count);
                return Ok(count);
            }
            match self.place {
                Place::Marker => self.marker()?,
                Place::Segment { left: 0, is_scan } => {
                    self.place = match is_scan {
                        true if self.is_head_only => Place::End,
                        true => Place::Pixels,
                        false => Place::Marker,
                    };
                }
                Place::Segment { left, is_scan } => {
                    let most = usize::try_from(left).unwrap_or(usize::MAX).min(out.len());
                    let count = self.input.read(&mut out[..most])?;
                    if count == 0 {
                        return Err(io::ErrorKind::UnexpectedEof.into());
                    }
                    self.place = Place::Segment { left: left - count as u64, is_scan };
                    return Ok(count);
                }
                Place::Pixels => match self.pixels(out)? {
                    0 if self.pending.is_empty() && self.place == Place::Pixels => return Ok(0),
                    0 => {}
                    count => return Ok(count),
                },
                Place::End => return Ok(0),
            }
        }
        Ok(0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn segment(code: u8, content: &[u8]) -> Vec<u8> {
        let length = (content.len() as u16 + 2).to_be_bytes();
        [&[0xFF, code], &length[..], content].concat()
    }

    fn read(mut segments: Segments<&[u8]>) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        segments.read_to_end(&mut bytes).map(|_| bytes)
    }

    #[test]
    fn metadata_is_left_out_before_and_behind_the_pixels() {
        let (icc, exif) = (segment(0xE2, &[7; 900]), segment(APP1, b"Exif"));
        let (jfif, table) = (segment(0xE0, b"JFIF"), segment(0xDB, &[1; 64]));
        let (start, scan) = (&[0xFF, 0xD8][..], segment(SCAN, &[1, 2, 3]));
        let pixels = [5, 0xFF, 0x00, 6, 0xFF, 0xD3, 7];
        let end = [0xFF, END];
        let whole =
            [start, &icc, &exif.repeat(5), &jfif, &exif, &table, &scan, &pixels, &icc, &end, b"thumbnail"]
                .concat();
        let kept = [start, &jfif, &table, &scan, &pixels, &end].concat();
        assert_eq!(read(Segments::of_pixels(&whole)).unwrap(), kept);
        let head = [start, &exif.repeat(4), &jfif, &table, &scan].concat();
        assert_eq!(read(Segments::of_head(&whole)).unwrap(), head);
        for cut in 0..whole.len() {
            let _ = read(Segments::of_pixels(&whole[..cut])); // an error or a shorter picture, and an end
        }
    }
}
