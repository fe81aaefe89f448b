//! The codec restores complete models to within half a step, decodes partial ones, and refuses forged bodies.
#![allow(clippy::unwrap_used)]

mod base;

use std::ops::Range;

use cosurf_scene::{Camera, LocalFrame, Pose, Splats};
use cosurf_wire::body::{
    BodyPlan, COLOR_STEP, HEAD_BYTES, OPACITY_STEP, PACK_ENTRY_BYTES, PackForm, PackKind,
};
use cosurf_wire::{DeviceId, ModelId, ModelKind};
use glam::{DQuat, DVec2, DVec3, Mat3, Quat, Vec3};

use super::*;
use crate::body::{BodyFault, Model};
use crate::offer::Offer;

/// Pseudo-random numbers in -1..1.
fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

/// Flat splats in a square of 20 m. Their view-dependent colours are combinations of three random vectors.
fn splats(count: usize, sh_degree: u32) -> Splats {
    let mut splats = Splats::with_capacity(count, sh_degree);
    let mut noise = noise(7);
    let directions: Vec<f32> = (0..3 * splats.sh_stride()).map(|_| 0.2 * noise()).collect();
    for _ in 0..count {
        let mean = [10.0 * noise(), 10.0 * noise(), 0.1 * noise()];
        let quat = [noise(), noise(), noise(), 0.1 + noise()];
        let log_scale = [-2.0 + noise(), -2.0 + noise(), -5.0 + 2.0 * noise()];
        let strengths = [noise(), noise(), noise()];
        let along =
            |i: usize| (0..3).map(|k| strengths[k] * directions[k * splats.sh_stride() + i]).sum::<f32>();
        let sh: Vec<f32> = (0..splats.sh_stride()).map(|i| if i < 3 { noise() } else { along(i) }).collect();
        splats.push(mean, quat, log_scale, 4.0 * noise(), &sh);
    }
    splats
}

fn cameras(count: usize) -> Vec<Camera> {
    let camera = |i: usize| Camera {
        cam_from_world: Pose {
            rotation: DQuat::from_rotation_x(0.1 * i as f64),
            translation: DVec3::new(i as f64, 0.1, -3.3),
        },
        focal_px: DVec2::new(500.25, 501.5),
        center_px: DVec2::new(319.1 + i as f64, 240.7),
        size_px: [640, 480],
    };
    (0..count).map(camera).collect()
}

/// Encodes `splats`. Lower indices are more important.
fn body(splats: &Splats) -> Vec<u8> {
    let importance: Vec<f32> = (0..splats.len()).map(|i| -(i as f32)).collect();
    model_to_body(splats, &cameras(3), &LocalFrame::WORLD, FirstLayer::ByImportance(&importance)).unwrap()
}

fn axes(splats: &Splats, i: usize) -> (Mat3, Vec3) {
    let [w, x, y, z] = splats.quats[i];
    (Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize()), Vec3::from(splats.log_scales[i].map(f32::exp)))
}

fn normal(splats: &Splats, i: usize) -> Vec3 {
    let (axes, scale) = axes(splats, i);
    let least = (0..3).min_by(|&a, &b| scale[a].total_cmp(&scale[b])).unwrap();
    axes.col(least)
}

/// The index in `sent` of the splat that is nearest to each splat of `found`.
fn origins(found: &Splats, sent: &Splats) -> Vec<usize> {
    let distance = |a: [f32; 3], b: [f32; 3]| Vec3::from(a).distance_squared(Vec3::from(b));
    let nearest = |mean: &[f32; 3]| {
        (0..sent.len())
            .min_by(|&a, &b| distance(sent.means[a], *mean).total_cmp(&distance(sent.means[b], *mean)))
    };
    found.means.iter().map(|mean| nearest(mean).unwrap()).collect()
}

#[test]
fn a_model_round_trips_within_half_a_step() {
    let sent = splats(1500, 2);
    let Model { splats: found, cameras: found_cameras } =
        body_to_model(&body(&sent), &LocalFrame::WORLD).unwrap();
    assert_eq!(found_cameras, cameras(3), "cameras are encoded without loss");
    let origins = origins(&found, &sent);
    let mut distinct = origins.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert_eq!(distinct.len(), sent.len());
    let mut tilts = Vec::new();
    for (i, &origin) in origins.iter().enumerate() {
        let mut sorted = axes(&sent, origin).1.to_array();
        sorted.sort_unstable_by(f32::total_cmp);
        let error_m = Vec3::from(found.means[i]).distance(Vec3::from(sent.means[origin]));
        assert!(error_m < 0.01, "{error_m} m for splats of 0.1 m");
        let tilt = normal(&found, i).cross(normal(&sent, origin)).length().asin().to_degrees();
        tilts.push(tilt);
        assert!(tilt < 0.2 || sorted[1] < 1.1 * sorted[0], "{tilt}°");
        let found_scale = found.log_scales[i].map(f32::exp);
        assert!(
            (found_scale[0] / sorted[2]).ln().abs() <= 0.0313
                && (found_scale[1] / sorted[1]).ln().abs() <= 0.0313
        );
        assert!((found_scale[2] - sorted[0]).abs() <= 0.035 * sorted[1], "{found_scale:?} of {sorted:?}");
        assert!((found.opacity_logits[i] - sent.opacity_logits[origin]).abs() <= 0.5 * OPACITY_STEP);
        for (a, b) in found.sh_of(i)[..3].iter().zip(sent.sh_of(origin)) {
            assert!((a - b).abs() <= 0.5 * COLOR_STEP + 1e-6);
        }
        for (a, b) in found.sh_of(i)[3..].iter().zip(&sent.sh_of(origin)[3..]) {
            assert!((a - b).abs() < 0.03, "{a} {b}");
        }
    }
    tilts.sort_unstable_by(f32::total_cmp);
    assert!(tilts[tilts.len() / 2] < 0.07, "{}° at the median", tilts[tilts.len() / 2]);
}

#[test]
fn encoding_is_deterministic_and_quantised_values_stay_the_same() {
    let sent = splats(900, 3);
    assert_eq!(body(&sent), body(&sent));
    let once = body_to_model(&body(&sent), &LocalFrame::WORLD).unwrap().splats;
    let twice = body_to_model(&body(&once), &LocalFrame::WORLD).unwrap().splats;
    let opacities = |splats: &Splats| {
        let mut all = splats.opacity_logits.clone();
        all.sort_unstable_by(f32::total_cmp);
        all
    };
    assert_eq!(opacities(&once), opacities(&twice));
}

#[test]
fn every_degree_and_count_round_trips() {
    for sh_degree in 0..=3 {
        for count in [0, 1, 2, 17, 9000] {
            let sent = splats(count, sh_degree);
            let found = body_to_model(&body(&sent), &LocalFrame::WORLD).unwrap().splats;
            assert_eq!((found.len(), found.sh_degree, found.find_bad_value()), (count, sh_degree, None));
        }
    }
}

#[test]
fn extreme_models_round_trip() {
    // Identical splats would compress beyond the maximum ratio, so their pack is stored uncompressed.
    let mut same = Splats::with_capacity(4000, 1);
    (0..4000).for_each(|_| same.push([5.0; 3], [2.0, 0.0, 0.0, 0.0], [-1.0; 3], 3.0, &[0.5; 12]));
    let found = body_to_model(&body(&same), &LocalFrame::WORLD).unwrap().splats;
    assert_eq!((found.len(), found.means[9]), (4000, [5.0; 3]));
    // Edge cases: distant positions, extreme scales, identity and 180° rotations.
    let mut odd = Splats::with_capacity(4, 0);
    odd.push([1e20, -1e20, 0.0], [0.0, 1.0, 0.0, 0.0], [39.9, -39.9, 0.0], 100.0, &[1e5, -1e5, 0.0]);
    odd.push([-1e20, 1e20, 1e-20], [1.0, 0.0, 0.0, 0.0], [-39.9; 3], -100.0, &[0.0; 3]);
    odd.push([0.0; 3], [1e-4, 1e-4, 0.0, 0.0], [0.0; 3], 0.0, &[0.0; 3]);
    odd.push([1.0; 3], [-0.5, 0.5, -0.5, 0.5], [3.0, 2.0, 1.0], 0.0, &[0.0; 3]);
    let found = body_to_model(&body(&odd), &LocalFrame::WORLD).unwrap().splats;
    assert_eq!((found.len(), found.find_bad_value()), (4, None));
}

#[test]
fn invalid_values_are_refused() {
    type Spoil = fn(&mut Splats);
    let spoils: [(Spoil, &str); 4] = [
        (|s| s.means[3][1] = f32::NAN, "mean"),
        (|s| s.means[3][1] = 1e30, "mean"),
        (|s| s.quats[3] = [0.0; 4], "quat"),
        (|s| s.log_scales[3][0] = f32::INFINITY, "log_scale"),
    ];
    for (spoil, field) in spoils {
        let mut splats = splats(5, 1);
        spoil(&mut splats);
        let fault =
            model_to_body(&splats, &[], &LocalFrame::WORLD, FirstLayer::ByImportance(&[0.0; 5])).unwrap_err();
        assert_eq!(fault, BodyFault::Splat { index: 3, field });
    }
    let mut cameras = cameras(2);
    cameras[1].size_px[0] = 0;
    let fault = model_to_body(&splats(1, 0), &cameras, &LocalFrame::WORLD, FirstLayer::ByImportance(&[0.0]))
        .unwrap_err();
    assert_eq!(fault, BodyFault::Camera { index: 1 });
}

#[test]
fn every_prefix_is_a_model_and_the_most_important_splats_come_first() {
    let sent = splats(9000, 1);
    let body = body(&sent);
    let whole = body_to_model(&body, &LocalFrame::WORLD).unwrap();
    let mut counts = Vec::new();
    for end in (0..=body.len()).step_by(4999).chain([body.len()]) {
        let found = part_to_model(&body, |range| range.end <= end, &LocalFrame::WORLD).unwrap();
        counts.push(found.as_ref().map_or(0, |model| model.splats.len()));
        if end == body.len() {
            assert_eq!(found.as_ref(), Some(&whole));
        }
    }
    assert!(counts.is_sorted() && counts[0] == 0 && counts.last() == Some(&9000), "{counts:?}");
    let first = part_to_model(&body, |range| range.end <= 3 * body.len() / 10, &LocalFrame::WORLD)
        .unwrap()
        .unwrap()
        .splats;
    let latest = origins(&first, &sent).into_iter().max().unwrap();
    assert!(
        latest < 9000 / 4,
        "the first layer has only the most important quarter, but also index {latest}"
    );
}

#[test]
fn packs_after_a_missing_one_are_used() {
    let body = body(&splats(3000, 1));
    let plan = BodyPlan::new(&body).unwrap();
    let packs: Vec<_> = plan.packs_of(PackKind::Shapes).collect();
    let lost = &packs[1].range;
    let is_here = |range: std::ops::Range<usize>| range.end <= lost.start || range.start >= lost.end;
    let found = part_to_model(&body, is_here, &LocalFrame::WORLD).unwrap().unwrap().splats;
    assert_eq!(found.len(), 3000 - usize::from(packs[1].entry.splats));
    let colors = found.sh.chunks_exact(12).filter(|sh| sh[3..].iter().any(|v| *v != 0.0)).count();
    assert!(colors > 2000, "{colors} have their own spherical harmonics");
}

/// Flips one bit in every byte, and truncates the body at every byte. Each damaged body must give an error.
#[test]
fn damage_is_detected() {
    let body = body(&splats(40, 1));
    for i in 0..body.len() {
        let mut damaged = body.clone();
        damaged[i] ^= 1 << (i % 8);
        assert!(body_to_model(&damaged, &LocalFrame::WORLD).is_err(), "byte {i}");
        assert!(body_to_model(&body[..i], &LocalFrame::WORLD).is_err(), "cut at {i}");
    }
    assert!(body_to_model(&[&body[..], &[0]].concat(), &LocalFrame::WORLD).is_err());
}

/// Changes sizes and checksum of table entry `i` and fixes the checksum of head and table, as an attacker
/// would.
fn forge(body: &mut [u8], i: usize, bytes: u32, splats: u16, crc32: u32) {
    let at = HEAD_BYTES + i * PACK_ENTRY_BYTES;
    body[at + 2..at + 4].copy_from_slice(&splats.to_le_bytes());
    body[at + 4..at + 8].copy_from_slice(&bytes.to_le_bytes());
    body[at + 8..at + 12].copy_from_slice(&crc32.to_le_bytes());
    let packs = usize::from(u16::from_le_bytes([body[6], body[7]]));
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&body[..HEAD_BYTES - 4]);
    hasher.update(&body[HEAD_BYTES..HEAD_BYTES + packs * PACK_ENTRY_BYTES]);
    body[HEAD_BYTES - 4..HEAD_BYTES].copy_from_slice(&hasher.finalize().to_le_bytes());
}

#[test]
fn harmonics_are_coarsened_to_meet_the_target_size() {
    for (count, sh_degree, bytes_max) in [(3000, 2, 16.0), (8000, 2, 16.0), (8000, 3, 18.0)] {
        let mut model = splats(count, sh_degree);
        let mut noise = noise(9);
        let stride = model.sh_stride();
        // Each splat gets noise of its own. In a small model, such noise costs more bytes than its statistics
        // predict.
        model.sh.chunks_exact_mut(stride).for_each(|sh| sh[3..].iter_mut().for_each(|v| *v += 0.1 * noise()));
        let bytes = body(&model).len() as f64 / count as f64;
        assert!(bytes <= bytes_max, "{count} splats of degree {sh_degree}: {bytes} bytes each");
    }
}

/// Decompression bombs: a zstd frame with an excessive ratio, size or window is refused before it is
/// unpacked.
#[test]
fn fault_05_decompression_bombs_are_refused() {
    let splats = splats(8000, 0);
    let valid =
        model_to_body(&splats, &[], &LocalFrame::WORLD, FirstLayer::ByImportance(&vec![1.0; 8000])).unwrap();
    let plan = BodyPlan::new(&valid).unwrap();
    let first = plan.packs().next().unwrap();
    assert_eq!((first.entry.kind, first.entry.form), (PackKind::Shapes, PackForm::Zstd));
    let rest = valid[first.range.end..].to_vec();
    let replaced = |frame: &[u8], splats: u16| {
        let mut body = valid[..first.range.start].to_vec();
        body.extend_from_slice(frame);
        body.extend_from_slice(&rest);
        forge(&mut body, 0, frame.len() as u32, splats, crc32fast::hash(frame));
        body_to_model(&body, &LocalFrame::WORLD)
    };
    let count = first.entry.splats;
    assert!(replaced(&valid[first.range.clone()], count).is_ok(), "the forged entry itself is valid");
    let unpacked = 20 + 20 * usize::from(count);
    // A frame of zeros has an excessive ratio.
    let zeros = zstd::bulk::compress(&vec![0; unpacked], 19).unwrap();
    assert_eq!(replaced(&zeros, count), Err(cosurf_wire::body::BodyError::BadTable.into()));
    // The frame contains more bytes than the table requires, or fewer.
    let noise: Vec<u8> = (0..unpacked + 1).map(|i| (((i * i) >> 3) as u8 ^ (i >> 8) as u8) & 63).collect();
    for wrong in [unpacked + 1, unpacked - 1] {
        let frame = zstd::bulk::compress(&noise[..wrong], 1).unwrap();
        assert_eq!(replaced(&frame, count), Err(cosurf_wire::body::BodyError::BadPack.into()), "{wrong}");
    }
    // The same splats are compressed with the largest allowed window, and with a window of 128 MiB.
    let right = zstd::stream::decode_all(&valid[first.range.clone()]).unwrap();
    let windowed = |window_log| {
        let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
        encoder.window_log(window_log).unwrap();
        std::io::Write::write_all(&mut encoder, &right).unwrap();
        replaced(&encoder.finish().unwrap(), count)
    };
    assert!(windowed(cosurf_wire::body::WINDOW_LOG).is_ok());
    assert_eq!(windowed(27), Err(cosurf_wire::body::BodyError::BadPack.into()));
}

#[test]
fn a_body_that_contradicts_its_header_is_refused() {
    let device = DeviceId::new("drone").unwrap();
    let offer = Offer::new(device, ModelId(1), ModelKind::Local, 3, &splats(300, 1), &cameras(3)).unwrap();
    assert_eq!(check_body(&offer.header, &offer.body), Ok(()));
    let mut other = offer.header;
    other.splats += 1;
    assert_eq!(check_body(&other, &offer.body), Err(BodyFault::NotAsAnnounced));
    let mut other = offer.header;
    other.bounds.max[0] += 1.0;
    assert_eq!(check_body(&other, &offer.body), Err(BodyFault::NotAsAnnounced));
}

/// The origin of a site in UTM.
fn utm() -> LocalFrame {
    LocalFrame::at(DVec3::new(500_000.0, 5_200_000.0, 0.0))
}

/// Far from the world's origin, the splats cost 36 bytes more and lose nothing, and the cameras are in the world.
#[test]
fn a_model_far_away_keeps_its_millimetres() {
    let (sent, near) = (splats(300, 1), body(&splats(300, 1)));
    let importance: Vec<f32> = (0..sent.len()).map(|i| -(i as f32)).collect();
    let far = model_to_body(&sent, &cameras(3), &utm(), FirstLayer::ByImportance(&importance)).unwrap();
    let plain = model_to_body(&sent, &[], &LocalFrame::WORLD, FirstLayer::ByImportance(&importance)).unwrap();
    let bare = model_to_body(&sent, &[], &utm(), FirstLayer::ByImportance(&importance)).unwrap();
    assert_eq!(bare.len(), plain.len() + PACK_ENTRY_BYTES + 24);
    assert_eq!(body_frame(&far).unwrap(), utm());
    assert_eq!(body_frame(&near).unwrap(), LocalFrame::WORLD);
    let decoded = body_to_model(&far, &utm()).unwrap();
    assert_eq!(decoded.splats, body_to_model(&near, &LocalFrame::WORLD).unwrap().splats);
    for (camera, own) in decoded.cameras.iter().zip(cameras(3)) {
        let off = camera.cam_from_world.translation.distance(own.cam_from_world.translation);
        assert!(off < 1e-8, "{off}");
    }
    let world = body_to_model(&far, &LocalFrame::WORLD).unwrap();
    let center = world.cameras[1].cam_from_world.center();
    assert!(center.distance(utm().world_from_local(cameras(3)[1].cam_from_world.center())) < 1e-8);
    let neighbour = LocalFrame::at(utm().origin() + DVec3::X * 1000.0);
    let moved = body_to_model(&far, &neighbour).unwrap().splats;
    let expected = decoded.splats.means.iter().map(|[x, y, z]| [x - 1000.0, *y, *z]);
    assert!(expected.zip(&moved.means).all(|(a, b)| (a[0] - b[0]).abs() < 1e-4 && a[1..] == b[1..]));
}

/// Until the origin has arrived, nobody knows where the splats lie.
#[test]
fn a_part_without_its_origin_is_no_part() {
    let sent = splats(300, 0);
    let importance: Vec<f32> = (0..sent.len()).map(|i| -(i as f32)).collect();
    let body = model_to_body(&sent, &cameras(3), &utm(), FirstLayer::ByImportance(&importance)).unwrap();
    let origin = BodyPlan::new(&body).unwrap().packs_of(PackKind::Origin).next().unwrap().range;
    let part = |lacks: &Range<usize>| {
        let is_here = |range: Range<usize>| range.end <= lacks.start || range.start >= lacks.end;
        part_to_model(&body, is_here, &utm()).unwrap()
    };
    assert_eq!(part(&(0..0)).unwrap().splats.len(), 300);
    assert_eq!(part(&origin), None);
}

/// A scene of a millionth of the usual size is sent in the world's unit.
#[test]
fn a_model_of_another_unit_comes_back() {
    let tiny: Vec<Camera> = cameras(3)
        .iter()
        .map(|camera| {
            let Pose { rotation, translation } = camera.cam_from_world;
            Camera { cam_from_world: Pose { rotation, translation: translation * 1e-6 }, ..*camera }
        })
        .collect();
    let frame = LocalFrame::of(tiny.iter());
    assert!(frame.unit() < 1e-6, "{frame:?}");
    let local: Vec<Camera> = tiny.iter().map(|camera| frame.local_camera(camera)).collect();
    let sent = splats(300, 1);
    let importance: Vec<f32> = (0..sent.len()).map(|i| -(i as f32)).collect();
    let body = model_to_body(&sent, &local, &frame, FirstLayer::ByImportance(&importance)).unwrap();
    assert_eq!(scene_frame(&body).unwrap(), frame);
    let found = body_to_model(&body, &frame).unwrap().splats;
    for (i, of) in origins(&found, &sent).into_iter().enumerate() {
        let off = Vec3::from(found.means[i]).distance(Vec3::from(sent.means[of]));
        assert!(off < 0.05, "splat {i} moved by {off}");
    }
    let far = LocalFrame::at(DVec3::X * 1e9);
    assert_eq!(
        model_to_body(&sent, &[], &far, FirstLayer::ByImportance(&importance)),
        Err(BodyFault::Origin)
    );
}
