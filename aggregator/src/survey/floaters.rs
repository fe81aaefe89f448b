//! Which vertices of the mesh float: more views look through them, at a surface behind, than show them.
//!
//! What it knows nothing about: files, pixels of maps.

use cosurf_scene::Mesh;
use rayon::prelude::*;

use super::error::SurveyError;
use super::scene::Scene;
use super::views::{Picture, ViewOrder, Views};

/// Sets `is_seen` of the vertices that float to false. At the edge of a roof, a view often looks past a vertex; so it must be
/// more than half of the views. `on_view` gets the number of views that are done, and of all.
pub(super) fn leave_out_floaters(
    scene: &Scene,
    mesh: &Mesh,
    is_seen: &mut [bool],
    order: &ViewOrder,
    mut on_view: impl FnMut(usize, usize),
) -> Result<(), SurveyError> {
    let (frame, mut views) = (&scene.frame, vec![Views::default(); is_seen.len()]);
    scene.render_each(order.memory_bytes, order.threads, |[done, of], camera, rendering| {
        let picture = Picture::new(camera, rendering, frame.unit(), order.voxel_m);
        let vertices = views.par_iter_mut().zip(&mesh.positions).zip(&*is_seen);
        vertices.with_min_len(4096).filter(|(_, is_seen)| **is_seen).for_each(|((views, at), _)| {
            picture.add_point(views, frame.world_from_local(at.map(f64::from).into()));
        });
        on_view(done, of);
        Ok(())
    })?;
    for (is_seen, views) in is_seen.iter_mut().zip(&views) {
        *is_seen &= views.through <= views.count;
    }
    Ok(())
}
