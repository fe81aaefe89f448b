// Structures and constants of all passes. This part comes first in every source. Tests of cosurf-engine compare the
// structures and constants with their counterparts in Rust.

// Side of a tile, px, and the number of its pixels.
const TILE: u32 = 16u;
const TILE_PIXELS: u32 = 256u;
// Number of invocations of a workgroup in most passes.
const GROUP: u32 = 256u;
// How many numbers one workgroup scans or sorts: 4 for each invocation.
const BLOCK: u32 = 1024u;
// Number of values of a digit. Keys are sorted digit by digit; a digit has 8 bits.
const DIGITS: u32 = 256u;

// Splats nearer than this to the camera's plane are not drawn (3DGS; scene units).
const NEAR: f32 = 0.2;
// A pixel skips splats with an alpha below this (3DGS).
const ALPHA_MIN: f32 = 1.0 / 255.0;
// log2(ALPHA_MIN).
const LOG2_ALPHA_MIN: f32 = -7.994353436858858;
// Alpha is clamped to at most this (3DGS).
const ALPHA_MAX: f32 = 0.99;
// A pixel is full when the next splat would lower its transmittance below this. That splat is not blended (3DGS).
const TRANSMITTANCE_MIN: f32 = 1e-4;
// Variance that is added to both screen axes, px² (the low-pass filter of 3DGS).
const LOW_PASS_PX2: f32 = 0.3;
const LOG2_E: f32 = 1.4426950408889634;
const LN_2: f32 = 0.6931471805599453;

// Sort key of an invisible splat, in place of its depth. It is larger than the bits of every positive float.
const NOT_SEEN: u32 = 0xffffffffu;

// Indices in the buffer of counters: the number of all splats, and of visible splats.
const SPLATS: u32 = 0u;
const VISIBLE: u32 = 1u;
// Indices in the buffer of counters: the number of splat-tile pairs of the view, and of those within the capacity.
const PAIRS_WANTED: u32 = 2u;
const PAIRS: u32 = 3u;

// First rows of mean, quaternion, log scale and opacity logit in the shapes.
// Row r of splat i is at shape[r * view.splat_stride + i].
const MEAN: u32 = 0u;
const QUAT: u32 = 3u;
const LOG_SCALE: u32 = 7u;
const OPACITY: u32 = 10u;

// Rows of the densification statistics.
const STAT_SCREEN_GRADIENT: u32 = 0u;
const STAT_VIEWS: u32 = 1u;
const STAT_ABSOLUTE_GRADIENT: u32 = 2u;
// Rows of the scores.
const SQUARED_WEIGHT: u32 = 0u;
const HITS: u32 = 1u;
const OBSERVED: u32 = 2u;

// Number of vec4 in the record of a splat-tile pair, and in the loss sums of one channel of a tile.
const RECORD_VECTORS: u32 = 4u;
const LOSS_VECTORS: u32 = 2u;

// Planes of a picture: 0 to 2 are red, green and blue, then follows the remaining transmittance. With geometry, three
// planes of the normal and one of the plane distance follow. A picture is stored in tiles: the value of a pixel of tile
// t in a plane is image[(t * view.planes + plane) * TILE_PIXELS + pixel].
const TRANSMITTANCE: u32 = 3u;
const NORMAL: u32 = 4u;
const DISTANCE: u32 = 7u;
const PLANES_GEOMETRY: u32 = 8u;

// A camera.
struct View {
    // Rows of the rotation from world to camera. The fourth numbers are the translation.
    cam_from_world: array<vec4<f32>, 3>,
    // Camera centre in the world.
    eye: vec3<f32>,
    // SH degree in use, at most the stored one.
    sh_degree: u32,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    // Limits to which x / z and y / z are clamped in the Jacobian of the projection.
    slope_min: vec2<f32>,
    slope_max: vec2<f32>,
    size_px: vec2<u32>,
    // Number of tiles across and down.
    tiles: vec2<u32>,
    // Number of splats.
    splats: u32,
    // Capacity for splats: the distance between rows.
    splat_stride: u32,
    pair_capacity: u32,
    // Number of planes of the picture: 4, or 8 with geometry.
    planes: u32,
    // Largest depth of a splat's centre; deeper ones are invisible.
    far: f32,
    unused_1: u32,
    unused_2: u32,
    unused_3: u32,
}

// A projected splat, as the rasteriser reads it.
struct Projected {
    mean_px: vec2<f32>,
    // Half the sides of the box of all pixels with alpha of at least ALPHA_MIN.
    extent_px: vec2<f32>,
    // (a / 2, b, c / 2) * log2(e), with [a b; b c] the inverse of the covariance on the screen, 1/px². At the offset
    // (dx, dy) from the mean, alpha is 2^(log2_opacity - (x dx² + y dx dy + z dy²)), with x, y, z the components of
    // `falloff`.
    falloff: vec3<f32>,
    log2_opacity: f32,
    rgb: vec3<f32>,
    // The value of x dx² + y dx dy + z dy² at which alpha is ALPHA_MIN: log2(255 * opacity). 0 for invisible splats.
    falloff_max: f32,
    // Normal of the splat in the camera frame, pointing towards the camera.
    normal: vec3<f32>,
    plane_distance: f32,
}

// A step of the sort: index of the counter that holds the number of keys, and lowest bit of the digit in a key.
struct SortStep {
    counter: u32,
    shift: u32,
}

// A scan: each number is replaced by the sum of the numbers before it. If `digits` is 0, counters[counter] numbers are
// scanned. If `digits` is 1, the digit counts of counters[counter] keys are scanned, 256 for each block of keys. The
// total goes to counters[total].
struct ScanStep {
    counter: u32,
    digits: u32,
    total: u32,
    unused: u32,
}

// Rows of a gradient: first those of a shape, then from GRADIENT_RGB on the gradient with respect to the colour that
// the camera sees.
const GRADIENT_RGB: u32 = 11u;
const GRADIENT_ROWS: u32 = 14u;

// Settings of the colour loss. L1 compares gain * colour + offset with the photograph, where colour is the rendered
// one.
struct LossSettings {
    gain: f32,
    offset: f32,
    // Weights of L1 and of 1 - SSIM, each divided by the number of values of the picture.
    l1_weight: f32,
    ssim_weight: f32,
    // 1 if the photograph is stored as floats, 0 if as bytes.
    is_floats: u32,
    unused_1: u32,
    unused_2: u32,
    unused_3: u32,
}

// Weight of the shortest scale of each visible splat in the loss.
struct BackwardWeights {
    scale: f32,
}

// Learning rates, and Adam's bias corrections 1 / (1 - β^step) of the first and the second moment.
struct Rates {
    mean: f32,
    quat: f32,
    log_scale: f32,
    opacity: f32,
    sh_dc: f32,
    sh_rest: f32,
    first_correction: f32,
    second_correction: f32,
}

// Weights of the surface losses. Those of the multi-view losses are per sample, all others per pixel.
struct SurfaceWeights {
    normal: f32,
    reprojection: f32,
    ncc: f32,
    teacher_depth: f32,
    teacher_normal: f32,
    // Number of samples, and index of the first of their sums in the buffer of sums.
    samples: u32,
    sums_first: u32,
    // Side of the cells that hold one sample each, px (a power of two), and the seed that draws the samples.
    cell_px: u32,
    draw: vec2<u32>,
}

// A step of an edit: which rows of a buffer it moves (the first, and their number), the distance between rows, the number
// of moves, and how many of them copy a number; the rest are of new splats, which get 0.
struct EditStep {
    first_row: u32,
    rows: u32,
    splat_stride: u32,
    moves: u32,
    copied: u32,
}

// A view ("here") and its neighbour ("there").
struct Pair {
    // Rows of the rotation from the view to its neighbour. The fourth numbers are the translation.
    there_from_here: array<vec4<f32>, 3>,
    // Camera of the neighbour.
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    size_px: vec2<u32>,
    unused_1: u32,
    unused_2: u32,
}

// Number of workgroups in a row of a dispatch. Larger dispatches have several rows.
const GROUPS_ACROSS: u32 = 65535u;

// Index of a workgroup in its dispatch.
fn group_index(group: vec3<u32>) -> u32 {
    return group.y * GROUPS_ACROSS + group.x;
}

// Number of blocks that `count` numbers take.
fn blocks_of(count: u32) -> u32 {
    return (count + BLOCK - 1u) / BLOCK;
}
