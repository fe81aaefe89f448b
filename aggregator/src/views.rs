//! Renders a model in a file from cameras, within a limit of memory. A model that is too large is read once for every few
//! cameras, and only the splats that these cameras see are kept. The pictures have the same bits either way.
//!
//! What it knows nothing about: what the pictures are for.
//!
//! Where to start reading: [`Views::render`].

use std::path::PathBuf;

use cosurf_contract::usage;
use cosurf_engine::budget::{PAIRS_PER_SPLAT, PROCESS_BYTES, Viewing};
use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::{Camera, LocalFrame, SceneError, Splats, ply};

/// Number of splats that are read at a time. Together with the buffers of their renderer, they take 2 to 4 MiB.
const READ_AT_ONCE: usize = 4096;
/// Bytes for the splats that are being read.
const READING_BYTES: u64 = 4 << 20;
/// Bytes per pixel of what callers make of a picture: a photograph, its values, the true surface, pictures of errors.
const MADE_BYTES_PER_PIXEL: u64 = 48;
/// Largest number of cameras whose splats are read together. A splat has a bit for each.
const CAMERAS_MAX: usize = u64::BITS as usize;

/// A model in a file, to be rendered.
pub(crate) struct Views {
    path: PathBuf,
    frame: LocalFrame,
    threads: usize,
    /// Limit on the memory of the whole process, bytes; `None` for no limit.
    memory_bytes: Option<u64>,
    splats: usize,
    sh_degree: u32,
    /// The next cameras that will probably be asked for, in this order.
    expected: Vec<Camera>,
    loaded: Loaded,
    /// Tells how many bytes the process holds beside what every process does.
    held_bytes: fn() -> u64,
}

enum Loaded {
    Nothing,
    /// All splats.
    All(Box<Renderer>),
    /// The splats that these cameras see.
    For(Vec<Camera>, Box<Renderer>),
}

/// Why a picture could not be rendered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewError {
    /// The model cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The picture takes more memory than there is.
    #[error(
        "a picture of {} × {} px shows {splats} splats, which takes {} MiB, but the limit is {} MiB",
        size_px[0], size_px[1], needed_bytes.div_ceil(1 << 20), memory_bytes >> 20
    )]
    TooLittleMemory {
        /// Width and height of the picture, px.
        size_px: [u32; 2],
        /// Number of splats in the picture.
        splats: usize,
        /// The smallest sufficient limit, bytes.
        needed_bytes: u64,
        /// The limit, bytes.
        memory_bytes: u64,
    },
}

impl Views {
    /// The model in the PLY file `path`, moved into `frame`. Reads only the header.
    pub(crate) fn open(
        path: PathBuf,
        frame: &LocalFrame,
        memory_bytes: Option<u64>,
        threads: usize,
    ) -> Result<Self, SceneError> {
        let (splats, sh_degree) = ply::size(&path)?;
        let (expected, loaded) = (Vec::new(), Loaded::Nothing);
        let held_bytes = || usage::resident_bytes().saturating_sub(PROCESS_BYTES);
        let frame = *frame;
        Ok(Self { path, frame, threads, memory_bytes, splats, sh_degree, expected, loaded, held_bytes })
    }

    /// Number of splats of the model.
    pub(crate) fn splats(&self) -> usize {
        self.splats
    }

    /// Tells which cameras will be asked for next, so that the splats of several can be read together.
    pub(crate) fn expect(&mut self, cameras: Vec<Camera>) {
        self.expected = cameras;
    }

    /// What the model shows from a camera.
    pub(crate) fn render(&mut self, camera: &Camera) -> Result<Rendering, ViewError> {
        let is_loaded = match &self.loaded {
            Loaded::Nothing => false,
            Loaded::All(_) => true,
            Loaded::For(cameras, _) => cameras.contains(camera),
        };
        if !is_loaded {
            self.load(camera)?;
        }
        match &mut self.loaded {
            Loaded::All(renderer) | Loaded::For(_, renderer) => Ok(renderer.render(camera)),
            Loaded::Nothing => unreachable!("a model was just loaded"),
        }
    }

    /// Loads all splats if they fit, else those for `camera` and as many of the next expected cameras as fit.
    fn load(&mut self, camera: &Camera) -> Result<(), ViewError> {
        self.loaded = Loaded::Nothing; // frees its memory
        let Some(memory_bytes) = self.memory_bytes else { return self.load_all() };
        let at = self.expected.iter().position(|expected| expected == camera);
        let next = at.map_or(&[][..], |at| &self.expected[at + 1..]);
        let cameras: Vec<Camera> = [*camera].into_iter().chain(next.iter().copied()).collect();
        let Self { splats, sh_degree, .. } = *self;
        let (held_bytes, size_px) = ((self.held_bytes)(), largest(&cameras));
        let limit = Limit { memory_bytes, held_bytes, splats, sh_degree, size_px };
        if limit.bytes(splats, PAIRS_PER_SPLAT * splats) <= memory_bytes {
            return self.load_all();
        }
        let mut batch = Batch::new(cameras, limit);
        ply::read_parts(&self.path, &self.frame, READ_AT_ONCE, |part| batch.add(part, self.threads))?;
        let (cameras, renderer) = batch.end(self.threads)?;
        self.loaded = Loaded::For(cameras, Box::new(renderer));
        Ok(())
    }

    fn load_all(&mut self) -> Result<(), ViewError> {
        let splats = ply::read(&self.path, &self.frame)?;
        self.loaded = Loaded::All(Box::new(Renderer::new(&splats, self.threads)));
        Ok(())
    }
}

/// Width and height, px, of a picture that is as large as each of these.
fn largest(cameras: &[Camera]) -> [u32; 2] {
    cameras.iter().fold([0; 2], |most, camera| [0, 1].map(|axis| most[axis].max(camera.size_px[axis])))
}

/// What pictures may take.
#[derive(Clone, Copy, Debug)]
struct Limit {
    memory_bytes: u64,
    /// Bytes that the process holds beside what every process does.
    held_bytes: u64,
    /// Number of splats of the whole model.
    splats: usize,
    sh_degree: u32,
    size_px: [u32; 2],
}

impl Limit {
    /// Bytes of the process while it renders this many splats, with this many pairs of splat and tile in a picture.
    fn bytes(&self, splats: usize, pairs: usize) -> u64 {
        let viewing = Viewing { splats, sh_degree: self.sh_degree, size_px: self.size_px };
        let pixels: u64 = self.size_px.iter().map(|side| u64::from(*side)).product();
        self.held_bytes + viewing.bytes(pairs) + pixels * MADE_BYTES_PER_PIXEL
    }

    /// No splats, with room for as many as may be kept: lists that grow would take twice as much. The system gives a page
    /// only when it is used.
    fn room(&self) -> Splats {
        let each = self.bytes(1000, 0).saturating_sub(self.bytes(0, 0)) / 1000;
        let splats = self.memory_bytes.saturating_sub(self.held_bytes) / each.max(1);
        Splats::with_capacity(self.splats.min(splats as usize), self.sh_degree)
    }
}

/// The splats that some cameras see, of those that have been read.
struct Batch {
    cameras: Vec<Camera>,
    limit: Limit,
    kept: Splats,
    /// For each of `kept`: a bit for each camera that sees it.
    seen_by: Vec<u64>,
    /// For each camera: how many pairs of splat and tile its picture has.
    pairs: Vec<usize>,
    /// Number of splats that the only camera sees, if they do not fit.
    too_many: Option<usize>,
}

impl Batch {
    fn new(mut cameras: Vec<Camera>, limit: Limit) -> Self {
        cameras.truncate(CAMERAS_MAX);
        let pairs = vec![0; cameras.len()];
        Self { cameras, limit, kept: limit.room(), seen_by: Vec::new(), pairs, too_many: None }
    }

    fn add(&mut self, part: &Splats, threads: usize) {
        let mut renderer = Renderer::new(part, threads);
        let mut seen_by = vec![0u64; part.len()];
        for (bit, (camera, pairs)) in self.cameras.iter().zip(&mut self.pairs).enumerate() {
            let seen = renderer.seen(camera);
            *pairs += seen.pairs;
            seen.splats.into_iter().for_each(|splat| seen_by[splat as usize] |= 1 << bit);
        }
        drop(renderer);
        if let Some(too_many) = &mut self.too_many {
            *too_many += seen_by.iter().filter(|bits| **bits != 0).count();
            return;
        }
        for (splat, bits) in seen_by.into_iter().enumerate().filter(|(_, bits)| *bits != 0) {
            self.kept.push_from(part, splat);
            self.seen_by.push(bits);
        }
        while self.needed_bytes(self.kept.len()) > self.limit.memory_bytes && self.too_many.is_none() {
            self.shrink();
        }
    }

    /// Gives up the second half of the cameras. The only one is given up too, except for the number of its splats.
    fn shrink(&mut self) {
        if self.cameras.len() == 1 {
            self.too_many = Some(self.kept.len());
            (self.kept, self.seen_by) = (Splats::with_capacity(0, self.limit.sh_degree), Vec::new());
            return;
        }
        let left = self.cameras.len().div_ceil(2);
        self.cameras.truncate(left);
        self.pairs.truncate(left);
        let (mut fewer, mut seen_by) = (self.limit.room(), Vec::new());
        for (splat, bits) in self.seen_by.iter().map(|bits| bits & ((1 << left) - 1)).enumerate() {
            if bits != 0 {
                fewer.push_from(&self.kept, splat);
                seen_by.push(bits);
            }
        }
        (self.kept, self.seen_by) = (fewer, seen_by);
    }

    /// Bytes of the process, for this many splats.
    fn needed_bytes(&self, splats: usize) -> u64 {
        // A growing list has up to twice the room that it needs.
        let seen_by = 2 * splats * size_of::<u64>();
        READING_BYTES + seen_by as u64 + self.limit.bytes(splats, self.most_pairs())
    }

    fn most_pairs(&self) -> usize {
        self.pairs.iter().copied().max().unwrap_or(0)
    }

    fn end(self, threads: usize) -> Result<(Vec<Camera>, Renderer), ViewError> {
        if let Some(splats) = self.too_many {
            let Limit { memory_bytes, size_px, .. } = self.limit;
            let needed_bytes = self.needed_bytes(splats);
            return Err(ViewError::TooLittleMemory { size_px, splats, needed_bytes, memory_bytes });
        }
        let mut renderer = Renderer::new(&self.kept, threads);
        renderer.reserve_pairs(self.most_pairs());
        Ok((self.cameras, renderer))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{above, ground};

    fn cameras() -> Vec<Camera> {
        (0..9).map(|i| above(80.0 * f64::from(i) - 100.0).resized([64, 48])).collect()
    }

    /// The pictures of all cameras, and the largest number of cameras for which splats were read together.
    fn pictures(views: &mut Views) -> Result<(Vec<Rendering>, usize), ViewError> {
        views.expect(cameras());
        views.held_bytes = || 0;
        let (mut pictures, mut together) = (Vec::new(), 0);
        for camera in cameras() {
            pictures.push(views.render(&camera)?);
            if let Loaded::For(cameras, _) = &views.loaded {
                together = together.max(cameras.len());
            }
        }
        Ok((pictures, together))
    }

    #[test]
    fn pictures_in_little_memory_have_the_same_bits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.ply");
        let model = ground(-200.0, 600.0);
        ply::write(&path, &model, &LocalFrame::WORLD).unwrap();
        let open = |memory_bytes| Views::open(path.clone(), &LocalFrame::WORLD, memory_bytes, 2).unwrap();
        let (whole, _) = pictures(&mut open(None)).unwrap();
        assert!(whole.iter().all(|picture| picture.alpha.iter().any(|alpha| *alpha > 0.9)));
        let Err(ViewError::TooLittleMemory { needed_bytes, splats, .. }) = pictures(&mut open(Some(1)))
        else {
            panic!("a byte is not enough");
        };
        assert!(splats > 100 && splats < model.len() / 4, "{splats} of {}", model.len());
        let limit = Limit {
            memory_bytes: 0,
            held_bytes: 0,
            splats: model.len(),
            sh_degree: model.sh_degree,
            size_px: [64, 48],
        };
        let for_all = limit.bytes(model.len(), PAIRS_PER_SPLAT * model.len());
        assert!(needed_bytes < for_all, "{needed_bytes} {for_all}");
        let mut together = Vec::new();
        for memory_bytes in [needed_bytes + (64 << 10), (needed_bytes + for_all) / 2, for_all] {
            let (pictures, most) = pictures(&mut open(Some(memory_bytes))).unwrap();
            assert_eq!(pictures, whole, "{memory_bytes} of {for_all}");
            together.push(most);
        }
        assert_eq!(together, [1, 9, 0], "cameras together; 0 if the whole model fits");
    }
}
