//! Colour pictures of depth, normals and errors, for people to look at.
//!
//! Depth and errors use a perceptual colour map of our own: a path through OKLCh on which lightness rises
//! evenly from dark violet through blue and green to bright yellow. Near surfaces and large errors are
//! bright. Equal steps of depth look equally large, and nearer surfaces are brighter in a greyscale copy too.
//! The conversion from Oklab to linear sRGB is Ottosson's ("A perceptual color space for image processing",
//! 2020).

use std::sync::OnceLock;

use glam::Vec3;

use crate::Picture;

/// Colour of pixels that show no surface.
const EMPTY: [u8; 3] = [24, 24, 27];
/// Lightness in Oklab at the dark (far) and the bright (near) end of the map.
const LIGHTNESS: [f32; 2] = [0.22, 0.94];
/// Hue in degrees at the dark (far) and the bright (near) end of the map: violet and yellow.
const HUE_DEG: [f32; 2] = [300.0, 95.0];
/// Chroma at 0, ¼, ½, ¾ and 1 of the map: the largest round numbers for which all colours of the map are
/// inside sRGB.
const CHROMA: [f32; 5] = [0.11, 0.09, 0.09, 0.15, 0.09];
/// Share of the surface pixels that [`depth_range`] leaves out at each end.
const OUTLIERS: f64 = 0.02;
/// Colour of a fully lit clay surface, linear sRGB.
const CLAY: [f32; 3] = [0.86, 0.83, 0.79];
/// Share of the clay surface's light that comes from all sides.
const AMBIENT: f32 = 0.08;

/// Draws depths with the colour map. `depth` is `[h, w]` in metres along z, 0 or not finite where there is
/// no surface. `range_m` is the depth of the brightest colour, then that of the darkest; see
/// [`depth_range`].
pub fn depth_picture(depth: &[f32], size_px: [u32; 2], range_m: [f32; 2]) -> Picture {
    let [near, far] = range_m;
    let span = (far - near).max(f32::MIN_POSITIVE);
    let rgb = depth.iter().flat_map(|&z| {
        let nearness = (far - z) / span;
        if is_surface(z) { ramp(nearness) } else { EMPTY }
    });
    Picture::new(size_px, rgb.collect())
}

/// The range `[near, far]` for [`depth_picture`]: the 2nd and 98th percentiles of the depths of
/// surface pixels, in metres; `[0, 1]` if no pixel shows a surface.
pub fn depth_range(depth: &[f32]) -> [f32; 2] {
    let mut depths: Vec<f32> = depth.iter().copied().filter(|&z| is_surface(z)).collect();
    if depths.is_empty() {
        return [0.0, 1.0];
    }
    depths.sort_unstable_by(f32::total_cmp);
    let last = (depths.len() - 1) as f64;
    let at = |share: f64| depths[(share * last).round() as usize];
    [at(OUTLIERS), at(1.0 - OUTLIERS)]
}

/// Draws errors with the colour map. `errors` is `[h, w]`, each at least 0, or NaN where there is nothing
/// to compare. An error of 0 is darkest; an error of `bright` (above 0) or more is brightest.
pub fn error_picture(errors: &[f32], size_px: [u32; 2], bright: f32) -> Picture {
    let color = |&error: &f32| if error.is_nan() { EMPTY } else { ramp(error / bright) };
    let rgb = errors.iter().flat_map(color);
    Picture::new(size_px, rgb.collect())
}

/// Draws normals as a normal map: red shows how far a normal points right, green how far up, and blue how
/// far towards the camera. `normals` is `[h, w, xyz]` in the camera frame (x right, y down, z forward), of
/// any length above 1e-3; a shorter normal means that there is no surface.
pub fn normal_picture(normals: &[f32], size_px: [u32; 2]) -> Picture {
    let (normals, _) = normals.as_chunks::<3>();
    let rgb = normals.iter().flat_map(|&[x, y, z]| {
        let length = (x * x + y * y + z * z).sqrt();
        let byte = |v: f32| ((v / length + 1.0) * 127.5).round() as u8;
        if length > 1e-3 { [byte(x), byte(-y), byte(-z)] } else { EMPTY }
    });
    Picture::new(size_px, rgb.collect())
}

/// Draws a surface as light clay under a lamp to the upper left of the camera. `normals` is `[h, w]`, of
/// unit length, in the camera frame, zero where there is no surface.
pub fn clay_picture(normals: &[[f32; 3]], size_px: [u32; 2]) -> Picture {
    let lamp = Vec3::new(-0.5, -0.6, -0.62).normalize();
    let rgb = normals.iter().flat_map(|&normal| {
        let light = AMBIENT + (1.0 - AMBIENT) * Vec3::from(normal).dot(lamp).max(0.0);
        if normal == [0.0; 3] { EMPTY } else { CLAY.map(|part| byte_from_linear(part * light)) }
    });
    Picture::new(size_px, rgb.collect())
}

/// The colour of the map at `t`: dark violet at 0 and below, bright yellow at 1 and above.
pub fn ramp(t: f32) -> [u8; 3] {
    palette()[(t.clamp(0.0, 1.0) * 255.0).round() as usize]
}

fn is_surface(depth_m: f32) -> bool {
    depth_m.is_finite() && depth_m > 0.0
}

/// The 256 colours of the map, from dark (far) to bright (near).
fn palette() -> &'static [[u8; 3]; 256] {
    static PALETTE: OnceLock<[[u8; 3]; 256]> = OnceLock::new();
    PALETTE.get_or_init(|| std::array::from_fn(|i| color(i as f32 / 255.0).map(byte_from_linear)))
}

/// The colour of the map at `t`, 0 to 1, in linear sRGB.
fn color(t: f32) -> [f32; 3] {
    let mix = |[from, to]: [f32; 2], t: f32| from + (to - from) * t;
    let knot = ((t * 4.0) as usize).min(3);
    let chroma = mix([CHROMA[knot], CHROMA[knot + 1]], t * 4.0 - knot as f32);
    let hue = mix(HUE_DEG, t).to_radians();
    linear_from_oklab(mix(LIGHTNESS, t), chroma * libm::cosf(hue), chroma * libm::sinf(hue))
}

fn linear_from_oklab(lightness: f32, a: f32, b: f32) -> [f32; 3] {
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_4 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
}

/// Encodes linear light, clamped to 0..=1, as an sRGB byte (IEC 61966-2-1).
fn byte_from_linear(v: f32) -> u8 {
    let v = v.clamp(0.0, 1.0);
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * libm::powf(v, 1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rec. 709 luma of sRGB bytes: the brightness in a greyscale copy.
    fn luma([r, g, b]: [u8; 3]) -> f32 {
        0.2126 * f32::from(r) + 0.7152 * f32::from(g) + 0.0722 * f32::from(b)
    }

    #[test]
    fn nearer_is_always_brighter() {
        for pair in palette().windows(2) {
            assert!(luma(pair[1]) >= luma(pair[0]), "{pair:?}");
        }
        assert!(luma(palette()[255]) - luma(palette()[0]) > 180.0);
    }

    #[test]
    fn every_color_is_inside_srgb() {
        for i in 0..=255 {
            let rgb = color(i as f32 / 255.0);
            assert!(rgb.iter().all(|v| (-2e-3..=1.002).contains(v)), "{i}: {rgb:?}");
        }
    }

    #[test]
    fn depths_span_the_map_and_holes_stay_dark() {
        let picture = depth_picture(&[2.0, 10.0, 0.0, f32::NAN, 1.0, 99.0], [3, 2], [2.0, 10.0]);
        let pixels = picture.rgb.as_chunks::<3>().0;
        assert_eq!(pixels[0], palette()[255]);
        assert_eq!(pixels[1], palette()[0]);
        assert_eq!([pixels[2], pixels[3]], [EMPTY; 2]);
        assert_eq!([pixels[4], pixels[5]], [pixels[0], pixels[1]]);
    }

    #[test]
    fn larger_errors_are_brighter_and_unknown_ones_stay_dark() {
        let picture = error_picture(&[0.0, 1.0, 2.0, 9.0, f32::NAN], [5, 1], 2.0);
        let pixels = picture.rgb.as_chunks::<3>().0;
        assert_eq!([pixels[0], pixels[1]], [palette()[0], palette()[128]]);
        assert_eq!([pixels[2], pixels[3]], [palette()[255]; 2]);
        assert_eq!(pixels[4], EMPTY);
    }

    #[test]
    fn the_range_leaves_outliers_and_holes_out() {
        let mut depth: Vec<f32> = (0..1000).map(|i| 50.0 + i as f32 / 100.0).collect();
        depth.extend([0.0; 500]);
        depth.extend([1e6; 5]);
        let [near, far] = depth_range(&depth);
        assert!((50.0..50.5).contains(&near) && (59.5..60.0).contains(&far), "{near} {far}");
        assert_eq!(depth_range(&[0.0, f32::INFINITY]), [0.0, 1.0]);
    }

    #[test]
    fn clay_is_brightest_towards_the_lamp() {
        let picture =
            clay_picture(&[[-0.5, -0.6, -0.62], [0.0, 0.0, -1.0], [0.5, 0.6, -0.62], [0.0; 3]], [4, 1]);
        let pixels = picture.rgb.as_chunks::<3>().0;
        assert!(pixels.windows(2).all(|pair| luma(pair[0]) > luma(pair[1])), "{pixels:?}");
        assert_eq!(pixels[3], EMPTY);
    }

    #[test]
    fn a_wall_that_faces_the_camera_is_light_blue_and_ground_is_green() {
        let picture = normal_picture(&[0.0, 0.0, -0.8, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0], [3, 1]);
        assert_eq!(picture.rgb, [[128, 128, 255], [128, 255, 128], EMPTY].concat());
    }
}
