//! Tests with a card that can bind only small buffers. The budget must plan the largest model that such a card can
//! bind, and must refuse larger pictures.

use glam::DVec3;

use super::adapter::gpu;
use super::compare::on_cpu;
use super::forward::centered;
use super::gradients::step;
use crate::backend::{Backend, Channels};
use crate::budget::{Budget, BudgetError, Capacity, Wish};
use crate::cpu::tests::splats;
use crate::gpu::backend::GpuBackend;
use crate::gpu::context::{Gpu, GpuChoice, GpuError};

/// Size of the largest buffer that the test card can bind, bytes.
const BINDING_BYTES: u64 = 1 << 20;

fn small() -> Option<Gpu> {
    gpu()?;
    Some(Gpu::open_bound(GpuChoice::Any, BINDING_BYTES).expect("every adapter can do so little"))
}

fn wish(size_px: [u32; 2], sh_degree: u32, splats: usize) -> Wish {
    Wish {
        memory_bytes: 8 << 30,
        size_px,
        sh_degree,
        binding_bytes_max: Some(BINDING_BYTES),
        channels: Channels::Geometry,
        splats,
        cache_bytes_most: 0,
        cache_bytes_least: 0,
        loading_bytes: 0,
    }
}

fn too_large(backend: Result<GpuBackend, GpuError>) -> bool {
    matches!(backend, Err(GpuError::TooLarge { bytes_max: BINDING_BYTES, .. }))
}

#[test]
fn models_are_as_large_as_the_card_can_bind() {
    let Some(gpu) = small() else { return };
    for sh_degree in [0, 3] {
        let budget = Budget::plan(&wish([64, 48], sh_degree, 100_000)).expect("room");
        assert!((2000..10_000).contains(&budget.capacity.splats), "{:?}", budget.capacity);
        let [line] = &budget.given_up[..] else { panic!("{:?}", budget.given_up) };
        assert!(line.contains("instead of 100000") && line.contains("binds no more"), "{line}");
        let capacity = budget.capacity;
        let mut backend = GpuBackend::new(&gpu, capacity).expect("it fits");
        let splats = splats(budget.capacity.splats, 0.6, -3.0, 0.0, sh_degree, 4);
        backend.load(&splats);
        let camera = centered(DVec3::new(3.0, 2.0, 1.5), 60.0, [64, 48]);
        let (losses, _) = step(&mut backend, &camera, sh_degree, Channels::Geometry);
        assert_eq!(backend.lost(), None, "nothing that was bound was too large");
        let (expected, _) =
            step(&mut on_cpu(&splats, camera.size_px), &camera, sh_degree, Channels::Geometry);
        assert!((losses.color.total - expected.color.total).abs() < 1e-4, "{losses:?} {expected:?}");
        let more = 4 * (capacity.splats + 1);
        assert!(too_large(GpuBackend::new(&gpu, Capacity { pairs: more, ..capacity })));
    }
    // A model that fits is not reduced.
    let budget = Budget::plan(&wish([64, 48], 3, 2000)).expect("room");
    assert_eq!((budget.capacity.splats, budget.given_up), (2000, Vec::new()));
}

#[test]
fn pictures_that_the_card_cannot_bind_are_refused() {
    let Some(gpu) = small() else { return };
    let (most, more) = ([176, 160], [176, 176]);
    let budget = Budget::plan(&wish(most, 0, 2000)).expect("room");
    GpuBackend::new(&gpu, budget.capacity).expect("it fits");
    assert!(too_large(GpuBackend::new(&gpu, Capacity { size_px: more, ..budget.capacity })));
    let refused = Budget::plan(&wish(more, 0, 2000)).expect_err("too large");
    assert!(matches!(refused, BudgetError::PictureTooLarge { size_px, .. } if size_px == more));
    assert!(refused.to_string().contains("176 × 176 px"), "{refused}");
}
