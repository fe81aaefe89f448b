//! Opens the columns of an SPZ file (positions, opacities and so on), each with a decoder of its own, so that the splats can
//! be read one after the other in little memory.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

use flate2::read::GzDecoder;

use super::header::{HEAD_BYTES, Header, Version};
use crate::error::Refusal;

/// Bytes of the head of a file of version 4, which is not compressed.
pub(super) const V4_HEAD_BYTES: u32 = 32;
/// Bytes of an entry of version 4's table: the sizes of a column, compressed and not.
const ENTRY_BYTES: u64 = 16;
/// Largest accepted window of zstd, as a power of two, bytes: that of its levels up to 19.
const WINDOW_LOG_MAX: u32 = 23;

/// Bytes after the last column that are read for the checksum behind them.
const MORE_BYTES_MAX: u64 = 64 << 20;

/// One column of a file.
pub(super) type Column = Box<dyn Read>;

/// The head of a file, checked against the file's length.
pub(super) fn read_header(path: &Path) -> Result<Header, Refusal> {
    let mut file = BufReader::new(File::open(path)?);
    let bytes = file.get_ref().metadata()?.len();
    let mut begin = [0; 2];
    file.read_exact(&mut begin)?;
    file.rewind()?;
    let not_spz = |refusal| match refusal {
        Refusal::Io(_) => "is not an SPZ file: it holds no gzip stream with an SPZ header".into(),
        content => content,
    };
    let is_gzip = begin == [0x1f, 0x8b];
    let header = match is_gzip {
        true => Header::read(&mut GzDecoder::new(file)).map_err(not_spz)?,
        false => Header::read(&mut file)?,
    };
    if is_gzip == (header.version == Version::V4) {
        return Err("is not an SPZ file: its version does not belong to its compression".into());
    }
    header.check_length(bytes)?;
    Ok(header)
}

/// The columns of the file with this head.
pub(super) fn open(path: &Path, header: &Header) -> Result<[Column; 6], Refusal> {
    if header.version == Version::V4 { open_zstd(path, header) } else { open_gzip(path, header) }
}

/// One stream has the head and all columns: each decoder skips what is before its column. That of the last one reads to the
/// end of the stream, which has a checksum of all.
fn open_gzip(path: &Path, header: &Header) -> Result<[Column; 6], Refusal> {
    let mut before_bytes = HEAD_BYTES as u64;
    let columns = header.columns();
    let all_bytes = before_bytes + header.splats as u64 * columns.iter().sum::<usize>() as u64;
    each(header, |bytes| {
        let mut gzip = GzDecoder::new(BufReader::new(File::open(path)?));
        let skipped = io::copy(&mut (&mut gzip).take(before_bytes), &mut io::sink())?;
        if skipped < before_bytes {
            return Err(Refusal::Io(ErrorKind::UnexpectedEof.into()));
        }
        before_bytes += bytes;
        match bytes > 0 && before_bytes == all_bytes {
            true => Ok(Box::new(BufReader::new(ToTheEnd { stream: gzip, left: bytes }))),
            false => Ok(Box::new(BufReader::new(gzip.take(bytes)))),
        }
    })
}

/// The last column of a stream. With its last byte, it reads what follows, so that the stream's checksum is compared. Streams of
/// zstd need not have one.
struct ToTheEnd<R> {
    stream: R,
    /// Bytes of the column that are not read yet.
    left: u64,
}

impl<R: Read> Read for ToTheEnd<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = (&mut self.stream).take(self.left).read(out)?;
        self.left -= read as u64;
        if self.left == 0 && read > 0 {
            // Later versions may have more columns.
            let more = io::copy(&mut (&mut self.stream).take(MORE_BYTES_MAX), &mut io::sink());
            more.map_err(|_| io::Error::new(ErrorKind::InvalidData, "its checksum does not match"))?;
        }
        Ok(read)
    }
}

/// A table tells the sizes of the streams. Empty columns have no stream.
fn open_zstd(path: &Path, header: &Header) -> Result<[Column; 6], Refusal> {
    let mut file = BufReader::new(File::open(path)?);
    let file_bytes = file.get_ref().metadata()?.len();
    file.seek(SeekFrom::Start(HEAD_BYTES as u64 - 1))?;
    let [streams] = read_array(&mut file)?;
    let table_at = u64::from(u32::from_le_bytes(read_array(&mut file)?));
    let expected = header.columns().iter().filter(|bytes| **bytes * header.splats > 0).count();
    if usize::from(streams) != expected || table_at < u64::from(V4_HEAD_BYTES) {
        return Err(
            "has another number of streams than its splats need; the file is damaged, fetch it again".into(),
        );
    }
    file.seek(SeekFrom::Start(table_at))?;
    let mut stream_at = table_at + ENTRY_BYTES * u64::from(streams);
    each(header, |bytes| {
        if bytes == 0 {
            return Ok(Box::new(io::empty()));
        }
        let [packed_bytes, unpacked_bytes] =
            [read_array(&mut file)?, read_array(&mut file)?].map(u64::from_le_bytes);
        if unpacked_bytes != bytes || packed_bytes > file_bytes.saturating_sub(stream_at) {
            return Err(
                "has streams of wrong sizes; the file was cut short or is damaged, fetch it again".into()
            );
        }
        let mut stream = File::open(path)?;
        stream.seek(SeekFrom::Start(stream_at))?;
        stream_at += packed_bytes;
        let mut zstd = zstd::Decoder::new(stream.take(packed_bytes))?;
        zstd.window_log_max(WINDOW_LOG_MAX)?;
        Ok(Box::new(BufReader::new(ToTheEnd { stream: zstd, left: bytes })))
    })
}

fn read_array<const N: usize>(input: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    input.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// Opens each column, with its size before compression, bytes.
fn each(
    header: &Header,
    mut open: impl FnMut(u64) -> Result<Column, Refusal>,
) -> Result<[Column; 6], Refusal> {
    let mut columns: [Column; 6] = std::array::from_fn(|_| Box::new(io::empty()) as Column);
    for (column, bytes) in columns.iter_mut().zip(header.columns()) {
        *column = open(header.splats as u64 * bytes as u64)?;
    }
    Ok(columns)
}
