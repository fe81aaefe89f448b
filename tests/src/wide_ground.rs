//! Models of flat ground, of which many make a large site.

use std::path::Path;

use cosurf_link::{ModelStore, Offer};
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, Pose, Splats};
use cosurf_wire::{DeviceId, FrameId, ModelId, ModelKind};
use glam::{DVec2, DVec3};

/// Splats of a model along each axis, and their distance, metres.
const ACROSS: usize = 320;
const SPACING_M: f32 = 0.3;

/// Puts the models `other-0`, `other-1`, … into the folder of a service, each of 96 × 96 m with its corner in the south-west
/// here, metres, in the frame `site`. Their harmonics have this degree, 1 to 3. Returns the number of splats.
pub fn write_models(out: &Path, corners: &[[f32; 2]], sh_degree: u32) -> usize {
    let (store, _) = ModelStore::open(&out.join("models")).unwrap();
    let mut count = 0;
    for (i, corner) in corners.iter().enumerate() {
        let (splats, cameras) = ground(*corner, sh_degree);
        let device = DeviceId::new(&format!("other-{i}")).unwrap();
        let offer = Offer::new(device, ModelId(1), ModelKind::Local, 16, &splats, &cameras);
        let Offer { mut header, body } = offer.unwrap();
        header.frame = FrameId::new("site").unwrap();
        store.put(&header, &body).unwrap();
        count += splats.len();
    }
    count
}

/// Flat opaque ground, and cameras above it.
fn ground([west, south]: [f32; 2], sh_degree: u32) -> (Splats, Vec<Camera>) {
    let mut splats = Splats::with_capacity(ACROSS * ACROSS, sh_degree);
    for i in 0..ACROSS * ACROSS {
        let (x, y) = (west + SPACING_M * (i % ACROSS) as f32, south + SPACING_M * (i / ACROSS) as f32);
        let shade = 0.5 + 0.3 * (0.7 * x).sin() * (0.5 * y).cos();
        let mut sh = vec![0.01; 3 * (sh_degree as usize + 1).pow(2)];
        for (of, value) in sh.iter_mut().zip([shade, 0.6 * shade, 1.0 - shade]) {
            *of = (value - 0.5) / SH_C0;
        }
        splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.7, -1.7, -5.0], 4.0, &sh);
    }
    let above = |x: f64, y: f64| Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 20.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(90.0),
        center_px: DVec2::new(72.0, 54.0),
        size_px: [144, 108],
    };
    let places = (0..16).map(|i| {
        let [x, y] = [i % 4, i / 4].map(|step| 12.0 + 24.0 * f64::from(step));
        above(f64::from(west) + x, f64::from(south) + y)
    });
    (splats, places.collect())
}
