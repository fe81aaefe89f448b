//! The GPU passes of the cosurf engine: their sources in WGSL, joined and ready to compile.
//!
//! A pass is one file in `passes/`, named like its entry point. Code that several passes share is in files in `parts/`.
//! The comment at the head of each pass names the parts that the pass uses, and a test checks that. In the joined
//! source the parts come first, and the part `types`, which every pass uses, is the first of them.
//!
//! This crate contains only text. Buffers, dispatches and the graphics library belong to `cosurf-engine`. The tests of
//! that crate validate every source, and compare the structures and constants with their counterparts in Rust.
//!
//! Where to start reading: `parts/types.wgsl` for the shared structures, then the passes in the order of a training
//! step, which is the order of [`ALL`].
//!
//! ```
//! let shader = cosurf_shaders::RASTERIZE;
//! assert_eq!((shader.name, shader.parts), ("rasterize", ["types", "pixels", "tile_list", "open_tile"].as_slice()));
//! assert!(shader.source.contains("fn rasterize("));
//! ```

/// The source of one pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shader {
    /// Name of the file of the pass, and of its entry point.
    pub name: &'static str,
    /// Names of the parts that come before the pass in `source`, in this order.
    pub parts: &'static [&'static str],
    /// The source in WGSL: the parts, then the pass.
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

        /// Every pass, in the order of a training step; scores and edits come last.
        pub const ALL: &[Shader] = &[$($id),*];
    };
}

shaders! {
    /// Projects every splat for one camera: computes its 2D Gaussian, colour, plane, depth and number of tiles.
    PROJECT: "project", "geometry", "sh", "spans";
    /// Replaces each number by the sum of the numbers before it in its block.
    SCAN_BLOCKS: "scan_blocks", "group_scan";
    /// Replaces the sum of each block by the sum of all blocks before it.
    SCAN_SUMS: "scan_sums", "group_scan";
    /// Adds to each number the sum of all blocks before its own.
    SCAN_ADD: "scan_add";
    /// Lists the visible splats with their depths.
    COMPACT: "compact";
    /// Counts, for each block of keys, how often each digit occurs.
    SORT_COUNT: "sort_count";
    /// Sorts keys and values by one digit of the keys.
    SORT_SCATTER: "sort_scatter", "group_scan";
    /// Lists the number of tiles of each visible splat, nearest splat first.
    ORDER_COUNTS: "order_counts";
    /// Writes the splat–tile pairs of each splat.
    EMIT: "emit", "spans";
    /// Finds where the pairs of each tile begin and end.
    TILE_RANGES: "tile_ranges";
    /// Blends the splats of each tile into the picture.
    RASTERIZE: "rasterize", "pixels", "tile_list", "open_tile";
    /// As [`RASTERIZE`], with one pixel for each invocation.
    RASTERIZE_BY_PIXEL: "rasterize_by_pixel", "pixels", "tile_list", "blocks", "alpha", "open_tile";
    /// Computes the SSIM of every pixel, and its partial derivatives.
    SSIM: "ssim", "pixels", "photograph", "photometric";
    /// Computes the gradient of the colour loss with respect to every pixel.
    PHOTOMETRIC_GRADIENT: "photometric_gradient", "pixels", "photograph", "photometric";
    /// Sums up the colour loss over all tiles.
    LOSS_TOTAL: "loss_total";
    /// Computes the depth of each pixel from its blended plane.
    UNBIASED_DEPTH: "unbiased_depth", "pixels", "surface";
    /// Computes the luma of a photograph.
    LUMA: "luma", "photograph";
    /// Finds the smallest and the largest slope of luma in a photograph.
    EDGES: "edges", "pixels", "luma_slope";
    /// Single-view loss: compares blended normals with normals from depth.
    NORMALS: "normals", "pixels", "surface", "luma_slope", "tile_sum";
    /// Propagates the gradients with respect to depths to the blended planes.
    DEPTH_BACKWARD: "depth_backward", "pixels", "surface", "surface_gradient";
    /// Multi-view losses: reprojection and NCC.
    MULTIVIEW: "multiview", "pixels", "surface", "surface_gradient", "samples";
    /// Losses of distillation: compares depths and normals with those of a teacher.
    TEACHER: "teacher", "pixels", "surface", "surface_gradient", "tile_sum";
    /// Backward pass of the blend.
    RASTERIZE_BACKWARD: "rasterize_backward", "pixels", "tile_list", "picture_gradient", "alpha", "crossing";
    /// As [`RASTERIZE_BACKWARD`], with one pixel for each invocation; needs subgroups.
    RASTERIZE_BACKWARD_BY_PIXEL: "rasterize_backward_by_pixel", "pixels", "tile_list", "picture_gradient", "blocks",
        "alpha";
    /// Backward pass of the projection.
    PROJECT_BACKWARD: "project_backward", "geometry", "sh";
    /// One step of the optimiser.
    ADAM: "adam", "sh";
    /// Computes what each splat–tile pair contributes to a picture.
    SCORE: "score", "pixels", "tile_list", "alpha", "crossing";
    /// Adds the contributions of the pairs to the scores of their splats.
    SCORE_COLLECT: "score_collect";
    /// Copies the numbers of the splats that an edit moves.
    EDIT_GATHER: "edit_gather", "edits";
    /// Writes the copied numbers to the new places of their splats.
    EDIT_SCATTER: "edit_scatter", "edits";
}

#[cfg(test)]
mod tests;
