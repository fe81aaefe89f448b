//! Compares the scores of splats on both backends.

use cosurf_scene::Camera;

use super::adapter::gpu;
use super::compare::{TIES_MAX, capacity, on_cpu, on_gpu};
use super::forward::centered;
use super::gradients::{cases, step};
use crate::backend::{Backend, Channels, Scores};
use crate::{Device, prune};

#[test]
fn the_division_of_work_in_a_tile_does_not_change_a_bit() {
    let Some(gpu) = gpu() else { return };
    let (name, splats, camera) = cases().remove(4);
    let both = [gpu.clone(), gpu.disguised()].map(|gpu| {
        let mut backend = on_gpu(&gpu.without_subgroups(), &splats, camera.size_px);
        let (_, gradients) = step(&mut backend, &camera, splats.sh_degree, Channels::Geometry);
        backend.clear_scores();
        backend.score();
        (gradients, backend.scores())
    });
    assert!(both[0].1.hits.iter().sum::<f32>() > 0.0, "{name}: something is hit");
    assert_eq!(both[0], both[1], "{name}");
}

/// Largest allowed error of a sum of squared weights, relative to the larger of the sum and 0.001.
const TOLERANCE: f32 = 1e-3;

/// Scores of the splats over two renderings by the same camera.
fn scored(backend: &mut impl Backend, camera: &Camera) -> Scores {
    backend.clear_scores();
    for _ in 0..2 {
        backend.project(camera, 0);
        backend.bin();
        backend.rasterize(Channels::Color);
        backend.score();
    }
    backend.scores()
}

/// Number of splats whose scores differ.
fn off(got: &Scores, expected: &Scores) -> usize {
    let is_off = |i: &usize| {
        let error = (got.squared_weights[*i] - expected.squared_weights[*i]).abs();
        error > TOLERANCE * expected.squared_weights[*i].max(1e-3)
            || got.hits[*i] != expected.hits[*i]
            || got.observers[*i] != expected.observers[*i]
    };
    (0..expected.hits.len()).filter(is_off).count()
}

#[test]
fn scores_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    for (name, splats, camera) in cases() {
        let got = scored(&mut on_gpu(&gpu, &splats, camera.size_px), &camera);
        let expected = scored(&mut on_cpu(&splats, camera.size_px), &camera);
        let (off_max, wrong) = (TIES_MAX * splats.len() as f64, off(&got, &expected));
        println!("{name}: {wrong} of {} scores are off", splats.len());
        assert!(wrong as f64 <= off_max, "{name}: {wrong} of {}", splats.len());
        if splats.is_empty() {
            continue;
        }
        assert!(expected.hits.iter().sum::<f32>() > 0.0, "{name}: something is hit");
        // The comparison must also notice each of the three numbers of a score, if it is wrong for every 20th of the
        // splats that were hit.
        let hit: Vec<usize> = (0..splats.len()).filter(|i| expected.hits[*i] > 0.0).step_by(20).collect();
        let bent: [fn(&mut Scores, usize); 3] = [
            |scores, i| scores.squared_weights[i] = 1.01 * scores.squared_weights[i] + 1e-5,
            |scores, i| scores.hits[i] += 1.0,
            |scores, i| scores.observers[i] += 1.0,
        ];
        for bend in bent {
            let mut bent = got.clone();
            hit.iter().for_each(|&i| bend(&mut bent, i));
            assert!(off(&bent, &expected) as f64 > off_max, "{name}: wrong scores went unnoticed");
        }
    }
}

#[test]
fn both_devices_find_the_same_least_important_splats() {
    let Some(gpu) = gpu() else { return };
    let device = Device::Gpu(gpu);
    for (name, splats, camera) in cases().into_iter().filter(|(_, splats, _)| splats.len() >= 500) {
        let other = centered(-camera.cam_from_world.center(), 100.0, camera.size_px);
        let room = capacity(&splats, camera.size_px);
        let lowest = |cameras: &[Camera], device: &Device| {
            let importance = super::importance(&splats, cameras, room, device).expect("room");
            prune::lowest(&importance, 0.4)
        };
        let expected = lowest(&[camera, other], &Device::Cpu);
        let differs = |got: &[u32]| got.iter().filter(|i| expected.binary_search(i).is_err()).count();
        let differing = differs(&lowest(&[camera, other], &device));
        println!("{name}: {differing} of {} that go are others", expected.len());
        let ties_max = TIES_MAX * splats.len() as f64;
        assert!(differing as f64 <= ties_max, "{name}: {differing} of {}", expected.len());
        // The comparison must also notice a missing camera.
        assert!(differs(&lowest(&[other], &device)) as f64 > ties_max, "{name}: went unnoticed");
    }
}
