//! The sources of the passes: one file each, with what they share put before it.

/// A pass: its name, which is that of its file and of its entry point, and its source.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shader {
    pub(super) name: &'static str,
    pub(super) source: &'static str,
}

/// `shader!("project", "geometry", …)`: `types`, then the named parts, then the pass itself.
macro_rules! shader {
    ($name:literal $(, $part:literal)*) => {
        Shader {
            name: $name,
            source: concat!(
                include_str!("../../../../shaders/types.wgsl"),
                $(include_str!(concat!("../../../../shaders/", $part, ".wgsl")),)*
                include_str!(concat!("../../../../shaders/", $name, ".wgsl")),
            ),
        }
    };
}

pub(super) const PROJECT: Shader = shader!("project", "geometry", "sh", "spans");
pub(super) const SCAN_BLOCKS: Shader = shader!("scan_blocks", "group_scan");
pub(super) const SCAN_SUMS: Shader = shader!("scan_sums", "group_scan");
pub(super) const SCAN_ADD: Shader = shader!("scan_add");
pub(super) const COMPACT: Shader = shader!("compact");
pub(super) const SORT_COUNT: Shader = shader!("sort_count");
pub(super) const SORT_SCATTER: Shader = shader!("sort_scatter");
pub(super) const ORDER_COUNTS: Shader = shader!("order_counts");
pub(super) const EMIT: Shader = shader!("emit", "spans");
pub(super) const TILE_RANGES: Shader = shader!("tile_ranges");
pub(super) const RASTERIZE: Shader = shader!("rasterize", "pixels", "tile_list");
pub(super) const SSIM: Shader = shader!("ssim", "pixels", "photograph", "photometric");
pub(super) const PHOTOMETRIC_GRADIENT: Shader =
    shader!("photometric_gradient", "pixels", "photograph", "photometric");
pub(super) const LOSS_TOTAL: Shader = shader!("loss_total");
pub(super) const UNBIASED_DEPTH: Shader = shader!("unbiased_depth", "pixels", "surface");
pub(super) const LUMA: Shader = shader!("luma", "photograph");
pub(super) const EDGES: Shader = shader!("edges", "pixels", "luma_slope");
pub(super) const NORMALS: Shader = shader!("normals", "pixels", "surface", "luma_slope", "tile_sum");
pub(super) const DEPTH_BACKWARD: Shader = shader!("depth_backward", "pixels", "surface", "surface_gradient");
pub(super) const MULTIVIEW: Shader = shader!("multiview", "pixels", "surface", "surface_gradient");
pub(super) const TEACHER: Shader = shader!("teacher", "pixels", "surface", "surface_gradient", "tile_sum");
pub(super) const RASTERIZE_BACKWARD: Shader =
    shader!("rasterize_backward", "pixels", "tile_list", "crossing");
pub(super) const PROJECT_BACKWARD: Shader = shader!("project_backward", "geometry", "sh");
pub(super) const ADAM: Shader = shader!("adam", "sh");
pub(super) const SCORE: Shader = shader!("score", "pixels", "tile_list", "crossing");
pub(super) const SCORE_COLLECT: Shader = shader!("score_collect");

/// Every pass.
#[cfg(test)]
pub(super) const ALL: [Shader; 26] = [
    PROJECT,
    SCAN_BLOCKS,
    SCAN_SUMS,
    SCAN_ADD,
    COMPACT,
    SORT_COUNT,
    SORT_SCATTER,
    ORDER_COUNTS,
    EMIT,
    TILE_RANGES,
    RASTERIZE,
    SSIM,
    PHOTOMETRIC_GRADIENT,
    LOSS_TOTAL,
    UNBIASED_DEPTH,
    LUMA,
    EDGES,
    NORMALS,
    DEPTH_BACKWARD,
    MULTIVIEW,
    TEACHER,
    RASTERIZE_BACKWARD,
    PROJECT_BACKWARD,
    ADAM,
    SCORE,
    SCORE_COLLECT,
];
