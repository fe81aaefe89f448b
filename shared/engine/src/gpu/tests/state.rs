//! Compares edits and checkpoints of both backends, and checks that the loss of a device is reported.

use glam::DVec3;

use super::adapter::gpu;
use super::compare::{capacity, on_cpu, on_gpu};
use super::forward::centered;
use super::gradients::step;
use crate::backend::{Backend, Birth, Channels, Edit};
use crate::cpu::tests::splats;
use crate::gpu::{GpuBackend, GpuError};
use crate::{Capacity, Device, DeviceError, Renderer, Schedule};

#[test]
fn edits_give_the_same_splats_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(40, 0.4, -1.6, 0.0, 2, 3);
    let birth = |parent: u32| Birth {
        parent,
        mean: [parent as f32, 1.0, 2.0],
        log_scale: [-1.0, -2.0, -3.0],
        opacity_logit: 0.5,
    };
    let edits = [
        Edit { births: vec![birth(3), birth(39), birth(7)], deaths: vec![7, 20] },
        Edit { births: vec![birth(0)], deaths: vec![0, 5, 6, 36, 38, 39] },
        Edit { births: Vec::new(), deaths: (0..40).collect() },
        Edit { births: (0..60).map(|i| birth(i % 40)).collect(), deaths: Vec::new() },
    ];
    // With room for one pair, there is room to move a few rows at a time.
    for (edit, pairs) in edits.iter().flat_map(|edit| [60_000, 1].map(|pairs| (edit, pairs))) {
        let room = Capacity { pairs, ..capacity(&splats, [8, 8]) };
        let (mut gpu, mut cpu) = (GpuBackend::new(&gpu, room).expect("room"), on_cpu(&splats, [8, 8]));
        gpu.load(&splats);
        gpu.edit(edit);
        cpu.edit(edit);
        gpu.cap_opacity(0.4);
        cpu.cap_opacity(0.4);
        assert_eq!(gpu.splats(), cpu.splats(), "{edit:?}, {pairs} pairs");
    }
}

/// All numbers that a checkpoint of the backend holds.
fn kept(backend: &impl Backend) -> Vec<f32> {
    let mut kept = Vec::new();
    let exported: Result<(), ()> = backend.export(|numbers| {
        kept.extend_from_slice(numbers);
        Ok(())
    });
    assert_eq!(exported, Ok(()));
    kept
}

fn restore(backend: &mut impl Backend, len: usize, mut kept: &[f32]) {
    let imported: Result<(), ()> = backend.import(len, |numbers| {
        let (now, later) = kept.split_at(numbers.len());
        numbers.copy_from_slice(now);
        kept = later;
        Ok(())
    });
    assert_eq!((imported, kept.len()), (Ok(()), 0));
}

#[test]
fn checkpoints_move_between_devices() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(1043, 0.4, -1.6, 0.0, 2, 3);
    let camera = centered(DVec3::new(3.0, 2.0, 1.5), 40.0, [44, 29]);
    let mut cpu = on_cpu(&splats, camera.size_px);
    let rates = Schedule::new(100).rates(7, 4.0);
    for _ in 0..3 {
        step(&mut cpu, &camera, 2, Channels::Color);
        cpu.adam(&rates);
    }
    let by_cpu = kept(&cpu);
    let mut moved = GpuBackend::new(&gpu, capacity(&splats, camera.size_px)).expect("room");
    restore(&mut moved, splats.len(), &by_cpu);
    assert_eq!(kept(&moved), by_cpu, "from the CPU to the GPU");
    assert_eq!(moved.splats(), cpu.splats());
    let mut back = on_cpu(&splats, camera.size_px);
    restore(&mut back, splats.len(), &kept(&moved));
    step(&mut back, &camera, 2, Channels::Color);
    back.adam(&rates);
    step(&mut cpu, &camera, 2, Channels::Color);
    cpu.adam(&rates);
    assert_eq!(kept(&back), kept(&cpu), "and back: the resumed training has the same bits");
}

#[test]
fn a_lost_device_is_reported_and_nothing_panics() {
    let Some(gpu) = gpu() else { return };
    let splats = splats(60, 0.4, -1.5, 0.0, 1, 2);
    let camera = centered(DVec3::new(3.0, 2.0, 1.5), 40.0, [44, 29]);
    let mut backend = on_gpu(&gpu, &splats, camera.size_px);
    step(&mut backend, &camera, 1, Channels::Geometry);
    let mut renderer = Renderer::by(&Device::Gpu(gpu.clone()), 1, &splats).expect("room");
    renderer.try_render(&camera).expect("it is there");
    assert_eq!(backend.lost(), None);
    gpu.device.destroy();
    backend.project(&camera, 1);
    backend.bin();
    backend.rasterize(Channels::Geometry);
    backend.keep_neighbour();
    backend.take_shapes();
    let reason = backend.lost().expect("the device is lost");
    assert!(reason.contains("was lost"), "{reason}");
    let device = Device::Gpu(gpu);
    let is_loss = |error: DeviceError| matches!(error, DeviceError::Gpu(GpuError::Lost(_)));
    assert!(device.check().is_err_and(is_loss));
    assert!(renderer.try_render(&camera).is_err_and(is_loss));
    let importance = super::importance(&splats, &[camera], capacity(&splats, camera.size_px), &device);
    assert!(importance.is_err(), "a lost device gives no importance");
}
