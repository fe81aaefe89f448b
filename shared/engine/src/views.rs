//! Renders a model in a file from cameras, on a device or within a limit of memory. A model that is too large for the limit
//! is read once for every few cameras, and only the splats that these cameras see are kept. The pictures have the same
//! bits as without a limit.
//!
//! What it knows nothing about: what the pictures are for, and how much memory the process holds: its user tells.
//!
//! Where to start reading: [`Views::render`].

use std::path::PathBuf;

use cosurf_scene::{Camera, LocalFrame, SceneError, Splats, model};

use crate::backend::Rendering;
use crate::budget::Viewing;
use crate::device::{DeviceChoice, DeviceError};
use crate::render::Renderer;

/// Number of splats that are read at a time. Together with the buffers of their renderer, they take 2 to 4 MiB.
const READ_AT_ONCE: usize = 4096;
/// Bytes for the splats that are being read.
const READING_BYTES: u64 = 4 << 20;
/// Largest number of cameras whose splats are read together. A splat has a bit for each.
const CAMERAS_MAX: usize = u64::BITS as usize;

/// A model in a file, to be rendered.
pub struct Views {
    path: PathBuf,
    frame: LocalFrame,
    threads: usize,
    place: Place,
    splats: usize,
    sh_degree: u32,
    /// The next cameras that will probably be asked for, in this order.
    expected: Vec<Camera>,
    /// Whether it was found out how much memory the cameras need.
    is_checked: bool,
    /// Whether a picture of all splats was found to take too much memory.
    is_too_large: bool,
    loaded: Option<Loaded>,
}

/// Where pictures are rendered.
#[derive(Clone, Copy, Debug)]
pub enum Place {
    /// On this device, with all the memory that it takes.
    On(DeviceChoice),
    /// On the processor, within a limit.
    Within(ViewMemory),
}

/// How much memory a process that renders pictures may take, and what it takes for other things.
#[derive(Clone, Copy, Debug)]
pub struct ViewMemory {
    /// Limit on the resident memory of the whole process, bytes.
    pub limit_bytes: u64,
    /// Tells how many bytes the process holds now beside [`PROCESS_BYTES`](crate::budget::PROCESS_BYTES). It is asked while
    /// no splats are loaded.
    pub held_bytes: fn() -> u64,
    /// Bytes for what the user makes of a picture, of whatever size.
    pub made_bytes: u64,
    /// Bytes for what the user makes of a picture, for each of its pixels.
    pub made_bytes_per_pixel: u64,
}

/// Splats in memory.
struct Loaded {
    renderer: Renderer,
    room: Room,
}

/// Which pictures there is room for.
enum Room {
    /// All.
    All,
    /// Those of at most this size and with at most so many pairs of splat and tile.
    Limited { size_px: [u32; 2], pairs: usize },
    /// Those of these cameras.
    Cameras(Vec<Camera>),
}

impl Room {
    /// Tells whether the splats that a camera sees are loaded, and whether its picture is not too large.
    fn is_for(&self, camera: &Camera) -> bool {
        match self {
            Self::All => true,
            Self::Limited { size_px, .. } => (0..2).all(|axis| camera.size_px[axis] <= size_px[axis]),
            Self::Cameras(cameras) => cameras.contains(camera),
        }
    }

    fn pairs(&self) -> usize {
        match self {
            Self::Limited { pairs, .. } => *pairs,
            Self::All | Self::Cameras(_) => usize::MAX,
        }
    }
}

/// Why a picture could not be rendered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewError {
    /// The model cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The device cannot be opened, or was lost.
    #[error(transparent)]
    Device(#[from] DeviceError),
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
    /// The model in the file `path`, moved into `frame`. Reads only the header. The processor uses `threads` threads, at
    /// least 1.
    pub fn open(path: PathBuf, frame: &LocalFrame, place: Place, threads: usize) -> Result<Self, SceneError> {
        let (splats, sh_degree) = model::size(&path)?;
        Ok(Self {
            path,
            frame: *frame,
            threads,
            place,
            splats,
            sh_degree,
            expected: Vec::new(),
            is_checked: false,
            is_too_large: false,
            loaded: None,
        })
    }

    /// Number of splats of the model.
    pub fn splats(&self) -> usize {
        self.splats
    }

    /// Tells which cameras will be asked for next, so that the splats of several can be read together. The first picture
    /// is refused if a later one of the cameras that were told first takes too much memory.
    pub fn expect(&mut self, cameras: Vec<Camera>) {
        self.expected = cameras;
    }

    /// The smallest limit on the memory of the process that suffices for a picture of each of these cameras, bytes. Reads the
    /// file once. 0 if there is no limit.
    pub fn needed_bytes(&mut self, cameras: &[Camera]) -> Result<u64, SceneError> {
        let Place::Within(memory) = self.place else { return Ok(0) };
        self.is_checked = true;
        Ok(self.most_needed(cameras, self.limit(memory, cameras))?.1)
    }

    /// The same model within another limit.
    pub fn limited(self, limit_bytes: u64) -> Self {
        let place = match self.place {
            Place::Within(memory) => Place::Within(ViewMemory { limit_bytes, ..memory }),
            on => on,
        };
        Self { place, is_too_large: false, loaded: None, ..self }
    }

    fn limit(&self, memory: ViewMemory, cameras: &[Camera]) -> Limit {
        let viewing = Viewing { splats: self.splats, sh_degree: self.sh_degree, size_px: largest(cameras) };
        Limit { memory, held_bytes: (memory.held_bytes)(), viewing }
    }

    /// What the model shows from a camera.
    pub fn render(&mut self, camera: &Camera) -> Result<Rendering, ViewError> {
        loop {
            let mut loaded = match self.loaded.take() {
                Some(loaded) if loaded.room.is_for(camera) => loaded,
                of_others => {
                    drop(of_others); // before others take its place
                    self.load(camera)?
                }
            };
            match loaded.renderer.try_render_within(camera, loaded.room.pairs())? {
                Some(rendering) => {
                    self.loaded = Some(loaded);
                    return Ok(rendering);
                }
                None => self.is_too_large = true,
            }
        }
    }

    /// Loads all splats if they fit, else those for `camera` and as many of the next expected cameras as fit.
    fn load(&mut self, camera: &Camera) -> Result<Loaded, ViewError> {
        let memory = match self.place {
            Place::On(device) => {
                let splats = model::read(&self.path, &self.frame)?;
                let renderer = Renderer::on(device, self.threads, &splats)?;
                return Ok(Loaded { renderer, room: Room::All });
            }
            Place::Within(memory) => memory,
        };
        let at = self.expected.iter().position(|expected| expected == camera);
        let next = at.map_or(&[][..], |at| &self.expected[at + 1..]);
        let cameras: Vec<Camera> = [*camera].into_iter().chain(next.iter().copied()).collect();
        let limit = self.limit(memory, &cameras);
        if !self.is_too_large && limit.allows(self.splats, limit.viewing.usual_pairs()) {
            let renderer = Renderer::new(&model::read(&self.path, &self.frame)?, self.threads);
            let (size_px, pairs) = (limit.viewing.size_px, limit.pairs_max(self.splats));
            return Ok(Loaded { renderer, room: Room::Limited { size_px, pairs } });
        }
        if !self.is_checked {
            self.is_checked = true;
            let (splats, needed_bytes) = self.most_needed(&cameras, limit)?;
            if needed_bytes > memory.limit_bytes {
                return Err(limit.refusal(splats, needed_bytes));
            }
        }
        let mut batch = Batch::new(cameras, limit);
        model::read_parts(&self.path, &self.frame, READ_AT_ONCE, |part| batch.add(part, self.threads))?;
        let (cameras, renderer) = batch.end(self.threads)?;
        Ok(Loaded { renderer, room: Room::Cameras(cameras) })
    }

    /// For that one of these cameras which needs most: the number of its splats, and the bytes of the process.
    fn most_needed(&self, cameras: &[Camera], limit: Limit) -> Result<(usize, u64), SceneError> {
        let mut counts = vec![(0, 0); cameras.len()];
        model::read_parts(&self.path, &self.frame, READ_AT_ONCE, |part| {
            let mut renderer = Renderer::new(part, self.threads);
            for (camera, (splats, pairs)) in cameras.iter().zip(&mut counts) {
                let seen = renderer.seen(camera);
                (*splats, *pairs) = (*splats + seen.splats.len(), *pairs + seen.pairs);
            }
        })?;
        let needed_bytes =
            |(splats, pairs): (usize, usize)| (splats, limit.bytes_with_reading(splats, pairs));
        Ok(counts.into_iter().map(needed_bytes).max_by_key(|(_, bytes)| *bytes).unwrap_or_default())
    }
}

/// Width and height, px, of a picture that is as large as each of these.
fn largest(cameras: &[Camera]) -> [u32; 2] {
    cameras.iter().fold([0; 2], |most, camera| [0, 1].map(|axis| most[axis].max(camera.size_px[axis])))
}

/// What pictures may take.
#[derive(Clone, Copy, Debug)]
struct Limit {
    memory: ViewMemory,
    /// Bytes that the process holds beside what every process does.
    held_bytes: u64,
    /// The whole model, and the largest picture.
    viewing: Viewing,
}

impl Limit {
    /// Bytes of the process while it renders this many splats, with this many pairs of splat and tile in a picture.
    fn bytes(&self, splats: usize, pairs: usize) -> u64 {
        let viewing = Viewing { splats, ..self.viewing };
        let pixels: u64 = viewing.size_px.iter().map(|side| u64::from(*side)).product();
        let made_bytes = self.memory.made_bytes + pixels * self.memory.made_bytes_per_pixel;
        self.held_bytes + viewing.bytes(pairs) + made_bytes
    }

    /// The same, while these splats are picked from those that are read.
    fn bytes_with_reading(&self, splats: usize, pairs: usize) -> u64 {
        // The bits of each splat are in a list that grows, which has up to twice the room that it needs.
        READING_BYTES + (2 * splats * size_of::<u64>()) as u64 + self.bytes(splats, pairs)
    }

    fn refusal(&self, splats: usize, needed_bytes: u64) -> ViewError {
        let (memory_bytes, size_px) = (self.memory.limit_bytes, self.viewing.size_px);
        ViewError::TooLittleMemory { size_px, splats, needed_bytes, memory_bytes }
    }

    /// Largest number of pairs in a picture of so many splats.
    fn pairs_max(&self, splats: usize) -> usize {
        let (mut allowed, mut too_many) = (0, usize::from(u16::MAX) * usize::from(u16::MAX));
        while too_many - allowed > 1 {
            let middle = allowed.midpoint(too_many);
            *(if self.allows(splats, middle) { &mut allowed } else { &mut too_many }) = middle;
        }
        allowed
    }

    /// Tells whether [`Self::bytes`] are allowed.
    fn allows(&self, splats: usize, pairs: usize) -> bool {
        self.bytes(splats, pairs) <= self.memory.limit_bytes
    }

    /// No splats, with room for as many as may be kept: lists that grow would take twice as much. The system gives a page
    /// only when it is used.
    fn room(&self) -> Splats {
        let each = self.bytes(1000, 0).saturating_sub(self.bytes(0, 0)) / 1000;
        let splats = self.memory.limit_bytes.saturating_sub(self.held_bytes) / each.max(1);
        Splats::with_capacity(self.viewing.splats.min(splats as usize), self.viewing.sh_degree)
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
        while self.needed_bytes(self.kept.len()) > self.limit.memory.limit_bytes && self.too_many.is_none() {
            self.shrink();
        }
    }

    /// Gives up the second half of the cameras. The only one is given up too, except for the number of its splats.
    fn shrink(&mut self) {
        if self.cameras.len() == 1 {
            self.too_many = Some(self.kept.len());
            (self.kept, self.seen_by) = (Splats::with_capacity(0, self.limit.viewing.sh_degree), Vec::new());
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
        self.limit.bytes_with_reading(splats, self.most_pairs())
    }

    fn most_pairs(&self) -> usize {
        self.pairs.iter().copied().max().unwrap_or(0)
    }

    fn end(self, threads: usize) -> Result<(Vec<Camera>, Renderer), ViewError> {
        if let Some(splats) = self.too_many {
            return Err(self.limit.refusal(splats, self.needed_bytes(splats)));
        }
        let mut renderer = Renderer::new(&self.kept, threads);
        renderer.reserve_pairs(self.most_pairs());
        Ok((self.cameras, renderer))
    }
}

#[cfg(test)]
mod tests;
