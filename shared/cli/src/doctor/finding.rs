//! What a check has found.

use std::fmt;

use serde::Serialize;

/// What a check has found, and the remedy if something is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    check: &'static str,
    state: State,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    remedy: Option<String>,
}

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum State {
    Ok,
    /// Only some commands need it, or it is merely slow.
    Note,
    Mend,
}

impl Finding {
    /// All is well.
    pub fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self { check, state: State::Ok, found: found.into(), remedy: None }
    }

    /// Something that the program can do without.
    pub fn note(check: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, state: State::Note, found: found.into(), remedy: Some(remedy.into()) }
    }

    /// Something that keeps the program from working.
    pub fn mend(check: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, state: State::Mend, found: found.into(), remedy: Some(remedy.into()) }
    }

    /// The finding for an error, whose line tells the remedy too.
    pub fn failed(check: &'static str, error: impl fmt::Display) -> Self {
        Self { check, state: State::Mend, found: error.to_string(), remedy: None }
    }

    /// Whether it must be mended.
    pub fn is_fault(&self) -> bool {
        self.state == State::Mend
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = match self.state {
            State::Ok => "ok",
            State::Note => "note",
            State::Mend => "mend",
        };
        write!(f, "{state:<4}  {:<8}  {}", self.check, self.found)?;
        self.remedy.iter().try_for_each(|remedy| write!(f, "; {remedy}"))
    }
}
