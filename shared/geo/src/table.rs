//! Lists of places as ODM defines them: a line with the coordinate system, then lines of words and numbers.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::crs::Crs;
use crate::error::GeoError;

/// Largest accepted file, bytes: a line for each of a hundred thousand photographs.
const FILE_BYTES_MAX: u64 = 16 << 20;

/// A list: its system, and its lines with their numbers from 1, without empty ones and comments.
pub(crate) struct Table {
    pub(crate) crs: Crs,
    pub(crate) lines: Vec<(usize, String)>,
}

impl Table {
    pub(crate) fn read(path: &Path) -> Result<Self, GeoError> {
        let refuse = |reason: String| GeoError::Refused { path: path.into(), reason };
        let mut bytes = Vec::new();
        let file = File::open(path).map_err(|cause| GeoError::Io { path: path.into(), cause })?;
        file.take(FILE_BYTES_MAX + 1)
            .read_to_end(&mut bytes)
            .map_err(|cause| GeoError::Io { path: path.into(), cause })?;
        if bytes.len() as u64 > FILE_BYTES_MAX {
            return Err(refuse("is larger than 16 MiB; it is no list of places".into()));
        }
        let text = String::from_utf8(bytes).map_err(|_| refuse("is not a text in UTF-8".into()))?;
        let text = text.strip_prefix('\u{FEFF}').unwrap_or(&text);
        let lines = (1..).zip(text.lines().map(|line| line.trim().to_owned()));
        let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let (_, first) = lines.next().ok_or_else(|| refuse("is empty".into()))?;
        let crs = Crs::parse(&first).map_err(|error| refuse(error.to_string()))?;
        Ok(Self { crs, lines: lines.collect() })
    }
}

/// A finite number, or `None`.
pub(crate) fn number(word: &str) -> Option<f64> {
    word.parse().ok().filter(|number: &f64| number.is_finite())
}
