// What the passes of the colour loss share: the picture, the photograph, SSIM's window.

// Half the SSIM window, its side, and the side of a tile with what the window reaches around it.
const REACH: u32 = 5u;
const TAPS: u32 = 11u;
const SIDE: u32 = 26u;
// exp(-x² / (2 σ²)), σ = 1.5, normalised to sum 1 (3DGS).
const WINDOW = array<f32, 11>(
    0.00102838012, 0.00759875821, 0.0360007733, 0.109360687, 0.213005543, 0.266011715,
    0.213005543, 0.109360687, 0.0360007733, 0.00759875821, 0.00102838012,
);
// Planes between the passes: for each channel ∂SSIM/∂μx, ∂SSIM/∂E[xx], ∂SSIM/∂E[xy].
const PARTIALS: u32 = 9u;

// The pixel at a place of a tile's surroundings; beyond the picture where it is outside.
fn around(origin: vec2<u32>, place: u32) -> vec2<u32> {
    // Left of the picture this wraps round to far beyond its right.
    return origin + vec2(place % SIDE, place / SIDE) - REACH;
}

// What the photograph shows, 0..1: bytes as r g b r …, four in a number, or floats in the same order.
fn photographed(pixel: vec2<u32>, channel: u32) -> f32 {
    let at = 3u * (pixel.y * view.size_px.x + pixel.x) + channel;
    if (settings.is_floats == 1u) {
        return bitcast<f32>(photograph[at]);
    }
    return f32((photograph[at / 4u] >> (8u * (at % 4u))) & 255u) / 255.0;
}
