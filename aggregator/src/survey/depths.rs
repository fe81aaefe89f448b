//! The depths and colours that each camera of a model shows: rendered once, kept in a file without a name, and read again.
//!
//! What it knows nothing about: what depths are compared with, and what is painted with the colours.

use std::fs::File;
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use cosurf_engine::Rendering;
use cosurf_scene::{Camera, SceneError};

/// Below this alpha a picture shows too little to have a depth.
const ALPHA_LEAST: f32 = 0.5;

/// Bytes of a pixel: its depth and its colour.
const PIXEL_BYTES: u64 = (size_of::<f32>() + size_of::<[u8; 3]>()) as u64;

/// What a camera shows.
#[derive(Debug)]
pub(super) struct DepthMap {
    /// The camera, in the world.
    pub(super) camera: Camera,
    /// For each pixel, row by row: depth along the optical axis, metres; 0 where nothing is shown.
    pub(super) depth_m: Vec<f32>,
    /// For each pixel: its colour, 8-bit sRGB.
    pub(super) rgb: Vec<[u8; 3]>,
}

impl DepthMap {
    /// What `camera` shows: `rendering`, whose lengths are in units of `unit_m` metres.
    pub(super) fn of(camera: &Camera, rendering: &Rendering, unit_m: f64) -> Self {
        let shown = rendering.depth.iter().zip(&rendering.alpha);
        let depth_m = shown
            .map(|(depth, alpha)| if *alpha < ALPHA_LEAST { 0.0 } else { depth * unit_m as f32 })
            .collect();
        // Renderings have a black background, which shows through where alpha is below 1.
        let whole = |(rgb, alpha): (&[f32], &f32)| {
            [0, 1, 2].map(|k| (255.0 * rgb[k] / alpha.max(ALPHA_LEAST)).round() as u8)
        };
        let rgb = rendering.rgb.chunks_exact(3).zip(&rendering.alpha).map(whole).collect();
        Self { camera: *camera, depth_m, rgb }
    }
}

/// The depth maps of all cameras. They take [`PIXEL_BYTES`] of disk for each pixel.
#[derive(Debug)]
pub(super) struct Depths {
    file: File,
    /// The folder that the file is in, for errors.
    folder: PathBuf,
    cameras: Vec<Camera>,
}

impl Depths {
    /// None yet, in a file on the disk of `folder`.
    pub(super) fn new(folder: &Path) -> Result<Self, SceneError> {
        let file = tempfile::tempfile_in(folder).map_err(|cause| SceneError::io(folder, cause))?;
        Ok(Self { file, folder: folder.into(), cameras: Vec::new() })
    }

    /// Adds a map behind those that are there.
    pub(super) fn push(&mut self, map: &DepthMap) -> Result<(), SceneError> {
        for bytes in [bytemuck::cast_slice(&map.depth_m), map.rgb.as_flattened()] {
            self.file.write_all(bytes).map_err(|cause| SceneError::io(&self.folder, cause))?;
        }
        self.cameras.push(map.camera);
        Ok(())
    }

    /// Size of the largest map, bytes: [`Self::each`] holds one.
    pub(super) fn largest_bytes(&self) -> u64 {
        let pixels = self.cameras.iter().map(|camera| camera.size_px.map(u64::from).iter().product::<u64>());
        pixels.max().unwrap_or_default() * PIXEL_BYTES
    }

    /// Calls `visit` with the number of maps so far and in all, and each map, in the order in which they were added.
    pub(super) fn each<E: From<SceneError>>(
        &mut self,
        mut visit: impl FnMut([usize; 2], &DepthMap) -> Result<(), E>,
    ) -> Result<(), E> {
        let failed = |cause| SceneError::io(&self.folder, cause);
        self.file.rewind().map_err(failed)?;
        for (i, camera) in self.cameras.iter().enumerate() {
            let [width, height] = camera.size_px.map(|side| side as usize);
            let mut depth_m = vec![0.0; width * height];
            self.file.read_exact(bytemuck::cast_slice_mut(&mut depth_m)).map_err(failed)?;
            let mut rgb = vec![[0; 3]; width * height];
            self.file.read_exact(rgb.as_flattened_mut()).map_err(failed)?;
            visit([i + 1, self.cameras.len()], &DepthMap { camera: *camera, depth_m, rgb })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::above;

    #[test]
    fn maps_come_back_with_their_cameras_and_thin_pixels_have_no_depth() {
        let folder = tempfile::tempdir().unwrap();
        let cameras = [above(0.0).resized([3, 2]), above(1.0).resized([2, 2])];
        let mut depths = Depths::new(folder.path()).unwrap();
        for (i, camera) in cameras.iter().enumerate() {
            let pixels = (camera.size_px[0] * camera.size_px[1]) as usize;
            let mut alpha = vec![0.5; pixels];
            alpha[1] = 0.49;
            let (rgb, normal) = ([0.2, 0.4, 1.5].repeat(pixels), Vec::new());
            let depth = vec![4.0 + i as f32; pixels];
            let rendering = Rendering { size_px: camera.size_px, rgb, alpha, depth, normal };
            depths.push(&DepthMap::of(camera, &rendering, 2.0)).unwrap();
        }
        let mut found = Vec::new();
        let visited = depths.each(|counts, map| {
            assert_eq!(map.rgb, vec![[102, 204, 255]; map.depth_m.len()]);
            found.push((counts, map.camera, map.depth_m.clone()));
            Ok::<(), SceneError>(())
        });
        visited.unwrap();
        let wanted = [
            ([1, 2], cameras[0], vec![8.0, 0.0, 8.0, 8.0, 8.0, 8.0]),
            ([2, 2], cameras[1], vec![10.0, 0.0, 10.0, 10.0]),
        ];
        assert_eq!(found, wanted);
        assert_eq!(depths.largest_bytes(), 6 * 7);
    }
}
