//! What a fusion needs of a renderer.

use cosurf_engine::Rendering;
use cosurf_scene::Camera;

use super::error::MeshError;

/// Renders the surface that is fused.
pub trait Painter {
    /// Tells which cameras will be rendered next, in this order.
    fn expect(&mut self, cameras: Vec<Camera>);

    /// What the surface looks like from a camera: colour, alpha and depth.
    fn render(&mut self, camera: &Camera) -> Result<Rendering, MeshError>;
}

impl<F: FnMut(&Camera) -> Rendering> Painter for F {
    fn expect(&mut self, _: Vec<Camera>) {}

    fn render(&mut self, camera: &Camera) -> Result<Rendering, MeshError> {
        Ok(self(camera))
    }
}
