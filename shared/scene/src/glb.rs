//! The container of binary glTF 2.0 (Khronos, "glTF 2.0 Specification", §4.4): a header, a JSON chunk and a binary chunk.
//!
//! What it knows nothing about: what the chunks describe.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde_json::Value;

use crate::{SceneError, atomic};

/// Bytes of the headers of the file, of the JSON chunk and of the binary chunk.
const HEADS_BYTES: u64 = 12 + 8 + 8;

/// Writes a file, atomically. `fill` writes the `numbers_bytes` of the binary chunk, a multiple of four. `remedy` tells the
/// user what to do if the file would be larger than the format allows.
pub(crate) fn write(
    path: &Path,
    document: &Value,
    numbers_bytes: u64,
    remedy: &str,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), SceneError> {
    let mut json = document.to_string().into_bytes();
    // The length of a chunk must be a multiple of four bytes. JSON is padded with spaces.
    json.resize(json.len().next_multiple_of(4), b' ');
    let total_bytes = HEADS_BYTES + json.len() as u64 + numbers_bytes;
    let (Ok(total), Ok(numbers)) = (u32::try_from(total_bytes), u32::try_from(numbers_bytes)) else {
        return Err(SceneError::malformed(path, format!("exceeds the 4 GiB of a glb file; {remedy}")));
    };
    atomic::write(path, |out| {
        out.write_all(b"glTF")?;
        out.write_all([2, total, json.len() as u32].map(u32::to_le_bytes).as_flattened())?;
        out.write_all(b"JSON")?;
        out.write_all(&json)?;
        out.write_all(&numbers.to_le_bytes())?;
        out.write_all(b"BIN\0")?;
        fill(out)
    })
}
