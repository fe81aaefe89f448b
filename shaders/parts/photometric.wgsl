// What the passes of the colour loss share: the jobs of workgroups, the pixels around a tile (its halo), and the window
// of SSIM.
// Needs: types, pixels, photograph; the binding `view`.

// Number of pixels of the SSIM window on each side of its centre, the side of this window, and the side of a tile with
// its halo, px.
const SSIM_REACH: u32 = 5u;
const SSIM_TAPS: u32 = 2u * SSIM_REACH + 1u;
const SSIM_SIDE: u32 = TILE + 2u * SSIM_REACH;
// Weights of the window along one axis: exp(-x² / (2 σ²)), with x the distance from its centre and σ = 1.5 px,
// normalised to sum 1 (3DGS).
const SSIM_WINDOW = array<f32, SSIM_TAPS>(
    0.00102838012, 0.00759875821, 0.0360007733, 0.109360687, 0.213005543, 0.266011715,
    0.213005543, 0.109360687, 0.0360007733, 0.00759875821, 0.00102838012,
);
// Number of planes that ssim.wgsl writes for photometric_gradient.wgsl: for each channel ∂SSIM/∂μx, ∂SSIM/∂E[xx] and
// ∂SSIM/∂E[xy]. μx, E[xx] and E[xy] are means over the window of x, x² and x y, with x the rendered and y the
// photographed value.
const PARTIALS: u32 = 9u;

// The job of a workgroup: one channel of a tile.
struct Job {
    index: u32,
    tile: u32,
    channel: u32,
    // First pixel of the tile.
    origin: vec2<u32>,
}

fn job_of(group: vec3<u32>) -> Job {
    let index = group_index(group);
    return Job(index, index / 3u, index % 3u, corner_of(index / 3u));
}

// The pixel at index `place` of a tile with its halo. `origin` is the first pixel of the tile.
fn around(origin: vec2<u32>, place: u32) -> vec2<u32> {
    // Left of and above the picture the subtraction wraps around, to coordinates far outside the picture.
    return origin + vec2(place % SSIM_SIDE, place / SSIM_SIDE) - SSIM_REACH;
}

// A channel of the photograph at a pixel.
fn photographed(pixel: vec2<u32>, channel: u32) -> f32 {
    return photograph_value(3u * line_place(pixel) + channel);
}
