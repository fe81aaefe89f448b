//! What the teachers of a tile show, in a file: written once, and read in every epoch.

use cosurf_engine::Rendering;
use cosurf_engine::backend::TargetSurface;
use cosurf_engine::{Lesson, distill};
use cosurf_scene::SceneError;

use super::crop::Part;
use crate::scratch::{Floats, Scratch};

/// Numbers for each pixel: colour, depth, normal, trust.
const CHANNELS: usize = 8;
/// The median depth is estimated from one of this many pixels.
const DEPTH_STEP: usize = 17;

/// The lessons of a tile.
#[derive(Debug)]
pub(super) struct Book {
    floats: Floats,
    /// Place and part of each lesson.
    lessons: Vec<Option<(u64, Part)>>,
    depths: Vec<f32>,
}

impl Book {
    /// A book with room for `count` lessons.
    pub(super) fn new(scratch: &Scratch, count: usize) -> Result<Self, SceneError> {
        Ok(Self { floats: scratch.column()?, lessons: vec![None; count], depths: Vec::new() })
    }

    /// Writes a lesson. `trust` has 1 for each pixel whose surface is trusted, else 0.
    pub(super) fn write(
        &mut self,
        index: usize,
        part: &Part,
        shown: &Rendering,
        trust: &[f32],
    ) -> Result<(), SceneError> {
        let Rendering { rgb, depth, normal, .. } = shown;
        let at = self.floats.append(rgb)?;
        for values in [&depth[..], normal, trust] {
            self.floats.append(values)?;
        }
        self.lessons[index] = Some((at, *part));
        self.depths.extend(depth.iter().step_by(DEPTH_STEP));
        Ok(())
    }

    /// Number of lessons.
    pub(super) fn len(&self) -> usize {
        self.lessons.len()
    }

    /// The median of all depths.
    pub(super) fn median_depth(&self) -> f64 {
        distill::median_depth(self.depths.iter().copied())
    }

    /// Reads a lesson that has been written. `numbers` keeps its numbers.
    pub(super) fn read<'a>(
        &'a self,
        index: usize,
        numbers: &'a mut Vec<f32>,
    ) -> Result<Lesson<'a>, SceneError> {
        let (at, Part { camera, far }) = self.lessons[index].as_ref().expect("every lesson has been written");
        let pixels = camera.size_px[0] as usize * camera.size_px[1] as usize;
        numbers.resize(CHANNELS * pixels, 0.0);
        self.floats.read(*at, numbers)?;
        let (rgb, rest) = numbers.split_at(3 * pixels);
        let (depth, rest) = rest.split_at(pixels);
        let (normal, trust) = rest.split_at(3 * pixels);
        Ok(Lesson { camera, far: *far, rgb, surface: TargetSurface { depth, normal, trust } })
    }
}
