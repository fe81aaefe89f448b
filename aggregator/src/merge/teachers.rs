//! The teachers of a distillation: local models whose splats do not change. Each teacher renders those parts of its
//! cameras' pictures that show the tile, and finds the pixels that can be trusted. Only one teacher is loaded at a time,
//! and of it only what the parts show.

use std::collections::BTreeSet;
use std::rc::Rc;

use cosurf_engine::distill::TRUSTED_ALPHA_MIN;
use cosurf_engine::{Renderer, Rendering, RenderingCache};
use cosurf_scene::{Camera, Frustum, Splats};
use glam::DVec2;

use super::book::Book;
use super::computer::Computer;
use super::error::MergeError;
use super::memory::CACHE_BYTES;
use super::plan::{Plan, ViewKey, touches};
use super::site::Site;

/// A pixel whose surface a neighbouring camera sees is trusted only if its reprojection through that camera
/// returns to within this distance of the pixel, px.
const RETURN_PX: f64 = 1.0;

/// Writes down what the teachers of a tile show.
pub(super) fn write_book(site: &Site, plan: &Plan, computer: &Computer) -> Result<Book, MergeError> {
    let mut book = Book::new(&site.scratch, plan.lessons.len())?;
    let locals: BTreeSet<usize> = plan.lessons.iter().map(|view| view.local).collect();
    for local in locals {
        let lessons = plan.lessons.iter().enumerate().filter(|(_, view)| view.local == local);
        let mut teacher = Teacher::load(site, plan, local, computer)?;
        for (index, view) in lessons {
            let shown = teacher.show(*view)?;
            let trust = teacher.trust(*view, &shown)?;
            book.write(index, &plan.crops[view], &shown, &trust)?;
        }
    }
    Ok(book)
}

/// A local model, as far as a tile needs it.
struct Teacher<'a> {
    site: &'a Site,
    plan: &'a Plan,
    renderer: Renderer,
    cache: RenderingCache<ViewKey>,
}

impl<'a> Teacher<'a> {
    fn load(site: &'a Site, plan: &'a Plan, local: usize, computer: &Computer) -> Result<Self, MergeError> {
        let own = plan.lessons.iter().filter(|view| view.local == local);
        let neighbours = own.clone().filter_map(|view| neighbour(site, *view));
        let views: BTreeSet<ViewKey> = own.copied().chain(neighbours).collect();
        let frusta: Vec<Frustum> =
            views.iter().filter_map(|view| plan.crops.get(view)).map(Frustum::new).collect();
        let mut splats = Splats::with_capacity(0, site.models.sh_degree());
        let is_seen = |at, radius| frusta.iter().any(|frustum| frustum.touches(at, radius));
        site.models.read(
            site.pages[local].clone(),
            |bounds| touches(&frusta, bounds),
            is_seen,
            &mut splats,
        )?;
        let renderer = Renderer::by(&computer.device, computer.threads, &splats)?;
        Ok(Self { site, plan, renderer, cache: RenderingCache::new(CACHE_BYTES) })
    }

    fn show(&mut self, view: ViewKey) -> Result<Rc<Rendering>, MergeError> {
        if let Some(kept) = self.cache.get(&view) {
            return Ok(kept);
        }
        let shown = self.renderer.try_render(&self.plan.crops[&view])?;
        Ok(self.cache.keep(view, shown))
    }

    /// 1 for each trusted pixel of a view, else 0. Opaque pixels are trusted if a neighbouring camera of the same
    /// teacher either confirms their surface or cannot see it. Without a neighbouring camera, all opaque pixels are.
    fn trust(&mut self, view: ViewKey, here: &Rendering) -> Result<Vec<f32>, MergeError> {
        let other = neighbour(self.site, view).filter(|other| self.plan.crops.contains_key(other));
        let there = match other {
            Some(other) => Some((self.plan.crops[&other], self.show(other)?)),
            None => None,
        };
        let camera = &self.plan.crops[&view];
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

fn neighbour(site: &Site, view: ViewKey) -> Option<ViewKey> {
    site.neighbours[view.local].nearest(view.camera).map(|camera| ViewKey { camera, ..view })
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
