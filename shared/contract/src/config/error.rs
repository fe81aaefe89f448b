//! Errors in a configuration file. The first line of each tells a person what to change; the next ones show the place.

use std::ops::Range;

/// Why a configuration file cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A value is wrong, or the text is not TOML.
    #[error("line {line}{}: {reason}\n{excerpt}", field.as_ref().map(|field| format!(", {field}")).unwrap_or_default())]
    Value {
        /// Number of the line, from 1.
        line: usize,
        /// The field whose value is wrong, with its table, for example `tls.cert`; `None` if the line belongs to no
        /// field.
        field: Option<String>,
        /// What is wrong.
        reason: String,
        /// The line, and below it a line with marks under what is wrong.
        excerpt: String,
    },
    /// A required field is missing. The text names the field.
    #[error("{0}")]
    Missing(String),
    /// Neither or both of `broker` and `serial` are set.
    #[error("write either broker = \"mqtt://host:port\" or serial = \"/dev/ttyUSB0\"")]
    OneLink,
    /// `device` is the name of the aggregator.
    #[error(
        "device = \"aggregator\" is the name of the aggregator: write another one, for example device = \"drone-1\""
    )]
    NameOfAggregator,
    /// `baud` is set for a broker.
    #[error(
        "baud is the speed of a serial port: remove it, or write serial = \"/dev/ttyUSB0\" instead of broker"
    )]
    BaudOfBroker,
    /// `password_file` is set for a serial port.
    #[error("password_file is for a broker: remove it, or write broker instead of serial")]
    PasswordOfSerial,
    /// `tls` is set for a serial port.
    #[error("[tls] is for a broker: remove it, or write broker = \"mqtts://host:port\" instead of serial")]
    TlsOfSerial,
    /// Both `compress` and `trusted` are set, and `fleet` is not. With `compress`, a device drops splats because of the
    /// flights (announced cameras) of other agents, so their signatures must be checked.
    #[error(
        "compress = true needs `fleet` beside `trusted`: name the file with the keys of the other agents, or remove `compress`"
    )]
    NoFleet,
}

impl ConfigError {
    /// Adds the line and the field that `error` is about. `text` is the whole file.
    pub(super) fn from_toml(text: &str, error: &toml::de::Error) -> Self {
        let reason = plain(&error.message().trim().replace('\n', "; "));
        // If an error is about the whole file, such as a missing field outside all tables, its span is empty and lies
        // at the start of the file.
        match error.span().filter(|span| span.end > 0) {
            Some(span) => {
                let line = 1 + text[..span.start].matches('\n').count();
                let excerpt = excerpt(text, line, span);
                Self::Value { line, field: field_at(text, line), reason, excerpt }
            }
            None => Self::Missing(reason),
        }
    }
}

/// The reason without the words of programmers for numbers and tables.
fn plain(reason: &str) -> String {
    let Some((found, expected)) = reason.split_once(", expected ") else { return reason.to_owned() };
    let expected = match expected {
        "u8" => "a whole number from 0 to 255",
        "u16" => "a whole number from 0 to 65535",
        "u32" => "a whole number from 0 to 4294967295",
        "a nonzero u32" => "a whole number from 1 to 4294967295",
        "u64" | "usize" => "a whole number, 0 or more",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a sequence" => "a list",
        _ if expected.starts_with("struct ") => "a table",
        other => other,
    };
    format!("{}, expected {expected}", found.replace(" as i128", ""))
}

/// The line number `line` (from 1) of `text`, and a line with marks below the part of it that lies in `span`. Only the first
/// line of a longer span is shown.
fn excerpt(text: &str, line: usize, span: Range<usize>) -> String {
    let start = text[..span.start].rfind('\n').map_or(0, |end| end + 1);
    let whole = text[start..].lines().next().unwrap_or_default();
    let (before, rest) = whole.split_at(span.start.saturating_sub(start).min(whole.len()));
    // Tabs stay tabs, so that the marks stand below their characters.
    let indent: String = before.chars().map(|c| if c == '\t' { '\t' } else { ' ' }).collect();
    let marked = text.get(span).and_then(|marked| marked.lines().next()).unwrap_or_default();
    let marks = "^".repeat(marked.chars().count().min(rest.chars().count()).max(1));
    let number = line.to_string();
    format!("  {number} | {whole}\n  {} | {indent}{marks}", " ".repeat(number.len()))
}

/// The field that line number `line` (from 1) belongs to, with its table, for example `tls.cert`. If a value spans
/// several lines, all of them belong to the field that is named on the first line.
fn field_at(text: &str, line: usize) -> Option<String> {
    let mut above = text.lines().take(line).collect::<Vec<_>>().into_iter().rev();
    let named = above.find(|line| table(line).or_else(|| key(line)).is_some())?;
    let Some(key) = key(named) else { return table(named).map(str::to_owned) };
    Some(above.find_map(table).map_or(key.to_owned(), |table| format!("{table}.{key}")))
}

/// The name of the table if `line` is a table's header: `tls` for `[tls]`.
fn table(line: &str) -> Option<&str> {
    line.trim().strip_prefix('[')?.strip_suffix(']')
}

/// The key at the start of `line`: `steps` for `steps = 7`.
fn key(line: &str) -> Option<&str> {
    let line = line.trim();
    let end = line.find(|c: char| !c.is_ascii_alphanumeric() && !"_-.".contains(c)).unwrap_or(line.len());
    line.starts_with(|c: char| c.is_ascii_alphabetic()).then(|| &line[..end])
}
