//! The text header of a PLY: the file's format, and each element's properties with their types.

use std::io::{self, BufRead, Read};

use glam::DVec3;

use crate::ORIGIN_MAX;
use crate::error::Refusal;

/// Longest accepted header, bytes; the header of a file of splats has about 1,500.
const HEADER_BYTES_MAX: u64 = 1 << 16;

/// Encoding of the values after the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// Numbers as text, separated by white space.
    Ascii,
    /// Little-endian binary.
    Binary,
}

/// The type of a number in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Size of a number of this type in a binary file, bytes.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// What a property holds in each row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// One number.
    One(Scalar),
    /// A count, then that many numbers.
    List { count: Scalar, item: Scalar },
}

/// A named column of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Property {
    pub(crate) name: String,
    pub(crate) kind: Kind,
}

/// A table of the file: `count` rows with the columns `properties`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Element {
    pub(crate) name: String,
    pub(crate) count: u64,
    pub(crate) properties: Vec<Property>,
}

impl Element {
    /// Index of the property called `name`; `None` if it is missing or holds lists.
    pub(crate) fn column(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && matches!(p.kind, Kind::One(_)))
    }

    /// The fewest bytes that a row can take in a file of `format`.
    pub(super) fn row_bytes_min(&self, format: Format) -> u64 {
        let bytes = |property: &Property| match (format, property.kind) {
            (Format::Ascii, _) => 2,
            (Format::Binary, Kind::One(scalar) | Kind::List { count: scalar, .. }) => scalar.size() as u64,
        };
        self.properties.iter().map(bytes).sum()
    }
}

/// A parsed header.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Header {
    pub(super) format: Format,
    pub(super) elements: Vec<Element>,
    /// The world position that positions are relative to.
    pub(super) origin: DVec3,
    /// Length of the header, bytes. The values follow the header.
    pub(super) size_bytes: u64,
}

impl Header {
    /// Reads the header and leaves `input` at the first value.
    pub(super) fn read(input: &mut impl BufRead) -> Result<Self, Refusal> {
        let mut lines = Lines { input: input.take(HEADER_BYTES_MAX), line: Vec::new(), size_bytes: 0 };
        if lines.next()? != "ply" {
            return Err("is not a PLY file: it does not begin with 'ply'".into());
        }
        let mut format = None;
        let mut elements = Vec::new();
        let mut origin = DVec3::ZERO;
        loop {
            let line = lines.next()?;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["comment", "origin", x, y, z] => origin = parse_origin([x, y, z]).unwrap_or(origin),
                [] | ["comment", ..] | ["obj_info", ..] => {}
                ["format", name, "1.0"] => format = Some(parse_format(name)?),
                ["element", name, count] => elements.push(parse_element(name, count)?),
                ["property", ref kind @ .., name] => {
                    let element = elements.last_mut().ok_or("names a property before any element")?;
                    add_property(element, kind, name)?;
                }
                ["end_header"] => break,
                _ => return Err(format!("the header's line '{line}' is not understood").into()),
            }
        }
        let format = format.ok_or("the header names no format")?;
        Ok(Self { format, elements, origin, size_bytes: lines.size_bytes })
    }
}

/// The line of the header that tells the origin; nothing for an origin of zero.
pub(crate) fn origin_line(origin: DVec3) -> String {
    if origin == DVec3::ZERO {
        return String::new();
    }
    format!("comment origin {} {} {}\n", origin.x, origin.y, origin.z)
}

/// `None` if the words are not a position on earth: then they are a comment of another tool.
fn parse_origin(words: [&str; 3]) -> Option<DVec3> {
    let mut numbers =
        words.map(|word| word.parse().ok().filter(|it: &f64| it.abs() <= ORIGIN_MAX)).into_iter();
    Some(DVec3::new(numbers.next()??, numbers.next()??, numbers.next()??))
}

fn parse_format(name: &str) -> Result<Format, Refusal> {
    match name {
        "ascii" => Ok(Format::Ascii),
        "binary_little_endian" => Ok(Format::Binary),
        "binary_big_endian" => {
            Err("is written big-endian; save it again as binary little-endian or ascii".into())
        }
        _ => Err(format!("the format '{name}' is not known").into()),
    }
}

fn parse_element(name: &str, count: &str) -> Result<Element, Refusal> {
    let wrong = |_| format!("the count '{count}' of element {name} is not a whole number");
    Ok(Element { name: name.into(), count: count.parse().map_err(wrong)?, properties: Vec::new() })
}

fn add_property(element: &mut Element, kind: &[&str], name: &str) -> Result<(), Refusal> {
    let scalar = |word: &str| {
        Scalar::parse(word).ok_or_else(|| format!("the type '{word}' of property {name} is not known"))
    };
    let kind = match *kind {
        [one] => Kind::One(scalar(one)?),
        ["list", count, item] => Kind::List { count: scalar(count)?, item: scalar(item)? },
        _ => return Err(format!("the type of property {name} is not understood").into()),
    };
    if element.properties.iter().any(|property| property.name == name) {
        return Err(format!("element {} has two properties called {name}", element.name).into());
    }
    element.properties.push(Property { name: name.into(), kind });
    Ok(())
}

/// Reads the lines of a header; counts and limits their bytes.
struct Lines<R> {
    input: io::Take<R>,
    line: Vec<u8>,
    size_bytes: u64,
}

impl<R: BufRead> Lines<R> {
    fn next(&mut self) -> Result<&str, Refusal> {
        self.line.clear();
        self.size_bytes += self.input.read_until(b'\n', &mut self.line)? as u64;
        if self.line.pop() != Some(b'\n') {
            return Err("the header has no end; the file is not a PLY file or was cut short".into());
        }
        let line = std::str::from_utf8(&self.line).map_err(|_| "the header is not UTF-8 text")?;
        Ok(line.trim_ascii_end())
    }
}
