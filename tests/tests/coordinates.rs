//! Scenes elsewhere in the world and in other units, with the programs that cargo has built.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use cosurf_aggregator::evaluate::accuracy::judge;
use cosurf_scene::{Dataset, Mesh, ply};
use cosurf_tests::coordinates::{Coordinates, UTM};
use cosurf_tests::datasets::write_city;
use cosurf_tests::programs::program;
use glam::DVec3;
use serde_json::Value;

/// A small city, in `own` as it is.
struct Town {
    folder: tempfile::TempDir,
}

impl Town {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_city(&folder.path().join("own"), 40.0, 14, [160, 120]);
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes the city in other coordinates, without its true surface.
    fn elsewhere(&self, name: &str, coordinates: Coordinates) -> PathBuf {
        let folder = self.path(name);
        coordinates.write(&self.path("own"), &folder).unwrap();
        folder
    }
}

/// Runs a program and returns what it printed.
fn run(name: &str, words: &[&str], paths: &[&Path]) -> String {
    let out = Command::new(program(name)).args(words).args(paths).output().unwrap();
    assert!(out.status.success(), "{words:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// The F-score of a mesh at one metre.
fn f_score(mesh: &Mesh, truth: &Path) -> f64 {
    judge(mesh, &Mesh::read(truth).unwrap(), 1.0, 0).unwrap().0.samples.f_score
}

/// A mission over the city in UTM gives the figures of one over the city where it is, and files with coordinates of UTM.
#[test]
fn a_mission_in_utm_is_as_good_as_one_near_the_origin() {
    let town = Town::new();
    let fly = |data: &Path, name: &str| {
        let out = town.path(name);
        let words = ["mission", "--agents", "2", "--steps", "150", "--eval-every", "5", "--epochs", "2"];
        run("cosurf-aggregator", &[&words[..], &["--data"]].concat(), &[data, Path::new("--out"), &out]);
        out
    };
    let own = fly(&town.path("own"), "near");
    let far_data = town.elsewhere("far-data", Coordinates::at(UTM));
    let far = fly(&far_data, "far");
    let psnr = |out: &Path| json(&out.join("report.json"))["whole"]["quality"]["psnr"].as_f64().unwrap();
    let (near_psnr, far_psnr) = (psnr(&own), psnr(&far));
    assert!((near_psnr - far_psnr).abs() < 0.5, "{near_psnr} dB near, {far_psnr} far");
    assert_eq!(ply::origin(&own.join("global.ply")).unwrap(), DVec3::ZERO);
    let origin = ply::origin(&far.join("global.ply")).unwrap();
    assert!(origin.distance(UTM) < 1000.0 && origin.x.fract() == 0.0, "{origin}");
    let truth = town.path("own").join("gt/mesh.ply");
    let [near_mesh, far_mesh] = [&own, &far].map(|out| Mesh::read(&out.join("mesh.ply")).unwrap());
    let far_mesh = Coordinates::at(UTM).mesh_back(far_mesh);
    let [near_f, far_f] = [near_mesh, far_mesh].map(|mesh| f_score(&mesh, &truth));
    assert!(near_f > 0.4 && far_f > near_f - 0.1, "F-score {near_f} near, {far_f} far");
    // The commands read what a mission has written, without photographs.
    run("cosurf-aggregator", &["mesh", "--out"], &[&town.path("again.glb"), &far]);
    run(
        "cosurf-agent",
        &["render", "--max-size", "64", "--cameras"],
        &[&far, &far, Path::new("--out"), &town.path("seen")],
    );
    assert!(town.path("seen").join("camera-0001.color.png").is_file());
    let words = ["eval", "--eval-every", "5", "--json"];
    let eval: Value = serde_json::from_str(&run("cosurf-aggregator", &words, &[&far, &far_data])).unwrap();
    assert!((eval["mean"]["psnr"].as_f64().unwrap() - far_psnr).abs() < 0.01, "{eval}");
    let agents = ["agent-1", "agent-2"].map(|agent| far.join("agents").join(agent));
    let merged = town.path("merged");
    run(
        "cosurf-aggregator",
        &["merge", "--epochs", "1"],
        &[&agents[0], &agents[1], Path::new("--out"), &merged],
    );
    let eval: Value = serde_json::from_str(&run("cosurf-aggregator", &words, &[&merged, &far_data])).unwrap();
    assert!(eval["mean"]["psnr"].as_f64().unwrap() > far_psnr - 1.0, "{eval}");
    let cameras: Value = json(&merged.join("cameras.json"));
    let of_dataset = Dataset::open(&far_data).unwrap();
    let translations = of_dataset.views.iter().map(|view| view.camera.cam_from_world.translation);
    let first: Vec<f64> =
        serde_json::from_value(cameras[0]["cam_from_world"]["translation"].clone()).unwrap();
    let off = translations.map(|t| t.distance(DVec3::from_slice(&first))).fold(f64::MAX, f64::min);
    assert!(off < 1e-6, "the cameras have moved by {off} m");
}

/// A scene of another unit, or turned and as far away as the middle of the earth, is trained to the same model.
#[test]
fn a_scene_is_learnt_in_any_unit_and_in_ecef() {
    let town = Town::new();
    let train = |data: &Path, name: &str| {
        let out = town.path(name);
        let words = ["train", "--steps", "150", "--eval-every", "5", "--compute", "cpu"];
        run("cosurf-agent", &words, &[data, Path::new("--out"), &out]);
        let report = json(&out.join("report.json"));
        (report["psnr"].as_f64().unwrap(), report["splats"].as_u64().unwrap())
    };
    let own = train(&town.path("own"), "out-own");
    let all = [
        ("tiny", Coordinates::times(1e-4)),
        ("huge", Coordinates::times(1e5)),
        ("ecef", Coordinates::ecef()),
    ];
    for (name, coordinates) in all {
        let data = town.elsewhere(name, coordinates);
        let its = train(&data, &format!("out-{name}"));
        assert_eq!(its, own, "PSNR and splats of {name} are not those of the scene where it is");
        // Depths are told in the world's unit.
        let pictures = town.path(&format!("pictures-{name}"));
        let model = town.path(&format!("out-{name}"));
        run("cosurf-agent", &["render", "--cameras"], &[&data, &model, Path::new("--out"), &pictures]);
        let depths = fs::read_dir(&pictures).unwrap().map(|entry| entry.unwrap().path());
        let depth = depths.into_iter().find(|path| path.extension().is_some_and(|it| it == "pfm")).unwrap();
        let bytes = fs::read(depth).unwrap();
        let numbers = bytes[bytes.len() - 160 * 120 * 4..].as_chunks::<4>().0;
        let mut depths: Vec<f32> =
            numbers.iter().map(|b| f32::from_le_bytes(*b)).filter(|d| *d > 0.0).collect();
        depths.sort_by(f32::total_cmp);
        let median = f64::from(depths[depths.len() / 2]) / coordinates.scale;
        assert!((5.0..120.0).contains(&median), "{name}: {median}");
    }
}
