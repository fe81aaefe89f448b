//! Errors of a configuration file, as lines that a person can act on.

/// Why an `agent.toml` cannot be used: one line that names the field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A value is wrong, or the text is not TOML.
    #[error("line {line}{}: {reason}", field.as_ref().map(|field| format!(", {field}")).unwrap_or_default())]
    Value {
        /// The line, from 1.
        line: usize,
        /// The field whose value is wrong, if the line has one.
        field: Option<String>,
        /// What is wrong.
        reason: String,
    },
    /// A required field is missing; the text names it.
    #[error("{0}")]
    Missing(String),
    /// Neither or both of `broker` and `serial` are set.
    #[error("write either broker = \"mqtt://host:port\" or serial = \"/dev/ttyUSB0\"")]
    OneLink,
    /// Both `compress` and `trusted` are set: `compress` needs other agents' flights, which are unsigned.
    #[error(
        "compress = true: agents do not sign which views they took; remove either `compress` or `trusted`"
    )]
    UnsignedFlights,
}

impl ConfigError {
    /// Finds the line and the field that `error` is about.
    pub(super) fn from_toml(text: &str, error: &toml::de::Error) -> Self {
        let reason = error.message().trim().replace('\n', "; ");
        // An error about the file as a whole has an empty span at its start.
        match error.span().filter(|span| span.end > 0) {
            Some(span) => {
                let line = 1 + text[..span.start].matches('\n').count();
                Self::Value { line, field: field_at(text, line), reason }
            }
            None => Self::Missing(reason),
        }
    }
}

/// The field that a line belongs to, with its table. The later lines of a value belong to the field above them.
fn field_at(text: &str, line: usize) -> Option<String> {
    let mut above = text.lines().take(line).collect::<Vec<_>>().into_iter().rev();
    let named = above.find(|line| table(line).or_else(|| key(line)).is_some())?;
    let Some(key) = key(named) else { return table(named).map(str::to_owned) };
    Some(above.find_map(table).map_or(key.to_owned(), |table| format!("{table}.{key}")))
}

/// The name in a table's header.
fn table(line: &str) -> Option<&str> {
    line.trim().strip_prefix('[')?.strip_suffix(']')
}

/// The key that a line begins with.
fn key(line: &str) -> Option<&str> {
    let line = line.trim();
    let end = line.find(|c: char| !c.is_ascii_alphanumeric() && !"_-.".contains(c)).unwrap_or(line.len());
    line.starts_with(|c: char| c.is_ascii_alphabetic()).then(|| &line[..end])
}
