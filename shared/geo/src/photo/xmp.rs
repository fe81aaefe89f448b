//! The XMP packet of a JPEG: places and accuracies as makers of drones write them.
//!
//! A packet is one segment APP1, so it has at most 64 KiB ("XMP Specification Part 3", Adobe, *JPEG*). Each quantity is an
//! attribute or an element.

use roxmltree::{Document, Node, ParsingOptions};

use super::accuracy::GpsAccuracy;
use super::place::Gps;

/// What the segment of a packet begins with.
const SIGNATURE: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";
/// Most elements, attributes and texts of a packet; DJI's have about 60.
const NODES_MAX: u32 = 10_000;
/// The namespace of DJI, without its version.
const DJI: &str = "http://www.dji.com/drone-dji/";
/// The namespace that senseFly, Parrot, MicaSense and Yuneec use, without its version.
const PIX4D: &str = "http://pix4d.com/camera/";

/// What a packet tells; nothing if there is none, or if it is damaged.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Xmp {
    pub(super) gps: Option<Gps>,
    pub(super) accuracy: Option<GpsAccuracy>,
}

impl Xmp {
    /// Reads the packet in the beginning of a JPEG file.
    pub(super) fn read(head: &[u8]) -> Self {
        let parse = || {
            // Without document types, entities cannot expand.
            let options = ParsingOptions { allow_dtd: false, nodes_limit: NODES_MAX, ..Default::default() };
            let text = std::str::from_utf8(packet(head)?).ok()?;
            let text = text.trim_start_matches('\u{FEFF}').trim_end_matches('\0');
            let document = Document::parse_with_options(text, options).ok()?;
            Some(Self { gps: gps(&document), accuracy: accuracy(&document) })
        };
        parse().unwrap_or_default()
    }
}

/// The first packet before the compressed pixels.
fn packet(head: &[u8]) -> Option<&[u8]> {
    let mut rest = head.strip_prefix(&[0xFF, 0xD8])?;
    loop {
        let [0xFF, marker, after @ ..] = rest else { return None };
        let [high, low, ..] = after else { return None };
        let content = after.get(2..usize::from(u16::from_be_bytes([*high, *low])));
        match (*marker, content) {
            (0xFF, _) => rest = &rest[1..], // fill
            (0xE1, Some(content)) if content.starts_with(SIGNATURE) => {
                return Some(&content[SIGNATURE.len()..]);
            }
            (0xDA, _) | (_, None) => return None, // pixels, or the end
            (_, Some(content)) => rest = &after[2 + content.len()..],
        }
    }
}

fn gps(document: &Document) -> Option<Gps> {
    // Early firmware of DJI spells the longitude so.
    let longitude = number(document, DJI, "GpsLongitude").or_else(|| number(document, DJI, "GpsLongtitude"));
    Gps::new(number(document, DJI, "GpsLatitude")?, longitude?, number(document, DJI, "AbsoluteAltitude"))
}

fn accuracy(document: &Document) -> Option<GpsAccuracy> {
    let told = |space, horizontal: [&str; 2], vertical| {
        let [a, b] = horizontal.map(|name| number(document, space, name));
        let (a, b) = (a?, b?);
        // A negative one of two is damage.
        GpsAccuracy::new(a.min(b), None)?;
        GpsAccuracy::new(a.max(b), number(document, space, vertical))
    };
    let by_dji = || told(DJI, ["RtkStdLon", "RtkStdLat"], "RtkStdHgt");
    match text(document, DJI, "RtkFlag").and_then(|flag| flag.parse().ok()) {
        Some(flag) => GpsAccuracy::of_rtk(flag, by_dji()),
        None => told(PIX4D, ["GPSXYAccuracy"; 2], "GPSZAccuracy"),
    }
}

fn number(document: &Document, space: &str, name: &str) -> Option<f64> {
    text(document, space, name)?.parse().ok().filter(|number: &f64| number.is_finite())
}

/// The text of the first attribute or element of this name.
fn text<'a>(document: &'a Document, space: &str, name: &str) -> Option<&'a str> {
    let is_it =
        |found: Option<&str>, its_name| its_name == name && found.is_some_and(|its| its.starts_with(space));
    let of_node = |node: Node<'a, 'a>| {
        let attribute = node.attributes().find(|its| is_it(its.namespace(), its.name()));
        let element =
            is_it(node.tag_name().namespace(), node.tag_name().name()).then(|| node.text()).flatten();
        attribute.map(|its| its.value()).or(element)
    };
    document.descendants().find_map(of_node).map(str::trim)
}

#[cfg(test)]
mod tests;
