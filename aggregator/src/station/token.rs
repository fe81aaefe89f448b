//! The operator's token: what a browser or a script must show to act, and to see anything from another computer.

use std::fmt;
use std::path::Path;

use super::error::StationError;

/// Random bytes of a new token.
const RANDOM_BYTES: usize = 16;
/// Accepted lengths of a token, characters.
const LENGTHS: std::ops::RangeInclusive<usize> = 16..=128;

/// A secret text that is safe in addresses and headers. Its debug text does not show it.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// A new random token.
    pub fn random() -> Result<Self, StationError> {
        let mut bytes = [0; RANDOM_BYTES];
        getrandom::fill(&mut bytes).map_err(|_| StationError::NoRandom)?;
        Ok(Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// The token in the first line of a file.
    pub fn read(path: &Path) -> Result<Self, StationError> {
        let text = std::fs::read_to_string(path)
            .map_err(|cause| StationError::TokenFile { path: path.into(), cause })?;
        let token = text.lines().next().unwrap_or_default().trim();
        let is_safe = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if !LENGTHS.contains(&token.len()) || !token.chars().all(is_safe) {
            return Err(StationError::WeakToken { path: path.into() });
        }
        Ok(Self(token.to_owned()))
    }

    /// The text, for the operator.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// True if a text is the token. The time that this takes tells nothing about the token: hashes are compared, and those
    /// in constant time.
    pub(super) fn is(&self, text: &str) -> bool {
        blake3::hash(text.as_bytes()) == blake3::hash(self.0.as_bytes())
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn tokens_differ_and_are_not_shown() {
        let [one, other] = [(); 2].map(|()| Token::random().unwrap());
        assert!(one.is(one.as_str()) && !one.is(other.as_str()) && !one.is(""));
        assert!(!format!("{one:?}").contains(one.as_str()));
    }

    #[test]
    fn a_file_must_hold_a_long_plain_token() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        for (text, is_good) in [
            ("0123456789abcdef\n", true),
            ("0123456789abcdef\nanother line", true),
            ("short", false),
            ("", false),
            ("0123456789 abcdef", false),
        ] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(Token::read(&path).is_ok(), is_good, "{text}");
        }
        let missing = Token::read(&folder.path().join("none")).unwrap_err().to_string();
        assert!(missing.contains("none"), "{missing}");
    }
}
