//! Texts that people read: counts with their nouns, and text from outside.

use std::fmt::{self, Display, Write};

/// Text from outside, as it is written to logs and terminals: characters that could begin a line of their own, move the
/// cursor, change colours or turn the direction of text are written as escapes, such as `\n` and `\u{1b}`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Escaped<T>(pub T);

impl<T: Display> Display for Escaped<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(Escaping(f), "{}", self.0)
    }
}

struct Escaping<'a, 'b>(&'a mut fmt::Formatter<'b>);

impl Write for Escaping<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        text.chars().try_for_each(|letter| match is_harmless(letter) {
            true => self.0.write_char(letter),
            false => write!(self.0, "{}", letter.escape_default()),
        })
    }
}

/// Whether a character neither ends a line nor changes how the text around it is shown.
fn is_harmless(letter: char) -> bool {
    let changes_text = matches!(letter,
        '\u{AD}' | '\u{61C}' | '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2060}'..='\u{206F}' | '\u{FEFF}');
    !letter.is_control() && !changes_text
}

/// A count with its noun: `1 splat`, `2 splats`. The plural of `noun` must be the noun with an `s`.
pub fn counted<N: Display + PartialEq + From<u8>>(count: N, noun: &str) -> String {
    let ending = if count == N::from(1u8) { "" } else { "s" };
    format!("{count} {noun}{ending}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attack_16_text_from_outside_stays_on_its_line() {
        for (text, shown) in [
            ("drone-1/état 機", "drone-1/état 機"),
            ("a\nmerged: all is well", "a\\nmerged: all is well"),
            ("\u{1b}[2J\u{1b}]0;title\u{7}", "\\u{1b}[2J\\u{1b}]0;title\\u{7}"),
            ("a\u{85}b\u{9b}31m", "a\\u{85}b\\u{9b}31m"),
            ("\u{202e}gpj.exe\u{2028}", "\\u{202e}gpj.exe\\u{2028}"),
        ] {
            assert_eq!(Escaped(text).to_string(), shown);
        }
    }

    #[test]
    fn only_one_is_singular() {
        assert_eq!([0, 1, 21].map(|count: u32| counted(count, "step")), ["0 steps", "1 step", "21 steps"]);
    }
}
