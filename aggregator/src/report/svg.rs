//! Helpers that the drawings and the page share: the colours of agents, and text that is safe inside
//! markup.

/// Colour of agent `agent`. The hues of consecutive agents are a golden angle apart, which spreads the hues
/// almost evenly for any number of agents. The colours can be seen on white and on black.
pub(crate) fn agent_color(agent: usize) -> String {
    format!("hsl({:.0} 62% 48%)", (212.0 + 137.508 * agent as f64) % 360.0)
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
