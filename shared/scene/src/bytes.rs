//! Parsing and formatting of amounts of memory: `300MiB`, `1.5GB`, `1048576`.

/// Suffixes, and the number of bytes that each stands for. The longest are tried first, because
/// `kib` also ends with `b`. `k`, `m` and `g` are powers of 1024, as in `dd`.
const UNITS: [(&str, u64); 10] = [
    ("kib", 1 << 10),
    ("mib", 1 << 20),
    ("gib", 1 << 30),
    ("kb", 1_000),
    ("mb", 1_000_000),
    ("gb", 1_000_000_000),
    ("k", 1 << 10),
    ("m", 1 << 20),
    ("g", 1 << 30),
    ("b", 1),
];

/// Parses an amount such as `300MiB`, `1.5 GB` or `1048576` to bytes, ignoring case. The error is
/// one line that quotes `text` and gives examples of valid amounts.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let lower = text.trim().to_ascii_lowercase();
    let (number, unit) = UNITS
        .iter()
        .find_map(|(suffix, unit)| lower.strip_suffix(suffix).map(|number| (number, *unit)))
        .unwrap_or((&lower, 1));
    let wrong = || format!("'{text}' is not an amount of memory; write for example 300MiB or 2GB");
    let number: f64 = number.trim_end().parse().map_err(|_| wrong())?;
    let bytes = number * unit as f64;
    if !(bytes.is_finite() && (0.0..9.2e18).contains(&bytes)) {
        return Err(wrong());
    }
    Ok(bytes as u64)
}

/// Formats a number of bytes with at most three significant digits: `300 MiB`, `1.46 GiB`, `12 B`.
pub fn format_bytes(bytes: u64) -> String {
    let mut value = bytes as f64;
    let mut unit = "B";
    for next in ["KiB", "MiB", "GiB", "TiB"] {
        if value < 999.5 {
            break;
        }
        value /= 1024.0;
        unit = next;
    }
    let decimals = match value {
        _ if unit == "B" => 0,
        v if v < 9.995 => 2,
        v if v < 99.95 => 1,
        _ => 0,
    };
    format!("{value:.decimals$} {unit}")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn amounts_are_parsed() {
        for (text, bytes) in [
            ("0", 0),
            ("1048576", 1 << 20),
            ("300MiB", 300 << 20),
            (" 1.5 gb ", 1_500_000_000),
            ("2G", 2 << 30),
            ("7 b", 7),
            ("0.5k", 512),
        ] {
            assert_eq!(parse_bytes(text).unwrap(), bytes, "{text}");
        }
        for text in ["", "MiB", "-1", "nan", "inf", "1e30", "3 furlongs", "1e400"] {
            assert!(parse_bytes(text).unwrap_err().contains("300MiB"), "{text}");
        }
    }

    #[test]
    fn amounts_are_formatted() {
        for (bytes, text) in [
            (0, "0 B"),
            (999, "999 B"),
            (1023, "1.00 KiB"),
            (300 << 20, "300 MiB"),
            (1_500_000_000, "1.40 GiB"),
            (12_345, "12.1 KiB"),
        ] {
            assert_eq!(format_bytes(bytes), text);
        }
    }
}
