// Structures and constants of all passes; comes first in every source. Tests of cosurf-engine compare them with their
// twins in Rust.

// Side of a tile, px, and its pixels.
const TILE: u32 = 16u;
const TILE_PIXELS: u32 = 256u;
// Invocations of a workgroup in the passes over splats, pairs and pixels.
const GROUP: u32 = 256u;
// Numbers that one workgroup scans or sorts: 4 for each invocation.
const BLOCK: u32 = 1024u;
// Values of a digit that keys are sorted by.
const DIGITS: u32 = 16u;

// Splats nearer than this to the camera's plane are not drawn (3DGS; scene units).
const NEAR: f32 = 0.2;
// Blend weights below this are skipped, and its log2 (3DGS).
const ALPHA_MIN: f32 = 1.0 / 255.0;
const LOG2_ALPHA_MIN: f32 = -7.994353436858858;
// Largest blend weight of one splat (3DGS).
const ALPHA_MAX: f32 = 0.99;
// A pixel is full before its transmittance would fall below this (3DGS).
const TRANSMITTANCE_MIN: f32 = 1e-4;
// Variance added to both screen axes, px² (3DGS's low-pass).
const LOW_PASS_PX2: f32 = 0.3;
const LOG2_E: f32 = 1.4426950408889634;
const LN_2: f32 = 0.6931471805599453;

// Depth key of an invisible splat: larger than the bits of every positive float.
const NOT_SEEN: u32 = 0xffffffffu;

// Places in the buffer of counters.
const SPLATS: u32 = 0u;
const VISIBLE: u32 = 1u;
// Splat-tile pairs of the view, and those within the capacity.
const PAIRS_WANTED: u32 = 2u;
const PAIRS: u32 = 3u;

// Rows of a splat's shape: row r of splat i is shape[r * view.splat_stride + i].
const MEAN: u32 = 0u;
const QUAT: u32 = 3u;
const LOG_SCALE: u32 = 7u;
const OPACITY: u32 = 10u;

// Rows of the densification statistics, and of the scores.
const STAT_SCREEN_GRADIENT: u32 = 0u;
const STAT_VIEWS: u32 = 1u;
const STAT_ABSOLUTE_GRADIENT: u32 = 2u;
const SQUARED_WEIGHT: u32 = 0u;
const HITS: u32 = 1u;
const OBSERVED: u32 = 2u;

// Vectors of a splat-tile pair's record, and of the loss sums of one channel of a tile.
const RECORD_VECTORS: u32 = 4u;
const LOSS_VECTORS: u32 = 2u;

// Planes of a picture: colour, remaining transmittance; with geometry, normal and plane distance. In tiles:
// value (plane, pixel of the tile) of tile t is image[(t * view.planes + plane) * TILE_PIXELS + pixel].
const TRANSMITTANCE: u32 = 3u;
const NORMAL: u32 = 4u;
const DISTANCE: u32 = 7u;
const PLANES_GEOMETRY: u32 = 8u;

// A camera.
struct View {
    // Rows of the rotation, and the translation as their fourth numbers.
    cam_from_world: array<vec4<f32>, 3>,
    // Camera centre in the world.
    eye: vec3<f32>,
    // SH degree in use, at most the stored one.
    sh_degree: u32,
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    // Limits of x / z and y / z inside the Jacobian.
    slope_min: vec2<f32>,
    slope_max: vec2<f32>,
    size_px: vec2<u32>,
    // Tiles across and down.
    tiles: vec2<u32>,
    splats: u32,
    // Capacity for splats: the distance between rows.
    splat_stride: u32,
    pair_capacity: u32,
    // Planes of the picture: 4, or 8 with geometry.
    planes: u32,
}

// A splat as the rasteriser reads it.
struct Projected {
    mean_px: vec2<f32>,
    // Half the sides of the box of all pixels with alpha of at least ALPHA_MIN.
    extent_px: vec2<f32>,
    // (a / 2, b, c / 2) log2(e) of the inverse covariance [a b; b c], 1/px²: alpha is
    // 2^(log2_opacity - (x dx² + y dx dy + z dy²)).
    falloff: vec3<f32>,
    log2_opacity: f32,
    rgb: vec3<f32>,
    // log2(255 o): the largest falloff that is blended; 0 for invisible splats.
    falloff_max: f32,
    // Camera frame, towards the camera.
    normal: vec3<f32>,
    plane_distance: f32,
}

// A step of the sort: the counter with the number of keys, and the position of the digit.
struct SortStep {
    counter: u32,
    shift: u32,
}

// A scan of counters[counter] numbers; if `digits` is 1, a scan of the digit counts (16 for each block) of
// counters[counter] keys. The total goes to counters[total].
struct ScanStep {
    counter: u32,
    digits: u32,
    total: u32,
    unused: u32,
}

// Rows of a gradient: those of a shape, then ∂L/∂rgb of the seen colour.
const GRADIENT_RGB: u32 = 11u;
const GRADIENT_ROWS: u32 = 14u;

// Settings of the colour loss. The photograph shows gain * colour + offset.
struct LossSettings {
    gain: f32,
    offset: f32,
    // Weights of L1 and 1 - SSIM, each divided by the number of values of the picture.
    l1_weight: f32,
    ssim_weight: f32,
    // 1 where the photograph is floats, 0 where it is bytes.
    is_floats: u32,
    unused_1: u32,
    unused_2: u32,
    unused_3: u32,
}

// Weight of one visible splat's shortest scale.
struct BackwardWeights {
    scale: f32,
}

// Learning rates, and bias corrections 1 / (1 - β^step).
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

// Weights of the surface losses: per pixel, or per sample for the multi-view losses.
struct SurfaceWeights {
    normal: f32,
    reprojection: f32,
    ncc: f32,
    teacher_depth: f32,
    teacher_normal: f32,
    // Number of samples, and the index of their first sum.
    samples: u32,
    sums_first: u32,
    unused: u32,
}

// A view and its neighbour.
struct Pair {
    // Rows of the rotation, and the translation as their fourth numbers.
    there_from_here: array<vec4<f32>, 3>,
    // Camera of the neighbour.
    focal_px: vec2<f32>,
    center_px: vec2<f32>,
    size_px: vec2<u32>,
    unused_1: u32,
    unused_2: u32,
}

// Workgroups in a row of a dispatch; larger dispatches have several rows.
const GROUPS_ACROSS: u32 = 65535u;

fn group_index(group: vec3<u32>) -> u32 {
    return group.y * GROUPS_ACROSS + group.x;
}

fn blocks_of(count: u32) -> u32 {
    return (count + BLOCK - 1u) / BLOCK;
}
