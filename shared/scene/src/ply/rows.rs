//! Reads the values after a PLY's header, row by row, and converts them to `f64` from any number type and
//! either format.

use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::ops::ControlFlow;
use std::path::Path;

use glam::DVec3;

use super::header::{Element, Format, Header, Kind, Scalar};
use crate::error::Refusal;
use crate::{SceneError, files};

/// Size of the read buffer, bytes.
const BUFFER_BYTES: usize = 256 * 1024;

/// Reading a number in an ascii file stops beyond this length, bytes, so that a file without spaces cannot
/// fill the memory.
const WORD_BYTES_MAX: usize = 64;

/// Calls `visit` with each element of `path` and its rows, in file order. Before each call, checks that the
/// file is long enough for the rows. Skips the rows that `visit` does not read.
pub(crate) fn read_elements(
    path: &Path,
    mut visit: impl FnMut(&Element, &mut Rows) -> Result<(), Refusal>,
) -> Result<(), SceneError> {
    visit_elements(path, |element, rows| visit(element, rows).map(ControlFlow::<()>::Continue)).map(|_| ())
}

/// Calls `read` with the element called `vertex` of `path` and with its rows. Reads nothing after this
/// element.
pub(super) fn read_vertices<T>(
    path: &Path,
    mut read: impl FnMut(&Element, &mut Rows) -> Result<T, Refusal>,
) -> Result<T, SceneError> {
    let found = visit_elements(path, |element, rows| match element.name.as_str() {
        "vertex" => read(element, rows).map(ControlFlow::Break),
        _ => Ok(ControlFlow::Continue(())),
    });
    found?.ok_or_else(|| SceneError::malformed(path, "has no element called vertex"))
}

/// Checks that a file begins with the header of a PLY and is long enough for its first element. Reads only the header.
pub fn check_length(path: &Path) -> Result<(), SceneError> {
    visit_elements(path, |_, _| Ok(ControlFlow::Break(()))).map(drop)
}

/// Calls `visit` with each element and its rows until `visit` returns a break. Returns the value of the
/// break; `None` if there was no break.
fn visit_elements<T>(
    path: &Path,
    mut visit: impl FnMut(&Element, &mut Rows) -> Result<ControlFlow<T>, Refusal>,
) -> Result<Option<T>, SceneError> {
    let file = files::open(path)?;
    let result = file.metadata().map_err(Refusal::from).and_then(|metadata| {
        let mut input = BufReader::with_capacity(BUFFER_BYTES, file);
        let header = Header::read(&mut input)?;
        let mut left_bytes = metadata.len().saturating_sub(header.size_bytes);
        for element in &header.elements {
            left_bytes = check_size(element, header.format, left_bytes)?;
            let mut rows = Rows::new(&mut input, &header, element);
            if let ControlFlow::Break(found) = visit(element, &mut rows)? {
                return Ok(Some(found));
            }
            while rows.next()?.is_some() {}
        }
        Ok(None)
    });
    result.map_err(|refusal| refusal.of(path))
}

/// Refuses an element with more rows than `left_bytes` can hold, or with rows without properties. Returns
/// the largest number of bytes that can be left for the elements that follow.
fn check_size(element: &Element, format: Format, left_bytes: u64) -> Result<u64, Refusal> {
    let row_bytes = element.row_bytes_min(format);
    // The last number of an ascii file needs no separator after it, so the file may be one byte shorter.
    let slack = u64::from(format == Format::Ascii);
    let needed = u128::from(element.count) * u128::from(row_bytes);
    if needed > u128::from(left_bytes + slack) || (row_bytes == 0 && element.count > 0) {
        return Err(format!(
            "claims {} rows of element {}, but only {left_bytes} bytes are left for them; the file was cut short or is forged",
            element.count, element.name
        )
        .into());
    }
    Ok((left_bytes + slack - needed as u64).min(left_bytes))
}

/// The rows of one element.
pub(crate) struct Rows<'a> {
    input: &'a mut BufReader<File>,
    format: Format,
    element: &'a Element,
    origin: DVec3,
    /// Whether all values are 32-bit floats in binary.
    is_flat: bool,
    row: u64,
    word: Vec<u8>,
    values: Vec<f64>,
}

impl<'a> Rows<'a> {
    fn new(input: &'a mut BufReader<File>, header: &Header, element: &'a Element) -> Self {
        let &Header { format, origin, .. } = header;
        let is_float = |kind: Kind| matches!(kind, Kind::One(Scalar::F32));
        let is_flat =
            format == Format::Binary && element.properties.iter().all(|property| is_float(property.kind));
        Self { input, format, element, origin, is_flat, row: 0, word: Vec::new(), values: Vec::new() }
    }

    /// The world position that the file's positions are relative to.
    pub(crate) fn origin(&self) -> DVec3 {
        self.origin
    }

    /// The next row, one value per property (0 for lists), or `None` after the last.
    pub(crate) fn next(&mut self) -> Result<Option<&[f64]>, Refusal> {
        let some = self.row(None)?;
        Ok(some.then_some(&self.values))
    }

    /// Reads the next row, and puts the items of the list in column `column` into `list`. Returns false
    /// after the last row.
    pub(crate) fn next_list(&mut self, column: usize, list: &mut Vec<f64>) -> Result<bool, Refusal> {
        list.clear();
        self.row(Some((column, list)))
    }

    fn row(&mut self, mut keep: Option<(usize, &mut Vec<f64>)>) -> Result<bool, Refusal> {
        let element = self.element;
        if self.row == element.count {
            return Ok(false);
        }
        self.values.clear();
        if self.is_flat {
            self.flat_row().map_err(|refusal| refusal.at(self.place()))?;
            self.row += 1;
            return Ok(true);
        }
        for (column, property) in element.properties.iter().enumerate() {
            let keep = keep.as_mut().filter(|(kept, _)| *kept == column).map(|(_, list)| &mut **list);
            let value = self.property(property.kind, keep).map_err(|refusal| refusal.at(self.place()))?;
            self.values.push(value);
        }
        self.row += 1;
        Ok(true)
    }

    /// Reads a row of 32-bit floats at once. Reading them one by one took 4 % of the time of the aggregator's gate.
    fn flat_row(&mut self) -> Result<(), Refusal> {
        self.word.resize(size_of::<f32>() * self.element.properties.len(), 0);
        self.input.read_exact(&mut self.word)?;
        let (floats, _) = self.word.as_chunks();
        self.values.extend(floats.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))));
        Ok(())
    }

    /// Reads a number and returns it. For a list, returns 0 and appends its items to `keep`; if `keep` is
    /// `None`, the items are skipped.
    fn property(&mut self, kind: Kind, mut keep: Option<&mut Vec<f64>>) -> Result<f64, Refusal> {
        match kind {
            Kind::One(scalar) => self.value(scalar),
            Kind::List { count, item } => {
                for _ in 0..self.value(count)? as u64 {
                    let value = self.value(item)?;
                    if let Some(list) = &mut keep {
                        list.push(value);
                    }
                }
                Ok(0.0)
            }
        }
    }

    fn value(&mut self, scalar: Scalar) -> Result<f64, Refusal> {
        match self.format {
            Format::Ascii => self.word(),
            Format::Binary => self.binary(scalar),
        }
    }

    fn binary(&mut self, scalar: Scalar) -> Result<f64, Refusal> {
        Ok(match scalar {
            Scalar::I8 => f64::from(i8::from_le_bytes(self.bytes()?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(self.bytes()?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(self.bytes()?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(self.bytes()?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(self.bytes()?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(self.bytes()?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(self.bytes()?)),
            Scalar::F64 => f64::from_le_bytes(self.bytes()?),
        })
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], Refusal> {
        let mut bytes = [0; N];
        self.input.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    fn word(&mut self) -> Result<f64, Refusal> {
        self.word.clear();
        while let Some(&byte) = self.input.fill_buf()?.first() {
            if byte.is_ascii_whitespace() && !self.word.is_empty() {
                break;
            }
            self.input.consume(1);
            if !byte.is_ascii_whitespace() {
                self.word.push(byte);
            }
            if self.word.len() > WORD_BYTES_MAX {
                break;
            }
        }
        if self.word.is_empty() {
            return Err(Refusal::Io(ErrorKind::UnexpectedEof.into()));
        }
        let word = String::from_utf8_lossy(&self.word);
        word.parse().map_err(|_| format!("'{}' is not a number", word.escape_default()).into())
    }

    fn place(&self) -> String {
        format!("{} {} of {}", self.element.name, self.row, self.element.count)
    }
}
