//! The grids of NOAA, `.gtx`: five numbers about the grid, then its values from the south-western corner, rows to the east
//! and northwards, all big-endian (VDatum, "GTX file format").

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::raster::{Layout, Raster};
use crate::error::GeoError;

/// Bytes before the values.
const HEADER_BYTES: u64 = 40;
/// Stands where there is no value.
const NOTHING: f32 = -88.8888;

/// A file that is read.
pub(super) struct Gtx {
    file: BufReader<File>,
    layout: Layout,
}

impl Gtx {
    pub(super) fn open(path: &Path) -> Result<Self, GeoError> {
        let io = |cause| GeoError::Io { path: path.into(), cause };
        let mut file = BufReader::new(File::open(path).map_err(io)?);
        let mut header = [0; HEADER_BYTES as usize];
        file.read_exact(&mut header).map_err(io)?;
        let number = |at: usize| f64::from_be_bytes(std::array::from_fn(|i| header[at + i]));
        let count = |at: usize| u32::from_be_bytes(std::array::from_fn(|i| header[at + i]));
        let (size, step_deg) = ([count(36), count(32)], [number(24), number(16)]);
        let north_deg = number(0) + step_deg[1] * (f64::from(size[1]) - 1.0);
        let layout = Layout { corner_deg: [number(8), north_deg], step_deg, size };
        let layout = layout.checked().map_err(|reason| GeoError::refused(path, &reason))?;
        let bytes = file.get_ref().metadata().map_err(io)?.len();
        match bytes == HEADER_BYTES + 4 * u64::from(size[0]) * u64::from(size[1]) {
            true => Ok(Self { file, layout }),
            false => Err(GeoError::refused(
                path,
                "is not as long as its header says; it was cut short, fetch it again",
            )),
        }
    }
}

impl Raster for Gtx {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn value(&mut self, [column, row]: [u32; 2]) -> Result<Option<f32>, String> {
        let [width, height] = self.layout.size;
        let index = u64::from(height - 1 - row) * u64::from(width) + u64::from(column);
        let mut bytes = [0; 4];
        let read = self.file.seek(SeekFrom::Start(HEADER_BYTES + 4 * index));
        read.and_then(|_| self.file.read_exact(&mut bytes)).map_err(|error| error.to_string())?;
        let value = f32::from_be_bytes(bytes);
        Ok((value != NOTHING).then_some(value))
    }
}
