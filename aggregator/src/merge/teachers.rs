//! The teachers of a distillation: local models whose splats do not change. Each teacher renders the views of
//! its own cameras and finds the pixels that can be trusted. Only as many teachers as fit into the memory are
//! loaded at once; the others stay on the disk. The rest of the memory caches renderings, for later epochs
//! and for comparison with neighbouring views.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use cosurf_engine::distill::TRUSTED_ALPHA_MIN;
use cosurf_engine::{Neighbours, Renderer, Rendering, RenderingCache};
use cosurf_link::Model;
use cosurf_scene::{Camera, SparsePoint, Splats};
use glam::{DVec2, DVec3};

use super::computer::Computer;
use super::error::MergeError;
use super::locals::{Locals, Surveyed};

/// A pixel whose surface a neighbouring camera sees is trusted only if its reprojection through that camera
/// returns to within this distance of the pixel, px.
const RETURN_PX: f64 = 1.0;
/// Limit on the splats of a teacher from which the median depth of its views is estimated.
const PROBES: usize = 2000;

/// One camera of one local model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ViewKey {
    pub(crate) local: usize,
    pub(crate) camera: usize,
}

/// A teacher's rendering of one view.
pub(crate) struct Taught {
    pub(crate) camera: Camera,
    pub(crate) shown: Rc<Rendering>,
    /// `[height, width]`: 1 where the rendered surface is trusted, else 0.
    pub(crate) trust: Vec<f32>,
}

/// All teachers.
pub(crate) struct Teachers<'a> {
    locals: &'a dyn Locals,
    /// The cameras of each local model.
    cameras: &'a [Vec<Camera>],
    computer: &'a Computer,
    /// Largest number of teachers that are loaded at once.
    shelf_max: usize,
    /// The loaded teachers with their indices, the most recently used at the back.
    shelf: VecDeque<(usize, Teacher)>,
    /// Trusted pixels of the views that have been taught so far.
    trusts: BTreeMap<ViewKey, Bits>,
    cache: RenderingCache<ViewKey>,
}

struct Teacher {
    renderer: Renderer,
    neighbours: Neighbours,
}

impl<'a> Teachers<'a> {
    /// Makes the surveyed models teachers. Each takes up to `teacher_bytes`. As many are loaded at once as
    /// fit into `memory_bytes`, but at least one.
    pub(super) fn new(
        surveyed: &'a Surveyed,
        computer: &'a Computer,
        teacher_bytes: u64,
        memory_bytes: u64,
    ) -> Self {
        let count = surveyed.cameras.len().max(1) as u64;
        let shelf_max = (memory_bytes / teacher_bytes.max(1)).clamp(1, count);
        Self {
            locals: surveyed.locals,
            cameras: &surveyed.cameras,
            computer,
            shelf_max: shelf_max as usize,
            shelf: VecDeque::new(),
            trusts: BTreeMap::new(),
            cache: RenderingCache::new(memory_bytes.saturating_sub(shelf_max * teacher_bytes)),
        }
    }

    /// Largest number of teachers that are loaded at once.
    pub(super) fn shelf_max(&self) -> usize {
        self.shelf_max
    }

    /// Renders a view with its teacher, and finds the trusted pixels.
    pub(crate) fn teach(&mut self, view: ViewKey) -> Result<Taught, MergeError> {
        let shown = self.show(view)?;
        if !self.trusts.contains_key(&view) {
            let trust = self.trust(view, &shown)?;
            self.trusts.insert(view, trust);
        }
        let trust = self.trusts[&view].weights().take(shown.alpha.len()).collect();
        Ok(Taught { camera: self.camera(view), shown, trust })
    }

    fn camera(&self, view: ViewKey) -> Camera {
        self.cameras[view.local][view.camera]
    }

    fn show(&mut self, view: ViewKey) -> Result<Rc<Rendering>, MergeError> {
        if let Some(kept) = self.cache.get(&view) {
            return Ok(kept);
        }
        let camera = self.camera(view);
        let shown = self.fetch(view.local)?.renderer.try_render(&camera)?;
        Ok(self.cache.keep(view, shown))
    }

    /// The trusted pixels of a view: opaque pixels whose surface a neighbouring camera of the same teacher
    /// either confirms or cannot see. Without a neighbouring camera, all opaque pixels.
    fn trust(&mut self, view: ViewKey, here: &Rendering) -> Result<Bits, MergeError> {
        let neighbour = self.fetch(view.local)?.neighbours.nearest(view.camera);
        let other = neighbour.map(|camera| ViewKey { camera, ..view });
        let there = match other {
            Some(other) => Some((self.camera(other), self.show(other)?)),
            None => None,
        };
        let camera = self.camera(view);
        let width = here.size_px[0] as usize;
        let believed = |i: usize| {
            let p_px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            here.alpha[i] > TRUSTED_ALPHA_MIN
                && there
                    .as_ref()
                    .is_none_or(|(other, seen)| returns(&camera, p_px, f64::from(here.depth[i]), other, seen))
        };
        Ok(Bits::of(here.alpha.len(), believed))
    }

    /// Returns a teacher, and loads it first if necessary. The teacher moves to the back of the shelf. If the
    /// shelf is full, the teacher at the front is dropped, the least recently used one.
    fn fetch(&mut self, local: usize) -> Result<&mut Teacher, MergeError> {
        if let Some(place) = self.shelf.iter().position(|(held, _)| *held == local) {
            let held = self.shelf.remove(place).expect("it has just been found");
            self.shelf.push_back(held);
        } else {
            while self.shelf.len() >= self.shelf_max {
                self.shelf.pop_front();
            }
            let Model { splats, cameras } = self.locals.load(local)?;
            let neighbours = Neighbours::find(&cameras, &probes(&splats));
            let renderer = Renderer::by(&self.computer.device, self.computer.threads, &splats)?;
            self.shelf.push_back((local, Teacher { renderer, neighbours }));
        }
        let (_, teacher) = self.shelf.back_mut().expect("just put there");
        Ok(teacher)
    }
}

/// A mask of one bit per pixel. It is compact because the masks of all views stay in memory, even while their
/// teachers are not loaded.
struct Bits(Vec<u64>);

impl Bits {
    fn of(len: usize, is_set: impl Fn(usize) -> bool) -> Self {
        let word = |w: usize| {
            let inside = (64 * w..len.min(64 * w + 64)).filter(|i| is_set(*i));
            inside.fold(0, |word, i| word | 1 << (i % 64))
        };
        Self((0..len.div_ceil(64)).map(word).collect())
    }

    /// 1 for every set bit and 0 for every other bit, including the unused bits at the end of the last word.
    fn weights(&self) -> impl Iterator<Item = f32> {
        self.0.iter().flat_map(|word| (0..64).map(move |bit| (word >> bit & 1) as f32))
    }
}

/// Positions of at most [`PROBES`] splats, evenly chosen, as sparse points. The points do not list the views
/// that see them.
fn probes(splats: &Splats) -> Vec<SparsePoint> {
    let step = splats.len().div_ceil(PROBES).max(1);
    let point = |mean: &[f32; 3]| SparsePoint {
        position: DVec3::from_array(mean.map(f64::from)),
        rgb: [0; 3],
        views: Vec::new(),
    };
    splats.means.iter().step_by(step).map(point).collect()
}

/// Whether the camera `other` confirms the surface at the pixel `p_px`, or cannot see it. To confirm it, the
/// surface point is projected into `other`, moved to the depth in the rendering `seen` of that camera, and
/// projected back. It must then lie within [`RETURN_PX`] of the pixel. False if either depth shows no surface.
fn returns(camera: &Camera, p_px: DVec2, depth: f64, other: &Camera, seen: &Rendering) -> bool {
    if depth <= 0.0 {
        return false;
    }
    let Some(q_px) = other.project(camera.unproject(p_px, depth)).filter(|q_px| other.contains(*q_px)) else {
        return true; // the other camera does not see the surface
    };
    let [x, y] = [q_px.x as usize, q_px.y as usize];
    let shown = f64::from(seen.depth[y * seen.size_px[0] as usize + x]);
    shown > 0.0
        && camera
            .project(other.unproject(q_px, shown))
            .is_some_and(|back_px| back_px.distance(p_px) < RETURN_PX)
}
