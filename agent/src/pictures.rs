//! Renderings of a model as files: colour, depth and normal as PNG, depth also as 32-bit floats.

use std::io::Write;
use std::path::Path;

use anyhow::Result;
use cosurf_engine::Views;
use cosurf_scene::colormap::{depth_picture, depth_range, normal_picture};
use cosurf_scene::{Camera, Picture, View, atomic};

use crate::viewing;

/// A picture of three bytes, the same compressed, and the sorted depths that decide its colours.
const PICTURE_BYTES_PER_PIXEL: u64 = 3 + 3 + 4;

/// Upper bound on the bytes that [`write()`] allocates for pictures of these cameras, besides the rendering.
pub fn scratch_bytes(cameras: &[Camera]) -> u64 {
    let pixels = |camera: &Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
    cameras.iter().map(pixels).max().unwrap_or(0) * PICTURE_BYTES_PER_PIXEL
}

/// Renders `view` with a long side of at most `max_size_px` and writes `NAME.color.png`, `NAME.depth.png`,
/// `NAME.normal.png` and `NAME.depth.pfm` into `folder`. NAME is the view's name without its extension, with `_` for `/`
/// and `\`. `unit` is the length of the model's unit, metres. The PFM has one 32-bit float per pixel: metres along the
/// optical axis, 0 where there is no surface.
pub fn write(model: &mut Views, view: &View, max_size_px: u32, unit: f64, folder: &Path) -> Result<()> {
    let camera = view.camera.fitted(max_size_px);
    let mut rendering = viewing::render(model, &camera)?;
    rendering.depth.iter_mut().for_each(|depth| *depth *= unit as f32);
    let stem = Path::new(&view.name).with_extension("");
    let stem = stem.to_string_lossy().replace(['/', '\\'], "_");
    let file = |kind: &str| folder.join(format!("{stem}.{kind}"));
    let range_m = depth_range(&rendering.depth);
    Picture::from_unit(rendering.size_px, &rendering.rgb).write_png(&file("color.png"))?;
    depth_picture(&rendering.depth, rendering.size_px, range_m).write_png(&file("depth.png"))?;
    normal_picture(&rendering.normal, rendering.size_px).write_png(&file("normal.png"))?;
    write_pfm(&file("depth.pfm"), rendering.size_px, &rendering.depth)
}

/// Writes a portable float map (PFM): one channel, little-endian, the bottom row of the picture first.
fn write_pfm(path: &Path, size_px: [u32; 2], values: &[f32]) -> Result<()> {
    let [width, height] = size_px;
    atomic::write(path, |file| {
        write!(file, "Pf\n{width} {height}\n-1.0\n")?;
        for row in values.chunks_exact(width as usize).rev() {
            for value in row {
                file.write_all(&value.to_le_bytes())?;
            }
        }
        Ok(())
    })?;
    Ok(())
}
