//! The colours of devices: a device has the same colour in the viewer, on the page of a site and in every report, whichever
//! other devices there are.
//!
//! What it knows nothing about: devices beyond their names, and where colours are drawn.

/// A name's number takes one of so many hues, which are as far apart as they can be, and every further ten of the numbers another
/// lightness. After all lightnesses, the hues between follow.
const HUES: u32 = 10;
/// Degrees between the hues of consecutive numbers: three of the ten parts of the circle, so that neighbours are well apart.
const STEP_DEG: f64 = 3.0 * 360.0 / HUES as f64;
/// Lightnesses L* of CIELAB. A colour of each has a contrast of 2.7 and more with the white and with the dark paper of the pages.
const LIGHTNESSES: [f64; 3] = [52.0, 40.0, 64.0];
/// Largest chroma C* of CIELAB. Most hues have less on a screen.
const CHROMA_MAX: f64 = 60.0;

/// Colour of a device, as red, green and blue. Names that differ only in the number at their end have colours that are at least
/// 10 apart by CIE76 if the numbers are less than 30 apart; so have those that differ only in their last letter. Names that differ
/// otherwise may have similar colours.
pub(crate) fn device_color(name: &str) -> [u8; 3] {
    let (stem, number) = stem_and_number(name);
    let hash = blake3::hash(stem.as_bytes());
    let [first, second, third, ..] = hash.as_bytes();
    let turn_deg = f64::from(u16::from_le_bytes([*first, *second])) * 360.0 / 65536.0;
    let (tens, count) = (number / HUES, LIGHTNESSES.len() as u32);
    let between_deg = 180.0 / f64::from(HUES) * f64::from(tens / count % 2);
    let hue_deg = turn_deg + STEP_DEG * f64::from(number % HUES) + between_deg;
    // Each stem begins with a lightness of its own.
    let lightness = LIGHTNESSES[((tens % count + u32::from(*third)) % count) as usize];
    on_screen(lightness, hue_deg)
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

/// The colour of this lightness and hue with the largest chroma that a screen shows.
fn on_screen(lightness: f64, hue_deg: f64) -> [u8; 3] {
    let [sin, cos] = [hue_deg.to_radians().sin(), hue_deg.to_radians().cos()];
    let mut chroma = CHROMA_MAX;
    loop {
        let linear = linear_rgb([lightness, chroma * cos, chroma * sin]);
        // Grey, of chroma 0, is always shown.
        if chroma <= 0.0 || linear.iter().all(|channel| (0.0..=1.0).contains(channel)) {
            return linear.map(|channel| (255.0 * gamma(channel)).round() as u8);
        }
        chroma -= 1.0;
    }
}

/// From L*, a* and b* of CIELAB (CIE 15:2004) with the white point D65, by the matrix of IEC 61966-2-1.
fn linear_rgb([l, a, b]: [f64; 3]) -> [f64; 3] {
    let y = (l + 16.0) / 116.0;
    let cube = |f: f64| if f > 6.0 / 29.0 { f.powi(3) } else { (116.0 * f - 16.0) * 27.0 / 24389.0 };
    let [x, y, z] = [0.95047 * cube(y + a / 500.0), cube(y), 1.08883 * cube(y - b / 200.0)];
    [
        3.240_454 * x - 1.537_139 * y - 0.498_531 * z,
        -0.969_266 * x + 1.876_011 * y + 0.041_556 * z,
        0.055_643 * x - 0.204_026 * y + 1.057_225 * z,
    ]
}

/// The transfer function of sRGB, IEC 61966-2-1.
fn gamma(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The inverse of [`gamma`].
    fn linear(channel: u8) -> f64 {
        let value = f64::from(channel) / 255.0;
        if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
    }

    /// X, Y and Z.
    fn xyz(color: [u8; 3]) -> [f64; 3] {
        let [r, g, b] = color.map(linear);
        [
            0.412_456 * r + 0.357_576 * g + 0.180_438 * b,
            0.212_673 * r + 0.715_152 * g + 0.072_175 * b,
            0.019_334 * r + 0.119_192 * g + 0.950_304 * b,
        ]
    }

    fn lab(color: [u8; 3]) -> [f64; 3] {
        let [x, y, z] = xyz(color);
        let root = |t: f64| if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 };
        let [x, y, z] = [root(x / 0.95047), root(y), root(z / 1.08883)];
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    /// The difference of two colours by CIE76.
    fn difference(one: &str, other: &str) -> f64 {
        let [one, other] = [one, other].map(|name| lab(device_color(name)));
        one.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn devices_of_a_fleet_are_told_apart() {
        for fleet in ["drone-", "agent-", "uav_", "", "north-west-1-"] {
            for i in 1..=30 {
                for j in 1..i {
                    let [one, other] = [i, j].map(|number| format!("{fleet}{number}"));
                    let least = if i <= 8 { 15.0 } else { 10.0 };
                    assert!(difference(&one, &other) >= least, "{one} {other}: {}", difference(&one, &other));
                }
            }
        }
        for (one, other) in ('a'..='z').flat_map(|one| ('a'..one).map(move |other| (one, other))) {
            let [one, other] = [one, other].map(|letter| format!("drone-{letter}"));
            assert!(difference(&one, &other) >= 10.0, "{one} {other}");
        }
        assert!(difference("north-1", "south-1") >= 10.0);
        assert!(difference("drone-7", "drone-37") > 5.0, "of more devices, too");
        assert_eq!(device_color("drone-7"), device_color("drone-07"), "the same number");
    }

    #[test]
    fn colours_can_be_seen_on_both_papers() {
        // `--paper` of the pages.
        let papers = [[255, 255, 255], [16, 19, 23]].map(|paper| xyz(paper)[1]);
        for name in
            (1..=60).flat_map(|number| ["drone-", "agent-", "x"].map(|stem| format!("{stem}{number}")))
        {
            let luminance = xyz(device_color(&name))[1];
            for paper in papers {
                // The contrast of WCAG 2.
                let contrast = (luminance.max(paper) + 0.05) / (luminance.min(paper) + 0.05);
                assert!(contrast >= 2.7, "{name}: {contrast}");
            }
        }
    }

    #[test]
    fn every_name_has_a_colour() {
        for name in ["", "7", "é", "a", "drone-4294967295", "drone-99999999999999999999", &"x".repeat(64)] {
            let [l, ..] = lab(device_color(name));
            assert!((39.0..65.0).contains(&l), "{name}: {l}");
        }
        assert_eq!(linear_rgb([100.0, 0.0, 0.0]).map(|channel| (255.0 * gamma(channel)).round()), [255.0; 3]);
        assert!(device_css("a").starts_with("rgb("));
    }
}
