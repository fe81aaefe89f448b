//! A picture for a mesh, with more detail than its vertices have: the colours that the cameras show.
//!
//! The mesh is cut into charts, connected pieces seen along an axis; the charts are packed into one picture, which becomes
//! `mesh.jpg`. A texel is half a ground sample distance wide, so that slopes, which charts shorten, keep their detail; wider
//! if the picture would have too many pixels or take too much memory.
//!
//! What it knows nothing about: maps; how the cameras' pictures came to be; formats of meshes.
//!
//! Where to start reading: [`texture`]. `raster` is below `charts` and `paint`.

mod charts;
mod pack;
mod paint;
mod raster;

use std::io;
use std::path::PathBuf;

use cosurf_scene::{Mesh, Texture, atomic};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

use crate::survey::depths::Depths;
use crate::survey::error::SurveyError;
use charts::{Chart, charts};
use pack::{Packed, pack};
use paint::{Painting, TEXEL_BYTES};

/// Largest side of the picture, px: phones and WebGL show no larger ones.
const SIDE_MAX_PX: u32 = 8192;
/// Side of a texel, as a share of the ground sample distance.
const TEXEL_GSD: f64 = 0.5;
/// A texel of more voxels than this shows no more than the vertices do.
const TEXEL_VOXELS_MAX: f64 = 1.5;
/// How much wider texels become when the picture does not fit.
const WIDER: f64 = 1.2;
/// Bytes of a pixel of the picture.
const PIXEL_BYTES: u64 = size_of::<[u8; 3]>() as u64;
/// Bytes of a texel of one chart while its colours are spread: two copies.
const SPREAD_BYTES: u64 = 2 * size_of::<Option<glam::Vec3>>() as u64;
/// Bytes of a triangle while charts are made (three edges, and its place) and in the mesh that results, whose vertices may
/// all be there three times.
const TRIANGLE_BYTES: u64 = 3 * 12 + 32 + 12 + 3 * (12 + 8);
/// JPEG quality: above it, files grow much faster than colours improve.
const JPEG_QUALITY: u8 = 90;

/// What the picture may be.
#[derive(Clone, Debug)]
pub(super) struct TextureOrder {
    /// JPEG file to write.
    pub(super) picture: PathBuf,
    /// Length that a pixel of the cameras covers on the surface, metres, above 0.
    pub(super) gsd_m: f64,
    /// Edge length of the mesh's voxels, metres, above 0.
    pub(super) voxel_m: f64,
    /// Memory that may be used, bytes.
    pub(super) bytes: u64,
}

/// A mesh with a picture.
#[derive(Debug)]
pub(super) struct Textured {
    /// In the world, without colours.
    pub(super) mesh: Mesh,
    pub(super) texture: Texture,
    /// Side of a texel, metres.
    pub(super) texel_m: f64,
}

/// Paints the picture of a mesh in the world, and writes it. `None` if the memory is too small for more detail than the
/// vertices have; nothing is written then. `on_view` gets the number of cameras that are done, and of all.
pub(super) fn texture(
    mesh: &Mesh,
    depths: &mut Depths,
    order: &TextureOrder,
    mut on_view: impl FnMut(usize, usize),
) -> Result<Option<Textured>, SurveyError> {
    let Some(layout) = Layout::within(mesh, order, depths.largest_bytes()) else { return Ok(None) };
    let mut painting = Painting::new(mesh, &layout.charts, layout.texel_m);
    depths.each(|[done, of], map| {
        painting.add(map, order.voxel_m);
        on_view(done, of);
        Ok::<(), SurveyError>(())
    })?;
    let pixels = layout.pixels(painting, mean(&mesh.rgb));
    let [width, height] = layout.packed.size_px;
    atomic::write(&order.picture, |file| {
        let mut encoder = JpegEncoder::new_with_quality(file, JPEG_QUALITY);
        encoder
            .encode(pixels.as_flattened(), width, height, ExtendedColorType::Rgb8)
            .map_err(io::Error::other)
    })?;
    drop(pixels);
    let (mesh, uv) = layout.mesh(mesh);
    let texture = Texture { uv, picture: order.picture.clone() };
    Ok(Some(Textured { mesh, texture, texel_m: layout.texel_m }))
}

/// The charts of a mesh, and where they lie on the picture.
struct Layout {
    charts: Vec<Chart>,
    packed: Packed,
    /// Side of a texel, metres.
    texel_m: f64,
}

impl Layout {
    /// The layout with the smallest texels that an order allows, beside a camera's picture of `shown_bytes`.
    fn within(mesh: &Mesh, order: &TextureOrder, shown_bytes: u64) -> Option<Self> {
        let fixed = shown_bytes + mesh.triangles.len() as u64 * TRIANGLE_BYTES;
        let bytes = order.bytes.checked_sub(fixed)?;
        let mut texel_m = TEXEL_GSD * order.gsd_m;
        let most_m = texel_m.max(TEXEL_VOXELS_MAX * order.voxel_m);
        while texel_m <= most_m {
            let layout = Self::of(mesh, texel_m, bytes / TEXEL_BYTES);
            if let Some(layout) = layout.filter(|layout| layout.bytes() <= bytes) {
                return Some(layout);
            }
            texel_m *= WIDER;
        }
        None
    }

    fn of(mesh: &Mesh, texel_m: f64, texels_max: u64) -> Option<Self> {
        let charts = charts(mesh, texel_m, texels_max)?;
        let sizes: Vec<[u32; 2]> = charts.iter().map(|chart| chart.size).collect();
        Some(Self { packed: pack(&sizes, SIDE_MAX_PX)?, charts, texel_m })
    }

    /// Memory that painting takes, bytes.
    fn bytes(&self) -> u64 {
        let texels = self.charts.iter().map(Chart::texel_count);
        let picture = self.packed.size_px.map(u64::from).iter().product::<u64>() * PIXEL_BYTES;
        let largest = texels.clone().max().unwrap_or_default();
        texels.sum::<u64>() * TEXEL_BYTES + largest * SPREAD_BYTES + picture
    }

    /// The picture, row by row. Between charts it has the colour `between`, which viewers blend with theirs as they shrink it.
    fn pixels(&self, painting: Painting<'_>, between: [u8; 3]) -> Vec<[u8; 3]> {
        let [width, height] = self.packed.size_px.map(|side| side as usize);
        let mut pixels = vec![between; width * height];
        painting.finish(|i, chart, colors| {
            let [x, y] = self.packed.at[i].map(|px| px as usize);
            for (row, colors) in colors.chunks(chart.size[0] as usize).enumerate() {
                pixels[(y + row) * width + x..][..colors.len()].copy_from_slice(colors);
            }
        });
        pixels
    }

    /// The mesh with the vertices of each chart, and where they lie on the picture.
    fn mesh(&self, of: &Mesh) -> (Mesh, Vec<[f32; 2]>) {
        let (mut mesh, mut uv) = (Mesh { origin: of.origin, ..Mesh::default() }, Vec::new());
        let mut chart_of = vec![usize::MAX; of.positions.len()];
        let mut new_of = vec![0; of.positions.len()];
        let size_px = self.packed.size_px.map(f64::from);
        for (i, chart) in self.charts.iter().enumerate() {
            let at_px = self.packed.at[i].map(f64::from);
            for triangle in &chart.triangles {
                mesh.triangles.push(of.triangles[*triangle as usize].map(|vertex| {
                    let vertex = vertex as usize;
                    if chart_of[vertex] != i {
                        (chart_of[vertex], new_of[vertex]) = (i, mesh.positions.len() as u32);
                        let position = of.positions[vertex];
                        let texels = chart.texels(position.map(f64::from).into(), self.texel_m);
                        mesh.positions.push(position);
                        uv.push([0, 1].map(|axis| ((at_px[axis] + texels[axis]) / size_px[axis]) as f32));
                    }
                    new_of[vertex]
                }));
            }
        }
        (mesh, uv)
    }
}

/// The mean of some colours; black if there are none.
fn mean(rgb: &[[u8; 3]]) -> [u8; 3] {
    let sum = |k: usize| rgb.iter().map(|rgb| u64::from(rgb[k])).sum::<u64>();
    [0, 1, 2].map(|k| (sum(k) / (rgb.len() as u64).max(1)) as u8)
}

#[cfg(test)]
mod tests;
