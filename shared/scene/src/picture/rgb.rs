//! Decoded pixels of any kind as RGB.

use image::DynamicImage;

/// The opacity as RGB, white where nothing shows through.
pub(super) fn alpha_as_grey(image: DynamicImage) -> Vec<u8> {
    match image {
        DynamicImage::ImageLumaA8(grey) => grey.pixels().flat_map(|pixel| [pixel.0[1]; 3]).collect(),
        other => other.into_rgba8().pixels().flat_map(|pixel| [pixel.0[3]; 3]).collect(),
    }
}

/// Converts to RGB of 8 bits per channel, with alpha composited over black.
/// [`super::header::PictureHeader::decode_bytes`] includes the memory for this.
pub(super) fn rgb_over_black(image: DynamicImage) -> Vec<u8> {
    let over = |color: u8, alpha: u8| ((u16::from(color) * u16::from(alpha) + 127) / 255) as u8;
    match image {
        DynamicImage::ImageRgb8(rgb) => rgb.into_raw(),
        DynamicImage::ImageLuma8(grey) => grey.into_raw().into_iter().flat_map(|grey| [grey; 3]).collect(),
        DynamicImage::ImageLumaA8(grey) => grey.pixels().flat_map(|p| [over(p.0[0], p.0[1]); 3]).collect(),
        other => {
            let rgba = other.into_rgba8();
            rgba.pixels().flat_map(|p| [0, 1, 2].map(|channel| over(p.0[channel], p.0[3]))).collect()
        }
    }
}
