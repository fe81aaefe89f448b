//! Arguments that several commands take.

/// Parses a length in metres: a finite number above zero.
pub(super) fn parse_length(text: &str) -> Result<f64, String> {
    let length: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
    length.ok_or_else(|| format!("'{text}' is not a positive length in metres; write for example 0.25"))
}
