//! Maps as Cloud-Optimised GeoTIFF: tiled, deflated, with overviews, readable piece by piece over a network.
//!
//! What it knows nothing about: how heights, claims and colours were found.

use std::io;
use std::path::Path;

use cosurf_scene::{SceneError, atomic};
use geotiff_writer::{
    CogBuilder, CogTileWriter, Compression, ExtraSample, GeoTiffBuilder, NumericSample,
    PhotometricInterpretation, Predictor, RasterType, Resampling,
};
use glam::DVec2;
use ndarray::{ArrayView2, ArrayView3};

use super::confidence::Claim;
use super::lattice::{Lattice, TILE_PX, Window};
use super::tiles::Tiles;

/// What stands in the files where there is nothing.
const NO_HEIGHT: f32 = -9999.0;
/// EPSG number of the metre.
const METRE: u16 = 9001;

/// Writes heights, metres, as 32-bit floats. NaN becomes the value that the file declares to be none.
pub(super) fn write_heights(
    path: &Path,
    lattice: &Lattice,
    heights: &mut Tiles<f32>,
) -> Result<(), SceneError> {
    let builder = builder(lattice).predictor(Predictor::FloatingPoint).nodata(&NO_HEIGHT.to_string());
    write(path, lattice, builder, heights, |writer, window, values| {
        let values: Vec<f32> =
            values.iter().map(|height| if height.is_nan() { NO_HEIGHT } else { *height }).collect();
        let [width, height] = window.size.map(|side| side as usize);
        let view = ArrayView2::from_shape((height, width), &values).map_err(io::Error::other)?;
        let [x, y] = window.at.map(|at| at as usize);
        writer.write_tile(x, y, &view).map_err(io::Error::other)
    })
}

/// Writes, as 32-bit floats, what is claimed of each height: number of views, spread and error, metres.
pub(super) fn write_claims(
    path: &Path,
    lattice: &Lattice,
    claims: &mut Tiles<Claim>,
) -> Result<(), SceneError> {
    let builder = builder(lattice).bands(3).nodata(&NO_HEIGHT.to_string());
    write(path, lattice, builder, claims, |writer, window, values| {
        let bands = |claim: &Claim| match claim.views > 0.0 {
            true => [claim.views, claim.spread_m, claim.error_m],
            false => [NO_HEIGHT; 3],
        };
        let values: Vec<[f32; 3]> = values.iter().map(bands).collect();
        let [width, height] = window.size.map(|side| side as usize);
        let view =
            ArrayView3::from_shape((height, width, 3), values.as_flattened()).map_err(io::Error::other)?;
        let [x, y] = window.at.map(|at| at as usize);
        writer.write_tile_3d(x, y, &view).map_err(io::Error::other)
    })
}

/// Writes colours: red, green, blue and alpha.
pub(super) fn write_colors(
    path: &Path,
    lattice: &Lattice,
    colors: &mut Tiles<[u8; 4]>,
) -> Result<(), SceneError> {
    let builder = builder(lattice)
        .predictor(Predictor::Horizontal)
        .bands(4)
        .photometric(PhotometricInterpretation::Rgb)
        .extra_samples(vec![ExtraSample::UnassociatedAlpha]);
    write(path, lattice, builder, colors, |writer, window, values| {
        let [width, height] = window.size.map(|side| side as usize);
        let view =
            ArrayView3::from_shape((height, width, 4), values.as_flattened()).map_err(io::Error::other)?;
        let [x, y] = window.at.map(|at| at as usize);
        writer.write_tile_3d(x, y, &view).map_err(io::Error::other)
    })
}

fn builder(lattice: &Lattice) -> GeoTiffBuilder {
    let [width, height] = lattice.size_px();
    let corner = lattice.map_from_px(DVec2::ZERO);
    let epsg = u16::try_from(lattice.place().projection().epsg()).expect("systems have numbers of 16 bits");
    let vertical = |builder: GeoTiffBuilder| {
        let builder = builder.vertical_citation(&lattice.place().heights());
        match lattice.place().vertical_epsg() {
            Some(epsg) => builder.vertical_epsg(epsg).vertical_units(METRE),
            None => builder,
        }
    };
    vertical(GeoTiffBuilder::new(width, height))
        .projected_epsg(epsg)
        .raster_type(RasterType::PixelIsArea)
        .pixel_scale(lattice.gsd_m(), lattice.gsd_m())
        .origin(corner.x, corner.y)
        .tile_size(TILE_PX, TILE_PX)
        .compression(Compression::Deflate)
}

fn write<T: bytemuck::Pod, S: NumericSample>(
    path: &Path,
    lattice: &Lattice,
    builder: GeoTiffBuilder,
    tiles: &mut Tiles<T>,
    put: impl Fn(&mut CogTileWriter<S, &mut io::BufWriter<std::fs::File>>, Window, &[T]) -> io::Result<()>,
) -> Result<(), SceneError> {
    let cog = CogBuilder::new(builder).resampling(Resampling::Average);
    let cog = match overviews(lattice.size_px()) {
        levels if levels.is_empty() => cog.no_overviews(),
        levels => cog.overview_levels(levels),
    };
    atomic::write(path, |file| {
        let mut writer = cog.tile_writer::<S, _>(file).map_err(io::Error::other)?;
        for tile in 0..tiles.len() {
            let values = tiles.read(tile).map_err(io::Error::other)?;
            put(&mut writer, tiles.window(tile), &values)?;
        }
        writer.finish().map(drop).map_err(io::Error::other)
    })
}

/// By what the sides of the overviews are smaller: powers of two, until an overview fits into a tile.
fn overviews(size_px: [u32; 2]) -> Vec<u32> {
    let longest = size_px[0].max(size_px[1]);
    (1..16).map(|power| 1 << power).take_while(|level| longest.div_ceil(level / 2) > TILE_PX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_overview_fits_into_a_tile() {
        assert_eq!(overviews([512, 512]), Vec::<u32>::new());
        assert_eq!(overviews([513, 2]), [2]);
        assert_eq!(overviews([700, 2048]), [2, 4]);
        assert_eq!(overviews([2049, 1]), [2, 4, 8]);
    }
}
