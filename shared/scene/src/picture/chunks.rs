//! A PNG without the chunks that say nothing about its pixels. Decoders keep profiles and other metadata, and a forged file
//! has hundreds of megabytes of them.
//!
//! What it knows nothing about: how pixels are decoded.

use std::io::{self, ErrorKind, Read, Seek, SeekFrom};

use super::header::invalid;

/// Limit on the bytes of a chunk that is kept, other than those of pixels: a palette takes 768.
const KEPT_BYTES_MAX: u32 = 1 << 16;
/// Limit on the bytes of the camera's data (EXIF) that a head keeps.
const EXIF_BYTES_MAX: u32 = 1 << 20;
/// A checksum follows the content of each chunk.
const CHECKSUM_BYTES: u64 = 4;

/// Reads a PNG without what is left out.
pub(super) struct Chunks<R> {
    input: R,
    keeps_exif: bool,
    /// Bytes that come before those of the input.
    pending: Vec<u8>,
    /// Bytes until the next chunk.
    left: u64,
    is_over: bool,
}

impl<R: Read + Seek> Chunks<R> {
    /// All that decoding the pixels needs: nothing of metadata.
    pub(super) fn of_pixels(mut input: R) -> io::Result<Self> {
        let mut signature = vec![0; 8];
        input.read_exact(&mut signature)?;
        Ok(Self { input, keeps_exif: false, pending: signature, left: 0, is_over: false })
    }

    /// With the data of the camera, if they are no larger than usual.
    pub(super) fn with_exif(input: R) -> io::Result<Self> {
        Ok(Self { keeps_exif: true, ..Self::of_pixels(input)? })
    }

    /// Reads the head of the next chunk, or passes over the chunk.
    fn next_chunk(&mut self) -> io::Result<()> {
        let mut head = [0; 8];
        if self.input.read(&mut head[..1])? == 0 {
            self.is_over = true;
            return Ok(());
        }
        self.input.read_exact(&mut head[1..])?;
        let [l0, l1, l2, l3, name @ ..] = head;
        let length = u32::from_be_bytes([l0, l1, l2, l3]);
        let with_checksum = u64::from(length) + CHECKSUM_BYTES;
        // The first letter of a chunk that decoders must know is a capital.
        let is_kept = match &name {
            b"IDAT" => true,
            b"eXIf" => self.keeps_exif && length <= EXIF_BYTES_MAX,
            _ if name[0].is_ascii_uppercase() || name == *b"tRNS" => {
                if length > KEPT_BYTES_MAX {
                    return Err(invalid("a chunk is too long"));
                }
                true
            }
            _ => false,
        };
        if is_kept {
            self.pending.extend(head);
            self.left = with_checksum;
            self.is_over = name == *b"IEND";
        } else {
            self.input.seek(SeekFrom::Current(with_checksum as i64))?;
        }
        Ok(())
    }
}

impl<R: Read + Seek> Read for Chunks<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        loop {
            if !self.pending.is_empty() || out.is_empty() {
                let count = self.pending.len().min(out.len());
                out[..count].copy_from_slice(&self.pending[..count]);
                self.pending.drain(..count);
                return Ok(count);
            }
            if self.left > 0 {
                let most = usize::try_from(self.left).unwrap_or(usize::MAX).min(out.len());
                let count = self.input.read(&mut out[..most])?;
                self.left -= count as u64;
                return Ok(count);
            }
            if self.is_over {
                return Ok(0);
            }
            self.next_chunk()?;
        }
    }
}

/// Decoders ask for it, and do not use it.
impl<R> Seek for Chunks<R> {
    fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
        Err(ErrorKind::Unsupported.into())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::Cursor;

    use super::*;

    fn chunk(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32).to_be_bytes()[..], name, content, b"sum."].concat()
    }

    fn read(file: &[u8]) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        Chunks::of_pixels(Cursor::new(file))?.read_to_end(&mut bytes).map(|_| bytes)
    }

    #[test]
    fn metadata_is_left_out_before_between_and_behind_the_pixels() {
        let [head, palette, pixels, more, end] =
            [(b"IHDR", 13), (b"PLTE", 9), (b"IDAT", 100_000), (b"IDAT", 5), (b"IEND", 0)]
                .map(|(name, length)| chunk(name, &vec![7; length]));
        let clear = chunk(b"tRNS", &[1]);
        let others = [(b"eXIf", 70_000), (b"tEXt", 5), (b"iCCP", 0)];
        let others = others.map(|(name, length)| chunk(name, &vec![8; length])).concat();
        let whole = [
            &b"\x89PNG\r\n\x1a\n"[..],
            &head,
            &others,
            &palette,
            &clear,
            &pixels,
            &others,
            &more,
            &others,
            &end,
            b"behind the end",
        ];
        let whole = whole.concat();
        let kept = [&b"\x89PNG\r\n\x1a\n"[..], &head, &palette, &clear, &pixels, &more, &end].concat();
        assert!(read(&whole).unwrap() == kept);
        let mut with_exif = Vec::new();
        Chunks::with_exif(Cursor::new(&whole)).unwrap().read_to_end(&mut with_exif).unwrap();
        assert_eq!(with_exif.len(), kept.len() + 3 * (70_000 + 12));
        for cut in (0..whole.len()).step_by(777) {
            let _ = read(&whole[..cut]); // an error or a shorter picture, and an end
        }
        let forged = [&b"\x89PNG\r\n\x1a\n"[..], &head, &chunk(b"PLTE", &vec![0; 70_000])].concat();
        assert!(read(&forged).is_err());
    }
}
