//! The colours of devices: a device has the same colour in the viewer, on the page of a site and in every report, whichever
//! other devices there are.
//!
//! What it knows nothing about: devices beyond their names, and where colours are drawn.

/// Angle between the hues of consecutive numbers, degrees: the golden angle, which spreads any number of hues almost evenly.
const GOLDEN_ANGLE_DEG: f64 = 137.507_764;
/// Saturation and the three lightnesses of the colours, 0..=1. They can be seen on white and on black.
const SATURATION: f64 = 0.62;
const LIGHTNESSES: [f64; 3] = [0.48, 0.42, 0.55];

/// Colour of a device, as red, green and blue. Names that differ only in the number at their end have hues that are well
/// apart; so have those that differ only in their last letter. Names that differ otherwise may have similar colours.
pub(crate) fn device_color(name: &str) -> [u8; 3] {
    let (stem, number) = stem_and_number(name);
    let hash = blake3::hash(stem.as_bytes());
    let [first, second, third, ..] = hash.as_bytes();
    let turn_deg = f64::from(u16::from_le_bytes([*first, *second])) * 360.0 / 65536.0;
    let hue_deg = (turn_deg + GOLDEN_ANGLE_DEG * f64::from(number)) % 360.0;
    rgb(hue_deg, LIGHTNESSES[usize::from(third % 3)])
}

/// Colour of a device, as style sheets and drawings name it.
pub(crate) fn device_css(name: &str) -> String {
    let [red, green, blue] = device_color(name);
    format!("rgb({red} {green} {blue})")
}

/// A name without the number at its end, and the number; without a number, the last letter counts as one.
fn stem_and_number(name: &str) -> (&str, u32) {
    let stem = name.trim_end_matches(|letter: char| letter.is_ascii_digit());
    if let Ok(number) = name[stem.len()..].parse() {
        return (stem, number);
    }
    let last = name.chars().next_back();
    last.map_or(("", 0), |last| (&name[..name.len() - last.len_utf8()], u32::from(last)))
}

/// From hue and lightness, by the formula of CSS Color 4, section 7.1.
fn rgb(hue_deg: f64, lightness: f64) -> [u8; 3] {
    let amplitude = SATURATION * lightness.min(1.0 - lightness);
    [0.0, 8.0, 4.0].map(|n| {
        let k = (n + hue_deg / 30.0) % 12.0;
        let value = lightness - amplitude * (k - 3.0).min(9.0 - k).clamp(-1.0, 1.0);
        (255.0 * value).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The largest difference of a channel.
    fn difference(one: &str, other: &str) -> u8 {
        let [one, other] = [one, other].map(device_color);
        one.iter().zip(other).map(|(a, b)| a.abs_diff(b)).max().unwrap_or(0)
    }

    #[test]
    fn numbered_devices_of_a_fleet_are_told_apart() {
        for fleet in ["drone-", "agent-", "uav_", ""] {
            for i in 1..=8 {
                for j in 1..i {
                    let [one, other] = [i, j].map(|number| format!("{fleet}{number}"));
                    assert!(difference(&one, &other) >= 30, "{one} {other}");
                }
            }
        }
        assert!(difference("drone-a", "drone-b") >= 30 && difference("north-1", "south-1") >= 30);
        assert_eq!(difference("drone-7", "drone-07"), 0, "the same number");
    }

    #[test]
    fn every_name_has_a_colour() {
        for name in ["", "7", "é", "a", "drone-99999999999999999999", &"x".repeat(64)] {
            let color = device_color(name);
            assert!(color.iter().any(|channel| *channel > 60), "{name}: {color:?}");
        }
        assert_eq!(rgb(0.0, 0.48), [198, 47, 47], "hsl(0 62% 48%)");
        assert_eq!(rgb(120.0, 0.48), [47, 198, 47]);
        assert!(device_css("a").starts_with("rgb("));
    }
}
