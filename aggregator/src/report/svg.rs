//! What the drawings and the pages share: text that is safe inside markup, and the dot of a device.

use crate::colors::device_css;

/// The dot in the colour of a device that stands before the device's name, as HTML.
pub(super) fn dot(device: &str) -> String {
    format!("<span class=\"dot\" style=\"background:{}\"></span>", device_css(device))
}

/// Escapes a text so that HTML and SVG show it literally, also inside quoted attributes.
pub(crate) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            c => escaped.push(c),
        }
    }
    escaped
}
