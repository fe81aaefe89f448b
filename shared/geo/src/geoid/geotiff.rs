//! The grids of PROJ as GeoTIFF: one band of floating-point undulations, north up, in longitude and latitude. Of several
//! grids in a file, the first that covers the site is read.

use std::collections::HashMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use super::raster::{Layout, Raster};
use crate::ellipsoid::Geodetic;
use crate::error::GeoError;

/// Most chunks of the file that are kept at a time.
const CHUNKS_MAX: usize = 64;
/// GDAL's metadata as XML.
const GDAL_METADATA: Tag = Tag::Unknown(42_112);
/// Keys of the GeoTIFF standard (OGC 19-008r4) and their values.
const MODEL_TYPE: u16 = 1024;
const GEOGRAPHIC: u16 = 2;
const RASTER_TYPE: u16 = 1025;
const PIXEL_IS_POINT: u16 = 2;
/// What the grid must be, if it tells what it is.
const KIND: &str = "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL";

/// A file that is read.
pub(super) struct Grid {
    path: PathBuf,
    decoder: Decoder<BufReader<File>>,
    layout: Layout,
    nothing: Option<f32>,
    vertical_epsg: Option<u16>,
    chunks: HashMap<u32, Vec<f32>>,
}

impl Grid {
    pub(super) fn open(path: &Path, place: &Geodetic) -> Result<Self, GeoError> {
        let file = File::open(path).map_err(|cause| GeoError::Io { path: path.into(), cause })?;
        let wrong = |error: tiff::TiffError| {
            GeoError::refused(path, &format!("is not a GeoTIFF that can be read: {error}"))
        };
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(wrong)?;
        let mut layout = layout(&mut decoder).map_err(|reason| GeoError::refused(path, &reason))?;
        while !layout.covers(place) && decoder.more_images() {
            decoder.next_image().map_err(wrong)?;
            layout = self::layout(&mut decoder).map_err(|reason| GeoError::refused(path, &reason))?;
        }
        let nothing = text(&mut decoder, Tag::GdalNodata).and_then(|text| text.trim().parse().ok());
        let metadata = text(&mut decoder, GDAL_METADATA).unwrap_or_default();
        if item(&metadata, "TYPE").is_some_and(|kind| kind != KIND) {
            return Err(GeoError::refused(
                path,
                "is a grid of PROJ for something else than the heights of a geoid",
            ));
        }
        let vertical_epsg = item(&metadata, "target_crs_epsg_code").and_then(|code| code.parse().ok());
        Ok(Self { path: path.into(), decoder, layout, nothing, vertical_epsg, chunks: HashMap::new() })
    }

    /// EPSG number of the heights, if the file tells it.
    pub(super) fn vertical_epsg(&self) -> Option<u16> {
        self.vertical_epsg
    }

    fn chunk(&mut self, index: u32) -> Result<&[f32], String> {
        if !self.chunks.contains_key(&index) {
            if self.chunks.len() >= CHUNKS_MAX {
                self.chunks.clear();
            }
            let values = match self.decoder.read_chunk(index) {
                Ok(DecodingResult::F32(values)) => values,
                Ok(DecodingResult::F64(values)) => values.into_iter().map(|value| value as f32).collect(),
                Ok(_) => return Err("has no floating-point values".into()),
                Err(error) => return Err(format!("cannot be decoded: {error}")),
            };
            self.chunks.insert(index, values);
        }
        Ok(&self.chunks[&index])
    }
}

impl std::fmt::Debug for Grid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.path.display())
    }
}

impl Raster for Grid {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn value(&mut self, [column, row]: [u32; 2]) -> Result<Option<f32>, String> {
        let (width, height) = self.decoder.chunk_dimensions();
        if width == 0 || height == 0 {
            return Err("has tiles without pixels".into());
        }
        let across = self.layout.size[0].div_ceil(width);
        let index = row / height * across + column / width;
        // Chunks at the right border may be narrower.
        let (stride, _) = self.decoder.chunk_data_dimensions(index);
        let at = (row % height) as usize * stride as usize + (column % width) as usize;
        let nothing = self.nothing;
        let value = self.chunk(index)?.get(at).copied().ok_or("has a tile that is too small")?;
        Ok(Some(value).filter(|value| Some(*value) != nothing))
    }
}

/// Where the values of the current image lie.
fn layout(decoder: &mut Decoder<BufReader<File>>) -> Result<Layout, String> {
    let (width, height) = decoder.dimensions().map_err(|error| error.to_string())?;
    let mut numbers = |tag| decoder.get_tag_f64_vec(tag).unwrap_or_default();
    let (scale, tie) = (numbers(Tag::ModelPixelScaleTag), numbers(Tag::ModelTiepointTag));
    let (&[step_x, step_y, ..], &[i, j, _, x, y, _]) = (&scale[..], &tie[..]) else {
        return Err("does not tell where its pixels lie; give a grid of PROJ".into());
    };
    let keys = decoder.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).unwrap_or_default();
    if key(&keys, MODEL_TYPE).is_some_and(|model| model != GEOGRAPHIC) {
        return Err("is not in longitude and latitude; give a grid of PROJ".into());
    }
    let half = if key(&keys, RASTER_TYPE) == Some(PIXEL_IS_POINT) { 0.0 } else { 0.5 };
    let corner_deg = [x + (half - i) * step_x, y - (half - j) * step_y];
    Layout { corner_deg, step_deg: [step_x, step_y], size: [width, height] }.checked()
}

/// A short value of the directory of keys.
fn key(directory: &[u16], wanted: u16) -> Option<u16> {
    let mut entries = directory.chunks_exact(4).skip(1);
    entries.find(|entry| entry[0] == wanted && entry[1] == 0).map(|entry| entry[3])
}

fn text(decoder: &mut Decoder<BufReader<File>>, tag: Tag) -> Option<String> {
    decoder.get_tag_ascii_string(tag).ok()
}

/// The text of an item of GDAL's metadata: `<Item name="NAME" ...>TEXT</Item>`.
fn item<'a>(metadata: &'a str, name: &str) -> Option<&'a str> {
    let (_, after) = metadata.split_once(&format!("name=\"{name}\""))?;
    let (_, text) = after.split_once('>')?;
    text.split_once('<').map(|(text, _)| text.trim())
}
