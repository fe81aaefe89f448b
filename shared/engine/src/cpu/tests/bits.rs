//! Trains a scene on every instruction set of this machine. All must end with the bits that are written down here, so that
//! machines with other instruction sets can be compared with this one.

use cosurf_scene::{Camera, SparsePoint, Splats};
use glam::{DVec2, DVec3};

use super::{camera, splats};
use crate::backend::{Backend, Channels, TargetRgb};
use crate::budget::Capacity;
use crate::cpu::backend::CpuBackend;
use crate::neighbours::Neighbours;
use crate::poses::PoseChoice;
use crate::schedule::Schedule;
use crate::simd::Isa;
use crate::train::{Example, PruneSettings, SurfaceSettings, TrainSettings, Trainer, TrainingViews};

const STEPS: u32 = 300;
/// The [`digest`] of the trained model. Whoever changes what a training computes writes the new one here, which the test prints.
/// `.ci/run` compares it on 64-bit ARM too.
const DIGEST: u64 = 0x82ef_ada2_aaf2_da36;

/// FNV-1a of all bits of a model.
fn digest(splats: &Splats) -> u64 {
    let Splats { means, quats, log_scales, opacity_logits, sh, .. } = splats;
    let shapes = means.iter().flatten().chain(quats.iter().flatten()).chain(log_scales.iter().flatten());
    let bytes = shapes.chain(opacity_logits).chain(sh).flat_map(|value| value.to_bits().to_le_bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

/// Trains with surface losses, two neighbouring views, refinement, pruning and exposures.
fn train(isa: Isa, threads: usize) -> Splats {
    let truth = splats(300, 0.4, -1.9, 1.0, 1, 7);
    let eyes = [[3.0, 2.0, 1.5], [3.2, 1.6, 1.6], [-3.0, 2.0, 1.5], [-3.2, 1.6, 1.6], [2.6, 2.4, 1.4]];
    let cameras: Vec<Camera> =
        eyes.iter().map(|eye| camera(DVec3::from(*eye), 40.0, DVec2::new(22.0, 14.5))).collect();
    let photographs: Vec<Vec<u8>> =
        cameras.iter().zip(8..).map(|(view, gain)| shown(isa, &truth, view, gain)).collect();
    let mut start = Splats::with_capacity(100, 1);
    (0..100).for_each(|i| start.push_from(&truth, 3 * i));
    start.sh.iter_mut().for_each(|v| *v = 0.0);
    let points: Vec<SparsePoint> = start
        .means
        .iter()
        .map(|mean| SparsePoint {
            position: DVec3::from_array(mean.map(f64::from)),
            rgb: [0; 3],
            views: (0..eyes.len() as u32).collect(),
        })
        .collect();
    let splats_max = 400;
    let capacity = Capacity {
        splats: splats_max,
        pairs: 20_000,
        ..Capacity::to_train(&start, &cameras, Channels::Geometry)
    };
    let mut backend = CpuBackend::with_isa(capacity, threads, isa);
    backend.load(&start);
    let settings = TrainSettings {
        schedule: Schedule::new(STEPS),
        extent: 4.0,
        sh_degree: 1,
        surface: Some(SurfaceSettings::default()),
        prune: Some(PruneSettings::default()),
        exposure: true,
        poses: PoseChoice::Fixed,
        observers_min: 2,
        splats_max,
        seed: 5,
    };
    let neighbours = Neighbours::find(&cameras, &points);
    let mut trainer = Trainer::new(backend, settings, TrainingViews { cameras, neighbours });
    let rgb = |view: usize| TargetRgb::Bytes(&photographs[view]);
    let mut most = 0;
    while !trainer.is_done() {
        let view = trainer.view_index(0);
        let neighbour = trainer.neighbour_index(view, 0).map(|view| (view, rgb(view)));
        trainer.step(&Example { view, rgb: rgb(view), neighbour });
        most = most.max(trainer.backend().len());
    }
    let trained = trainer.backend().splats();
    assert!(most > 110 && trained.len() < most, "splats are born and pruned: {most}, then {}", trained.len());
    trained
}

/// A photograph of splats, `gain` tenths as bright.
fn shown(isa: Isa, splats: &Splats, view: &Camera, gain: u8) -> Vec<u8> {
    let (count, channels) = (splats.len(), Channels::Color);
    let capacity =
        Capacity { splats: count, pairs: 20_000, size_px: view.size_px, channels, ..Capacity::to_render(1) };
    let mut backend = CpuBackend::with_isa(capacity, 1, isa);
    backend.load(splats);
    backend.project(view, splats.sh_degree);
    backend.bin();
    backend.rasterize(Channels::Color);
    backend
        .rendering()
        .rgb
        .iter()
        .map(|value| (25.5 * f32::from(gain) * value).clamp(0.0, 255.0) as u8)
        .collect()
}

#[test]
fn a_training_has_the_same_bits_on_every_processor() {
    for (isa, threads) in Isa::available().into_iter().zip([3, 1, 2]) {
        let digest = digest(&train(isa, threads));
        assert_eq!(digest, DIGEST, "{} with {threads} threads: {digest:#x}", isa.name());
    }
}
