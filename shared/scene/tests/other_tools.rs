//! Files of models and poses against the tools of others: splat-transform of PlayCanvas, and pycolmap. `.ci/run` installs them
//! into `target/validators`.

#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::Command;

use cosurf_scene::spz::{self, Version};
use cosurf_scene::{Camera, Dataset, LocalFrame, Pose, SparsePoint, Splats, View, colmap, model, ply};
use cosurf_tests::skips::skip;
use glam::{DVec2, DVec3};
use tempfile::TempDir;

fn validators() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/validators")
}

/// Runs splat-transform on one file.
fn transform(from: &Path, to: &Path, options: &[&str]) {
    let program = validators().join("node_modules/.bin/splat-transform");
    let run = Command::new(program).args(options).arg("-w").args([from, to]).output().unwrap();
    let told = [run.stdout, run.stderr].map(|of| String::from_utf8_lossy(&of).into_owned()).concat();
    assert!(run.status.success() && to.is_file(), "{} to {}: {told}", from.display(), to.display());
}

fn has_transform() -> bool {
    let is_there = validators().join("node_modules/.bin/splat-transform").is_file();
    if !is_there {
        skip("REQUIRE_SPLAT_TRANSFORM", "splat-transform is not installed");
    }
    is_there
}

/// Splats of degree 1, a metre apart, whose other values differ in all fields.
fn model_of_many() -> Splats {
    let mut splats = Splats::with_capacity(512, 1);
    for i in 0..512_u32 {
        let share = |factor: u32| (i * factor % 97) as f32 / 97.0;
        let mean = [(i % 8) as f32, (i / 8 % 8) as f32 - 3.0, 0.5 + (i / 64) as f32];
        let quat = [0.9, share(3) - 0.5, share(5) - 0.5, share(7) - 0.5];
        let length = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
        let log_scales = [share(11), share(13), share(17)].map(|of| -4.0 + 3.0 * of);
        let sh: Vec<f32> = (0..12).map(|k| 0.8 * (share(19 + 2 * k) - 0.5)).collect();
        splats.push(mean, quat.map(|v| v / length), log_scales, 4.0 * share(23) - 1.0, &sh);
    }
    splats
}

/// Largest differences of the splats of two models, whose orders may differ: means, rotations as angles (radians), logarithms
/// of sizes, opacities (0 to 1), coefficients of colour.
fn differences(is: &Splats, wanted: &Splats) -> [f32; 5] {
    assert_eq!((is.len(), is.sh_degree), (wanted.len(), wanted.sh_degree));
    let mut most = [0.0_f32; 5];
    let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
    for i in 0..wanted.len() {
        let distance =
            |j: &usize| (0..3).map(|axis| (is.means[*j][axis] - wanted.means[i][axis]).powi(2)).sum::<f32>();
        let j = (0..is.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        let [a, b] = [is.quats[j], wanted.quats[i]];
        let [length_a, length_b] = [a, b].map(|quat| quat.iter().map(|v| v * v).sum::<f32>().sqrt());
        let dot = a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>().abs() / (length_a * length_b);
        let of = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let found = [
            distance(&j).sqrt(),
            2.0 * dot.min(1.0).acos(),
            of(&is.log_scales[j], &wanted.log_scales[i]),
            (opacity(is.opacity_logits[j]) - opacity(wanted.opacity_logits[i])).abs(),
            of(is.sh_of(j), wanted.sh_of(i)),
        ];
        most = std::array::from_fn(|k| most[k].max(found[k]));
    }
    most
}

/// Fails if a model differs by more than the steps of SPZ and of the compressed PLY: a millimetre, 0.03 in the logarithm of a
/// size, a 128th and so on.
fn check_about(file: &Path, wanted: &Splats, angle_max: f32) {
    let most = differences(&model::read(file, &LocalFrame::WORLD).unwrap(), wanted);
    let limits = [0.006, angle_max, 0.04, 0.01, 0.07];
    assert!((0..5).all(|k| most[k] <= limits[k]), "{}: {most:?}, at most {limits:?}", file.display());
}

/// A folder with a model as `ours.ply`, and the model.
fn written() -> (TempDir, Splats) {
    let folder = tempfile::tempdir().unwrap();
    let wanted = model_of_many();
    ply::write(&folder.path().join("ours.ply"), &wanted, &LocalFrame::WORLD).unwrap();
    (folder, wanted)
}

#[test]
fn splat_transform_reads_what_is_written_here() {
    if !has_transform() {
        return;
    }
    let (folder, wanted) = written();
    let at = |name: &str| folder.path().join(name);
    transform(&at("ours.ply"), &at("theirs.ply"), &[]);
    let most = differences(&ply::read(&at("theirs.ply"), &LocalFrame::WORLD).unwrap(), &wanted);
    assert!(most.iter().all(|of| *of < 1e-3), "{most:?}");
    for (version, angle_max) in [(Version::V2, 0.04), (Version::V3, 0.01), (Version::V4, 0.01)] {
        spz::write(&at("ours.spz"), &wanted, version).unwrap();
        transform(&at("ours.spz"), &at("of_spz.ply"), &[]);
        check_about(&at("of_spz.ply"), &wanted, angle_max);
    }
}

#[test]
fn splat_transform_ignores_further_properties() {
    if !has_transform() {
        return;
    }
    let (folder, wanted) = written();
    let [from, to] = ["with_views.ply", "theirs.ply"].map(|name| folder.path().join(name));
    let (count, values) = (wanted.len(), vec![0.0; wanted.len()]);
    ply::write_with_extra(&from, count, 1, &LocalFrame::WORLD, &["views"], |write| write(&wanted, &values))
        .unwrap();
    transform(&from, &to, &["--filter-nan"]);
    let most = differences(&ply::read(&to, &LocalFrame::WORLD).unwrap(), &wanted);
    assert!(most.iter().all(|of| *of < 1e-3), "{most:?}");
}

#[test]
fn what_splat_transform_writes_is_read_here() {
    if !has_transform() {
        return;
    }
    let (folder, wanted) = written();
    let at = |name: &str| folder.path().join(name);
    for version in ["3", "4"] {
        transform(&at("ours.ply"), &at("theirs.spz"), &["--spz-version", version]);
        check_about(&at("theirs.spz"), &wanted, 0.01);
    }
    transform(&at("ours.ply"), &at("theirs.compressed.ply"), &[]);
    check_about(&at("theirs.compressed.ply"), &wanted, 0.01);
}

/// Fails unless pycolmap finds the cameras, poses and points that the arguments tell.
const READ: &str = "
import sys, numpy, pycolmap
its = pycolmap.Reconstruction(sys.argv[1])
image = next(image for image in its.images.values() if image.name == sys.argv[2])
center = [float(word) for word in sys.argv[3].split()]
assert numpy.allclose(image.projection_center(), center, atol=1e-9), image.projection_center()
point = next(iter(its.points3D.values()))
seen = image.project_point(point.xyz)
wanted = [float(word) for word in sys.argv[4].split()]
assert numpy.allclose(seen, wanted, atol=1e-6), (seen, wanted)
assert len(its.images) == 2 and len(its.cameras) == 1 and its.num_points3D() == 1
assert point.track.length() == 2 and image.num_points3D == 1, point.track
assert its.compute_mean_reprojection_error() < 1e-6
";

#[test]
fn pycolmap_reads_the_poses_that_are_written_here() {
    let python = validators().join("bin/python");
    let has = Command::new(&python).args(["-c", "import pycolmap"]).output();
    if !has.is_ok_and(|output| output.status.success()) {
        return skip("REQUIRE_VALIDATORS", "Python has no package pycolmap");
    }
    let folder = tempfile::tempdir().unwrap();
    let view = |name: &str, x: f64| View {
        name: name.into(),
        camera: Camera {
            cam_from_world: Pose::look_at(DVec3::new(x, -3.0, 40.0), DVec3::new(1.0, 2.0, 0.0), DVec3::Y),
            focal_px: DVec2::new(700.0, 710.0),
            center_px: DVec2::new(321.5, 239.0),
            size_px: [640, 480],
        },
        path: folder.path().join("images").join(name),
        mask: None,
    };
    let views = vec![view("a b.jpg", -4.0), view("ü.jpg", 5.0)];
    let position = DVec3::new(1.5, 2.5, 0.25);
    let points = vec![SparsePoint { position, rgb: [9, 8, 7], views: vec![0, 1] }];
    colmap::write(folder.path(), &Dataset { views: views.clone(), points }).unwrap();
    for View { name, camera, .. } in &views {
        let words = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let run = Command::new(&python)
            .args(["-c", READ])
            .arg(folder.path().join("sparse/0"))
            .arg(name)
            .arg(words(&camera.cam_from_world.center().to_array()))
            .arg(words(&camera.project(position).unwrap().to_array()))
            .output()
            .unwrap();
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    }
}
