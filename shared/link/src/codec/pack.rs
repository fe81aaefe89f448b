//! Compresses and decompresses one pack of a body ([`cosurf_wire::body`]) with zstd, within limits on
//! compression ratio and memory.

use std::io::{self, Read, Write};

use cosurf_wire::body::{BodyError, PackEntry, PackForm, PackKind, RATIO_MAX, WINDOW_LOG};

/// Compression level of zstd. The parser of this high level compresses planes with few non-zero values
/// better.
const LEVEL: i32 = 19;

/// Compresses a pack: `frame` (the reference values of a shapes pack, or a whole basis; otherwise empty) and
/// then planes of `plane_bytes` each. Stores the pack uncompressed if zstd saves nothing or compresses
/// beyond [`RATIO_MAX`].
pub(super) fn compress(frame: &[u8], planes: &[u8], plane_bytes: usize) -> io::Result<(PackForm, Vec<u8>)> {
    let mut encoder = zstd::Encoder::new(Vec::new(), LEVEL)?;
    encoder.window_log(WINDOW_LOG)?;
    // Because the encoder knows the size, its tables stay small.
    encoder.set_pledged_src_size(Some((frame.len() + planes.len()) as u64))?;
    encoder.write_all(frame)?;
    for plane in planes.chunks(plane_bytes.max(1)) {
        encoder.flush()?;
        encoder.write_all(plane)?;
    }
    let packed = encoder.finish()?;
    let unpacked_bytes = frame.len() + planes.len();
    if packed.len() < unpacked_bytes && unpacked_bytes <= RATIO_MAX * packed.len() {
        return Ok((PackForm::Zstd, packed));
    }
    Ok((PackForm::Stored, [frame, planes].concat()))
}

/// Makes the table entry of a pack. `bytes` are the bytes of the pack in the body.
pub(super) fn make_entry(
    kind: PackKind,
    layer: u8,
    splats: usize,
    form: PackForm,
    bytes: &[u8],
) -> PackEntry {
    PackEntry {
        kind,
        form,
        layer,
        splats: splats as u16,
        bytes: bytes.len() as u32,
        crc32: crc32fast::hash(bytes),
    }
}

/// Unpacks `bytes`, the pack that `entry` describes. The unpacked bytes must fill `out` exactly. The zstd
/// window limits the memory of the decoder.
pub(super) fn unpack(entry: &PackEntry, bytes: &[u8], out: &mut [u8]) -> Result<(), BodyError> {
    if crc32fast::hash(bytes) != entry.crc32 {
        return Err(BodyError::BadPack);
    }
    match entry.form {
        PackForm::Stored if bytes.len() == out.len() => {
            out.copy_from_slice(bytes);
            Ok(())
        }
        PackForm::Zstd if out.len() <= RATIO_MAX * bytes.len() => {
            read_frame(bytes, out).map_err(|_| BodyError::BadPack)
        }
        PackForm::Stored | PackForm::Zstd => Err(BodyError::BadPack),
    }
}

fn read_frame(bytes: &[u8], out: &mut [u8]) -> io::Result<()> {
    let mut decoder = zstd::Decoder::with_buffer(bytes)?.single_frame();
    decoder.window_log_max(WINDOW_LOG)?;
    decoder.read_exact(out)?;
    let has_more = decoder.read(&mut [0])? > 0;
    let has_trailer = !decoder.finish().is_empty();
    if has_more || has_trailer { Err(io::ErrorKind::InvalidData.into()) } else { Ok(()) }
}
