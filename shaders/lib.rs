//! The GPU passes of the cosurf engine: their sources in WGSL, joined and ready to compile.
//!
//! A pass is one file in `passes/`, named like its entry point. Code that several passes share is a file in `parts/`;
//! the head of each pass names its parts, and a test checks that. The parts come first in the joined source, with
//! `types`, which every pass has, before all others.
//!
//! This crate contains only text. Buffers, dispatches and the graphics library belong to `cosurf-engine`. Its
//! tests validate every source, and compare the structures and constants with their counterparts in Rust.
//!
//! Where to start reading: `parts/types.wgsl` for the shared structures, then the passes in the order of a training
//! step, which is the order of [`ALL`].
//!
//! ```
//! let shader = cosurf_shaders::RASTERIZE;
//! assert_eq!((shader.name, shader.parts), ("rasterize", ["types", "pixels", "tile_list"].as_slice()));
//! assert!(shader.source.contains("fn rasterize("));
//! ```

/// The source of one pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shader {
    /// Name of its file and of its entry point.
    pub name: &'static str,
    /// Names of the parts that come before it in the source, in this order.
    pub parts: &'static [&'static str],
    /// WGSL: the parts, then the pass.
    pub source: &'static str,
}

/// `shaders! { /// docs NAME: "name", "part", …; }`: a constant for each pass, and [`ALL`] of them.
macro_rules! shaders {
    ($($(#[$doc:meta])* $id:ident: $name:literal $(, $part:literal)*;)*) => {
        $($(#[$doc])* pub const $id: Shader = Shader {
            name: $name,
            parts: &["types" $(, $part)*],
            source: concat!(
                include_str!("parts/types.wgsl"),
                $(include_str!(concat!("parts/", $part, ".wgsl")),)*
                include_str!(concat!("passes/", $name, ".wgsl")),
            ),
        };)*

        /// Every pass, in the order of a training step; scores come last.
        pub const ALL: &[Shader] = &[$($id),*];
    };
}

shaders! {
    /// Projects every splat for one camera: 2D Gaussian, colour, plane, depth, number of tiles.
    PROJECT: "project", "geometry", "sh", "spans";
    /// Running sums within blocks of numbers.
    SCAN_BLOCKS: "scan_blocks", "group_scan";
    /// Running sums of the sums of the blocks.
    SCAN_SUMS: "scan_sums", "group_scan";
    /// Adds the running sums of the blocks to the numbers in them.
    SCAN_ADD: "scan_add";
    /// Lists the visible splats with their depths.
    COMPACT: "compact";
    /// Counts the digits of the keys in each block.
    SORT_COUNT: "sort_count";
    /// Moves keys and values to their places by one digit.
    SORT_SCATTER: "sort_scatter";
    /// Number of tiles of each visible splat, nearest splat first.
    ORDER_COUNTS: "order_counts";
    /// Writes the splat–tile pairs.
    EMIT: "emit", "spans";
    /// Finds where the pairs of each tile begin and end.
    TILE_RANGES: "tile_ranges";
    /// Blends the splats of each tile into the picture.
    RASTERIZE: "rasterize", "pixels", "tile_list";
    /// SSIM's map and its partial derivatives.
    SSIM: "ssim", "pixels", "photograph", "photometric";
    /// Gradient of the colour loss.
    PHOTOMETRIC_GRADIENT: "photometric_gradient", "pixels", "photograph", "photometric";
    /// Sums of the colour loss over all tiles.
    LOSS_TOTAL: "loss_total";
    /// Depth of the blended planes.
    UNBIASED_DEPTH: "unbiased_depth", "pixels", "surface";
    /// Luma of a photograph.
    LUMA: "luma", "photograph";
    /// Smallest and largest slope of a photograph.
    EDGES: "edges", "pixels", "luma_slope";
    /// Single-view loss: blended normals against normals of the depth.
    NORMALS: "normals", "pixels", "surface", "luma_slope", "tile_sum";
    /// Propagates the gradients of depths to the blended planes.
    DEPTH_BACKWARD: "depth_backward", "pixels", "surface", "surface_gradient";
    /// Multi-view losses: reprojection and NCC.
    MULTIVIEW: "multiview", "pixels", "surface", "surface_gradient";
    /// Losses of distillation.
    TEACHER: "teacher", "pixels", "surface", "surface_gradient", "tile_sum";
    /// Backward pass of the blend.
    RASTERIZE_BACKWARD: "rasterize_backward", "pixels", "tile_list", "crossing";
    /// Backward pass of the projection.
    PROJECT_BACKWARD: "project_backward", "geometry", "sh";
    /// One step of the optimiser.
    ADAM: "adam", "sh";
    /// What each splat–tile pair contributes to a picture.
    SCORE: "score", "pixels", "tile_list", "crossing";
    /// Adds the contributions of the pairs to the scores of their splats.
    SCORE_COLLECT: "score_collect";
}

#[cfg(test)]
mod tests;
