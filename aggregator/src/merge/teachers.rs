//! The teachers of a distillation: local models whose splats do not change. Each teacher renders those parts of its
//! cameras' pictures that show the tile, and finds the pixels that can be trusted. Only one teacher is loaded at a time,
//! and of it only what the parts show.

use std::rc::Rc;

use cosurf_engine::distill::TRUSTED_ALPHA_MIN;
use cosurf_engine::{Renderer, Rendering, RenderingCache};
use cosurf_scene::Camera;
use glam::DVec2;

use super::book::Book;
use super::computer::Computer;
use super::crop::Part;
use super::error::MergeError;
use super::memory::CACHE_BYTES;
use super::task::{Task, Taught, Teaching};
use crate::scratch::Scratch;

/// A pixel whose surface a neighbouring camera sees is trusted only if its reprojection through that camera
/// returns to within this distance of the pixel, px.
const RETURN_PX: f64 = 1.0;

/// Writes down what the teachers of a tile show.
pub(super) fn write_book(task: &Task, scratch: &Scratch, computer: &Computer) -> Result<Book, MergeError> {
    let count = task.teachers().iter().map(|teaching| teaching.lessons.len()).sum();
    let mut book = Book::new(scratch, count)?;
    for teaching in task.teachers() {
        let mut teacher = Teacher::load(task, teaching, computer)?;
        for lesson in &teaching.lessons {
            let shown = teacher.show(lesson.view)?;
            let trust = teacher.trust(lesson, &shown)?;
            book.write(lesson.rank, &teaching.views[lesson.view], &shown, &trust)?;
        }
    }
    Ok(book)
}

/// A local model, as far as a tile needs it.
struct Teacher<'a> {
    views: &'a [Part],
    renderer: Renderer,
    cache: RenderingCache<usize>,
}

impl<'a> Teacher<'a> {
    fn load(task: &Task, teaching: &'a Teaching, computer: &Computer) -> Result<Self, MergeError> {
        let renderer = Renderer::by(&computer.device, computer.threads, &task.teacher(teaching)?)?;
        Ok(Self { views: &teaching.views, renderer, cache: RenderingCache::new(CACHE_BYTES) })
    }

    fn show(&mut self, view: usize) -> Result<Rc<Rendering>, MergeError> {
        if let Some(kept) = self.cache.get(&view) {
            return Ok(kept);
        }
        let shown = self.renderer.try_render_up_to(&self.views[view].camera, self.views[view].far)?;
        Ok(self.cache.keep(view, shown))
    }

    /// 1 for each trusted pixel of a view, else 0. Opaque pixels are trusted if a neighbouring camera of the same
    /// teacher either confirms their surface or cannot see it. Without a neighbouring camera, all opaque pixels are.
    fn trust(&mut self, lesson: &Taught, here: &Rendering) -> Result<Vec<f32>, MergeError> {
        let there = match lesson.neighbour {
            Some(other) => Some((self.views[other].camera, self.show(other)?)),
            None => None,
        };
        let camera = &self.views[lesson.view].camera;
        let width = here.size_px[0] as usize;
        let is_believed = |i: usize| {
            let p_px = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            here.alpha[i] > TRUSTED_ALPHA_MIN
                && there
                    .as_ref()
                    .is_none_or(|(other, seen)| returns(camera, p_px, f64::from(here.depth[i]), other, seen))
        };
        Ok((0..here.alpha.len()).map(|i| if is_believed(i) { 1.0 } else { 0.0 }).collect())
    }
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
