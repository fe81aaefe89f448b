//! A model that contradicts the others is kept out and reported, until its device sends a model that fits.

use super::*;
use crate::gate::tests::{elsewhere, flight, flights};
use crate::testing::QUICK;
use glam::DVec3;

const NAMES: [&str; 4] = ["agent-1", "agent-2", "agent-3", "agent-4"];

/// Lets drones send the models of `sent`: device, number and model. Once all of `waited_for` are merged or kept out,
/// and exactly the `outsiders` are kept out, returns the bytes of the global model's file.
fn fly(folder: &Path, waited_for: &[&str], sent: &[(&str, u64, &Model)], outsiders: &[&str]) -> Vec<u8> {
    fly_with(QUICK, folder, waited_for, sent, outsiders)
}

fn fly_with(
    merge: MergeSettings,
    folder: &Path,
    waited_for: &[&str],
    sent: &[(&str, u64, &Model)],
    outsiders: &[&str],
) -> Vec<u8> {
    let network = MemoryNetwork::new(sent.len() as u64, BAD_WEATHER);
    let mut ground = open_with(&network, folder, fleet(waited_for), merge);
    let drones = sent.iter().map(|(name, number, model)| Drone::new(&network, name, *number, model));
    let is_settled = |event: &ServiceEvent| match event {
        ServiceEvent::Merged { models, kept_out, .. } => {
            models + kept_out.len() == waited_for.len()
                && kept_out.iter().map(|kept_out| kept_out.device.as_str()).eq(outsiders.iter().copied())
        }
        _ => false,
    };
    let events = simulate(&network, &mut ground, &mut drones.collect::<Vec<_>>(), |events, _| {
        events.iter().any(is_settled)
    });
    let record = Merging::read(folder).unwrap();
    assert_eq!(record.kept_out.len(), outsiders.len(), "{events:?}");
    fs::read(global_ply(folder)).unwrap()
}

#[test]
fn a_poisoned_model_is_kept_out_until_its_device_sends_a_sound_one() {
    let right = flights();
    let wrong = elsewhere(right[1].clone(), 1.0, 0.0, DVec3::Z);
    let all: Vec<_> = NAMES.iter().zip(&right).map(|(name, model)| (*name, 1, model)).collect();
    let without: Vec<_> = all.iter().copied().filter(|(name, ..)| *name != "agent-2").collect();
    let mut poisoned = all.clone();
    poisoned[1].2 = &wrong;
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let [site, three, four] = folders.each_ref().map(|folder| folder.path());
    let others: Vec<&str> = without.iter().map(|(name, ..)| *name).collect();
    let clean = fly(three, &others, &without, &[]);
    assert!(fly(site, &NAMES, &poisoned, &["agent-2"]) == clean, "the poisoned model left a trace");
    let complete = fly(four, &NAMES, &all, &[]);
    assert!(complete != clean);
    assert!(
        fly(site, &NAMES, &[("agent-2", 2, &right[1])], &[]) == complete,
        "the device's next model counts"
    );
}

#[test]
fn attack_01_absurd_pictures_do_not_stop_the_merge_of_the_others() {
    let right = flights();
    let mut absurd = flight(60.0);
    for camera in &mut absurd.cameras {
        *camera = camera.resized([16_384, 16_384]);
    }
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let honest: Vec<_> = NAMES[..3].iter().zip(&right).map(|(name, model)| (*name, 1, model)).collect();
    let clean = fly(folders[0].path(), &NAMES[..3], &honest, &[]);
    let all = [&honest[..], &[("agent-4", 1, &absurd)]].concat();
    assert!(fly(folders[1].path(), &NAMES, &all, &["agent-4"]) == clean, "the absurd model left a trace");
    let record = Merging::read(folders[1].path()).unwrap();
    assert!(record.kept_out[0].reason.contains("merge_memory to"), "{:?}", record.kept_out);
}

#[test]
fn a_model_that_does_not_fit_into_the_memory_does_not_stop_the_merge_of_the_others() {
    // The whole model is too large, or it fits, but its splats lie in heaps that no tile can divide.
    [44, 64].into_iter().for_each(merge_beside_a_large_model);
}

fn merge_beside_a_large_model(memory_mib: u64) {
    let right = flights();
    let mut large = flight(60.0);
    while large.splats.len() < 60_000 {
        large.splats.extend(&large.splats.clone());
    }
    let tight = MergeSettings { memory_bytes: memory_mib << 20, ..QUICK };
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let honest: Vec<_> = NAMES[..3].iter().zip(&right).map(|(name, model)| (*name, 1, model)).collect();
    let clean = fly_with(tight, folders[0].path(), &NAMES[..3], &honest, &[]);
    let all = [&honest[..], &[("agent-4", 1, &large)]].concat();
    assert!(
        fly_with(tight, folders[1].path(), &NAMES, &all, &["agent-4"]) == clean,
        "the large model left a trace"
    );
    let record = Merging::read(folders[1].path()).unwrap();
    assert!(record.kept_out[0].reason.contains("has more splats than fit"), "{:?}", record.kept_out);
}
