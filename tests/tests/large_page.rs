//! The page of a site with more splats than a page can show: it loads the ground near the camera in full.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::net::TcpListener;
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_tests::chromium::Chromium;
use cosurf_tests::running::{PATIENCE, Running};
use cosurf_tests::wide_ground::write_models;
use serde_json::Value;

/// The ground of the models overlaps a little, metres.
const PITCH_M: f32 = 93.0;
/// The page's limits: splats of the base, and of tiles.
const BASE_MAX: u64 = 400_000;
const TILES_MAX: u64 = 400_000;

/// What the viewer shows: tiles in full, splats, splats in the box of each of these tiles, and their true numbers.
fn shown(browser: &Chromium) -> Value {
    browser.value(
        "cosurf.then(({tiles, scene}) => { const full = [...tiles.loaded.keys()]; \
         const {positions, count} = tiles.shown; \
         const within = ({low, high}) => { let inside = 0; \
           for (let i = 0; i < count; i++) inside += [0, 1, 2].every((k) => \
             positions[3 * i + k] > low[k] - 1e-3 && positions[3 * i + k] < high[k] + 1e-3); return inside; }; \
         const boxes = full.map((tile) => scene.tiles.boxes[tile]); \
         return {full, count, within: boxes.map(within), wanted: boxes.map(({splats}) => splats)}; })",
    )
}

/// Flies to a point of the ground, given as shares of the site from west to east and from south to north, and waits until
/// nothing more is loaded.
fn fly_to(browser: &Chromium, [east, north]: [f64; 2]) -> Value {
    browser.value(&format!(
        "cosurf.then((viewer) => {{ const {{boxes}} = viewer.scene.tiles; \
         const [low, high] = [Math.min, Math.max].map((of, i) => [0, 1].map((k) => \
           of(...boxes.map((box) => [box.low, box.high][i][k])))); \
         const at = [{east}, {north}].map((share, k) => low[k] + share * (high[k] - low[k])); \
         const unit = viewer.scene.unit; \
         Object.assign(viewer.walk, {{pivot: [...at, boxes[0].high[2]], distance: 15 / unit, pitch: -0.9}}); \
         viewer.changed(); }})"
    ));
    let begun = Instant::now();
    loop {
        let before = shown(browser);
        sleep(Duration::from_secs(2));
        if shown(browser) == before && !before["full"].as_array().unwrap().is_empty() {
            return before;
        }
        assert!(begun.elapsed() < PATIENCE, "{before}");
    }
}

/// A running service with a site of models with their corners in the south-west here, metres.
struct Site {
    /// Ends before the folder goes.
    program: Running,
    _folder: tempfile::TempDir,
}

impl Site {
    fn of(corners: &[[f32; 2]], sh_degree: u32) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let splats = write_models(&folder.path().join("out"), corners, sh_degree);
        let broker = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let text = format!(
            "site = \"site\"\nframe = \"site\"\nout = \"out\"\nbind = \"{broker}\"\nquorum = 1\nquiet_s = 0\nrefine = false\n"
        );
        fs::write(folder.path().join("aggregator.toml"), text).unwrap();
        let program = Running::start("cosurf-aggregator", folder.path(), &["run", "--http", "127.0.0.1:0"]);
        let begun = Instant::now();
        while !program.log().contains("global model, revision 1") {
            assert!(begun.elapsed() < PATIENCE, "{}", program.log());
            sleep(Duration::from_millis(100));
        }
        println!("{splats} splats merged after {:.0?}", begun.elapsed());
        Self { program, _folder: folder }
    }
}

/// From above, the site is the base alone; near two of its corners, tiles are there in full, and those of the first are given up
/// at the second.
fn check_detail(browser: &Chromium, base: &Value) {
    // Until the page could have begun to load tiles.
    sleep(Duration::from_secs(1));
    let overview = shown(browser);
    assert_eq!((&overview["full"], &overview["count"]), (&serde_json::json!([]), base));
    let begun = Instant::now();
    let first = fly_to(browser, [0.15, 0.15]);
    println!("near the first corner after {:.1?}: {first}", begun.elapsed());
    let second = fly_to(browser, [0.85, 0.85]);
    println!("near the second corner: {second}");
    for place in [&first, &second] {
        for (within, wanted) in
            place["within"].as_array().unwrap().iter().zip(place["wanted"].as_array().unwrap())
        {
            let [within, wanted] = [within, wanted].map(|count| count.as_f64().unwrap());
            // Some splats of neighbours lie on the edge of the box.
            assert!(within >= wanted && within < 1.02 * wanted + 100.0, "{place}");
        }
        assert!(place["count"].as_u64().unwrap() <= BASE_MAX + TILES_MAX, "{place}");
    }
    let [first, second] = [&first, &second].map(|place| place["full"].as_array().unwrap());
    assert!(first.iter().all(|tile| !second.contains(tile)), "far tiles are given up: {first:?} {second:?}");
    assert_eq!(browser.complaints(), [""; 0]);
}

/// The scene without what is long.
fn scene(browser: &Chromium) -> Value {
    browser.value("cosurf.then(({scene}) => ({...scene, cameras: [], devices: []}))")
}

#[test]
fn the_page_shows_the_ground_near_the_camera_in_full() {
    let Some(browser) = Chromium::start([500, 450]) else { return };
    let corners: Vec<[f32; 2]> = (0..12).map(|i| [i % 4, i / 4].map(|step| PITCH_M * step as f32)).collect();
    let site = Site::of(&corners, 1);
    browser.open(&site.program.page());
    let scene = scene(&browser);
    let tiles = scene["tiles"]["boxes"].as_array().unwrap();
    assert!(tiles.len() > 10 && scene["of_splats"].as_u64().unwrap() > 1_000_000, "{scene}");
    assert!(scene["splats"].as_u64().unwrap() <= BASE_MAX);
    check_detail(&browser, &scene["splats"]);
}

/// Splats with harmonics of degree 3 take so much memory that 260,111 of them fit.
#[test]
fn a_smaller_site_that_does_not_fit_shows_its_detail_as_well() {
    let Some(browser) = Chromium::start([500, 450]) else { return };
    let corners = [0.0, 1.0, 2.0, 3.0].map(|step| [PITCH_M * step, 0.0]);
    let site = Site::of(&corners, 3);
    browser.open(&site.program.page());
    let scene = scene(&browser);
    let [splats, all] = ["splats", "of_splats"].map(|name| scene[name].as_u64().unwrap());
    assert!(splats < all && all < 1_000_000 && !scene["tiles"].is_null(), "{scene}");
    check_detail(&browser, &scene["splats"]);
}
