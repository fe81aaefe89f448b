//! The values of a map's pixels, kept in a file without a name, tile by tile.
//!
//! What it knows nothing about: what the values mean.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use bytemuck::Pod;
use cosurf_scene::SceneError;

use super::lattice::Window;

/// The values of all pixels. Every tile must be written before it is read.
#[derive(Debug)]
pub(super) struct Tiles<T> {
    file: File,
    /// The folder that the file is in, for errors.
    folder: PathBuf,
    size_px: [u32; 2],
    tile_px: u32,
    values: PhantomData<T>,
}

impl<T: Pod> Tiles<T> {
    /// For a map of this size, in a file on the disk of `folder`.
    pub(super) fn new(folder: &Path, size_px: [u32; 2], tile_px: u32) -> Result<Self, SceneError> {
        let file = tempfile::tempfile_in(folder).map_err(|cause| SceneError::io(folder, cause))?;
        Ok(Self { file, folder: folder.into(), size_px, tile_px, values: PhantomData })
    }

    /// Width and height of the map, px.
    pub(super) fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Number of tiles.
    pub(super) fn len(&self) -> usize {
        let [across, down] = self.across_and_down();
        across * down
    }

    /// The pixels of a tile, which are fewer at the eastern and southern edges.
    pub(super) fn window(&self, tile: usize) -> Window {
        let across = self.across_and_down()[0];
        let at = [tile % across, tile / across].map(|of| of as u32 * self.tile_px);
        Window { at, size: [0, 1].map(|axis| self.tile_px.min(self.size_px[axis] - at[axis])) }
    }

    /// The tile that has a pixel.
    pub(super) fn tile_of(&self, px: [u32; 2]) -> usize {
        let [x, y] = px.map(|of| (of / self.tile_px) as usize);
        y * self.across_and_down()[0] + x
    }

    /// Writes the values of a tile, row by row.
    pub(super) fn write(&mut self, tile: usize, values: &[T]) -> Result<(), SceneError> {
        let written = self.seek(tile).and_then(|()| self.file.write_all(bytemuck::cast_slice(values)));
        written.map_err(|cause| SceneError::io(&self.folder, cause))
    }

    /// The values of a tile, row by row.
    pub(super) fn read(&mut self, tile: usize) -> Result<Vec<T>, SceneError> {
        let mut values = vec![T::zeroed(); self.window(tile).pixels()];
        let read = self.seek(tile).and_then(|()| self.file.read_exact(bytemuck::cast_slice_mut(&mut values)));
        read.map_err(|cause| SceneError::io(&self.folder, cause))?;
        Ok(values)
    }

    /// The values of a tile and of the pixels around it, up to `margin_px` away but not beyond the edges of the map, and
    /// where they are.
    pub(super) fn read_around(
        &mut self,
        tile: usize,
        margin_px: u32,
    ) -> Result<(Window, Vec<T>), SceneError> {
        let Window { at, size } = self.window(tile);
        let first = at.map(|at| at.saturating_sub(margin_px));
        let end = [0, 1].map(|axis| (at[axis] + size[axis] + margin_px).min(self.size_px[axis]));
        let around = Window { at: first, size: [end[0] - first[0], end[1] - first[1]] };
        let mut values = vec![T::zeroed(); around.pixels()];
        for y in (first[1] / self.tile_px)..=((end[1] - 1) / self.tile_px) {
            for x in (first[0] / self.tile_px)..=((end[0] - 1) / self.tile_px) {
                let other = self.tile_of([x * self.tile_px, y * self.tile_px]);
                copy(&self.read(other)?, self.window(other), &mut values, around);
            }
        }
        Ok((around, values))
    }

    fn across_and_down(&self) -> [usize; 2] {
        self.size_px.map(|side| side.div_ceil(self.tile_px) as usize)
    }

    fn seek(&mut self, tile: usize) -> io::Result<()> {
        let bytes = u64::from(self.tile_px).pow(2) * size_of::<T>() as u64;
        self.file.seek(SeekFrom::Start(tile as u64 * bytes)).map(drop)
    }
}

/// Copies the pixels that two windows share.
pub(super) fn copy<T: Copy>(from: &[T], source: Window, to: &mut [T], target: Window) {
    let first = [0, 1].map(|axis| source.at[axis].max(target.at[axis]));
    let end =
        [0, 1].map(|axis| (source.at[axis] + source.size[axis]).min(target.at[axis] + target.size[axis]));
    let index = |of: Window, y: u32| ((y - of.at[1]) * of.size[0] + first[0] - of.at[0]) as usize;
    for y in first[1]..end[1] {
        let count = (end[0] - first[0]) as usize;
        to[index(target, y)..][..count].copy_from_slice(&from[index(source, y)..][..count]);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn tiles_come_back_as_they_were_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut tiles = Tiles::<u32>::new(folder.path(), [70, 40], 32).unwrap();
        assert_eq!(tiles.len(), 6);
        assert_eq!(tiles.window(5), Window { at: [64, 32], size: [6, 8] });
        assert_eq!([tiles.tile_of([69, 39]), tiles.tile_of([31, 32])], [5, 3]);
        let values = |tile: usize| vec![tile as u32 + 7; [1024, 1024, 192, 256, 256, 48][tile]];
        for tile in [3, 0, 5, 4, 1, 2] {
            tiles.write(tile, &values(tile)).unwrap();
        }
        for tile in 0..6 {
            assert_eq!(tiles.read(tile).unwrap(), values(tile));
        }
        let (window, around) = tiles.read_around(4, 3).unwrap();
        assert_eq!(window, Window { at: [29, 29], size: [38, 11] });
        let number = |x: u32, y: u32| around[((y - 29) * 38 + x - 29) as usize] - 7;
        let found =
            [number(29, 29), number(32, 31), number(66, 29), number(31, 39), number(50, 35), number(66, 39)];
        assert_eq!(found, [0, 1, 2, 3, 4, 5]);
    }
}
