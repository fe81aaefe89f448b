//! Compares merging on a graphics card with merging on the CPU. A software driver may stand in for the card.

use cosurf_engine::{DeviceError, Trust};

use super::*;

/// Largest difference in quality between the two merged models, dB.
const QUALITY_OFF_MAX: f64 = 0.1;
/// Least PSNR between the renderings of the two merged models, dB.
const AGREEMENT_MIN: f64 = 56.0;
/// Largest share of a model's splats that only one of the devices removes. Such differences are normal: rounding
/// decides between splats of equal importance.
const TIES_MAX: f64 = 0.005;

/// The best graphics card. If there is none, reports that the test is skipped and returns `None`.
fn card() -> Option<Device> {
    match DeviceChoice::Gpu(None).open() {
        Ok(device) => Some(device),
        Err(error) => {
            cosurf_tests::skips::skip("REQUIRE_GPU", error);
            None
        }
    }
}

/// Models of two flights, with errors like those of training. Without errors there would be nothing to learn: rounding
/// alone would decide what a step changes, and the devices would drift apart.
fn with_errors() -> InMemory {
    let mut models = overlapping();
    for (model, of) in models.iter_mut().zip([0.0, 0.5]) {
        let Splats { means, log_scales, sh, opacity_logits, .. } = &mut model.splats;
        let each = |i: usize, k: usize| error(of + 31.0 * i as f64 + k as f64);
        means.iter_mut().enumerate().for_each(|(i, m)| (0..3).for_each(|k| m[k] += 0.1 * each(i, k)));
        log_scales
            .iter_mut()
            .enumerate()
            .for_each(|(i, s)| (0..2).for_each(|k| s[k] += 0.3 * each(i, 3 + k)));
        opacity_logits.iter_mut().enumerate().for_each(|(i, o)| *o += each(i, 5));
        sh.iter_mut().enumerate().for_each(|(i, v)| *v += 0.4 * each(i / 3, 6 + i % 3));
    }
    InMemory(models)
}

/// A pseudo-random number in -1..1 for each value of `of`.
fn error(of: f64) -> f32 {
    let x = (12.9898 * of).sin() * 43_758.545_3;
    (2.0 * (x - x.floor()) - 1.0) as f32
}

fn by(device: DeviceChoice, locals: &InMemory) -> Merged {
    run(locals, &MergeSettings { epochs: 4, device, ..MergeSettings::default() }, 2)
}

#[test]
fn a_card_merges_like_the_cpu_and_always_to_the_same_bytes() {
    if card().is_none() {
        return;
    }
    let locals = with_errors();
    let (cpu, gpu) = (by(DeviceChoice::Cpu, &locals), by(DeviceChoice::Gpu(None), &locals));
    assert!(gpu == by(DeviceChoice::Gpu(None), &locals), "two merges on the card give the same bytes");
    assert!(cpu.summary.device == "cpu" && gpu.summary.device != "cpu", "{:?}", gpu.summary);
    assert!(cpu.summary.joined < cpu.summary.locals.iter().map(|local| local.arrived).sum());
    assert_eq!(cpu.summary.locals, gpu.summary.locals, "both remove equally many splats");
    let [by_cpu, by_gpu] = [&cpu, &gpu].map(|merged| quality(&merged.model.splats));
    let untaught = run(&locals, &MergeSettings { epochs: 0, ..MergeSettings::default() }, 2);
    let [alike, other] = [&gpu, &untaught].map(|merged| agreement(&merged.model.splats, &cpu.model.splats));
    println!("{by_cpu:.3} dB on the CPU, {by_gpu:.3} dB on the card; {alike:.1} dB between them");
    assert!((by_cpu - by_gpu).abs() < QUALITY_OFF_MAX, "{by_cpu} dB and {by_gpu} dB");
    assert!(alike > AGREEMENT_MIN, "the PSNR between the pictures is {alike:.1} dB");
    assert!(other < AGREEMENT_MIN, "the comparison notices a model that was not distilled: {other:.1} dB");
}

#[test]
fn a_card_removes_the_same_splats() {
    let Some(card) = card() else { return };
    let InMemory(models) = with_errors();
    let observers = |device: &Device, cameras_max: usize| {
        let mut observers = Observers::default();
        for Model { splats, cameras } in &models {
            let cameras = &cameras[..cameras.len().min(cameras_max)];
            observers.add(splats, cameras, Trust::FULL, device, 2).unwrap();
        }
        observers
    };
    let by_card = observers(&card, usize::MAX);
    let (by_cpu, fewer) = (observers(&Device::Cpu, usize::MAX), observers(&Device::Cpu, 3));
    for (own, Model { splats, .. }) in models.iter().enumerate() {
        let removed = |observers: &Observers| Compression::plan(splats, own, observers).removed;
        let expected = removed(&by_cpu);
        let differs = |got: &[u32]| {
            let one_sided = |a: &[u32], b: &[u32]| a.iter().filter(|i| b.binary_search(i).is_err()).count();
            one_sided(got, &expected) + one_sided(&expected, got)
        };
        let got = removed(&by_card);
        println!("{} of {} removed splats differ", differs(&got), expected.len());
        let ties_max = TIES_MAX * splats.len() as f64;
        assert!(differs(&got) as f64 <= ties_max, "{} of {} differ", differs(&got), expected.len());
        // The comparison must notice models that have lost half of their cameras.
        assert!(differs(&removed(&fewer)) as f64 > ties_max, "fewer cameras went unnoticed");
    }
}

#[test]
fn when_a_card_fails_the_cpu_starts_over_unless_the_card_was_asked_for() {
    let Some(device) = card() else { return };
    let tried = |choice, failure: fn() -> MergeError| {
        let mut tried = Vec::new();
        let computer = Computer { device: device.clone(), threads: 1 };
        let outcome = computer.run(choice, |computer| {
            tried.push(computer.device.is_gpu());
            if computer.device.is_gpu() { Err(failure()) } else { Ok(()) }
        });
        (tried, outcome.is_ok())
    };
    let lost = || MergeError::Device(DeviceError::NotBuilt);
    assert_eq!(tried(DeviceChoice::Auto, lost), (vec![true, false], true));
    assert_eq!(tried(DeviceChoice::Gpu(None), lost), (vec![true], false));
    assert_eq!(tried(DeviceChoice::Auto, || MergeError::GivenUp), (vec![true], false));
}

#[test]
fn asking_for_a_missing_card_is_an_error() {
    let settings = MergeSettings { device: DeviceChoice::Gpu(Some(99)), ..MergeSettings::default() };
    let refused = try_to_run(&neighbours(), &settings, 1, &mut |_| ControlFlow::Continue(()));
    assert!(matches!(refused, Err(MergeError::Device(_))), "{refused:?}");
}
