//! The viewer in a headless browser: its pictures against those of the CPU renderer, its measurements, and its keys.
#![allow(clippy::unwrap_used)]

use std::env::var_os;
use std::fs;
use std::path::{Path, PathBuf};

use cosurf_engine::{Renderer, Rendering};
use cosurf_scene::{Camera, Dataset, LocalFrame, Picture, Pose, Splats, camera_list, metrics, ply, spz};
use cosurf_tests::chromium::{Chromium, decode_base64};
use cosurf_tests::models::noise;
use cosurf_tests::running::Running;
use glam::{DVec2, DVec3};

/// The viewer and the CPU renderer show the same quantised splats, so they differ only by rounding, dB.
const SAME_SPLATS_DB: f64 = 50.0;
/// Against the model before it was quantised, dB.
const BEFORE_QUANTISING_DB: f64 = 30.0;
/// Largest error of a picked depth, as a share of the depth.
const DEPTH_SHARE: f64 = 1e-3;

/// Undulating ground of 60 × 60 m with boxes' worth of upright splats, and harmonics up to degree 3.
fn model() -> Splats {
    let mut splats = Splats::with_capacity(6000, 3);
    let mut noise = noise(7);
    for _ in 0..6000 {
        let [x, y] = [30.0 * noise(), 30.0 * noise()];
        let z = 3.0 * (x / 7.0).sin() * (y / 9.0).cos();
        let quat = [1.0, 0.3 * noise(), 0.3 * noise(), noise()];
        let log_scale = [-0.6 + 0.5 * noise(), -0.6 + 0.5 * noise(), -4.0];
        let mut sh = vec![0.0; splats.sh_stride()];
        sh[..3].iter_mut().for_each(|v| *v = 1.2 * noise());
        sh[3..].iter_mut().for_each(|v| *v = 0.1 * noise());
        splats.push([x, y, z], quat, log_scale, 2.0 + 2.0 * noise(), &sh);
    }
    splats
}

/// Cameras around the model, above it, and among its splats.
fn cameras() -> Vec<Camera> {
    let eyes = [[0.0, -40.0, 30.0], [25.0, 20.0, 18.0], [-5.0, 3.0, 50.0], [2.0, -6.0, 6.0]];
    let camera = |[x, y, z]: [f64; 3]| Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, z), DVec3::new(1.0, 2.0, 0.0), DVec3::Y + DVec3::Z),
        focal_px: DVec2::new(210.0, 205.0),
        center_px: DVec2::new(119.0, 92.5),
        size_px: [240, 181],
    };
    eyes.map(camera).to_vec()
}

/// Serves a folder's model. Returns the program and its address.
fn serve(folder: &Path, model: &Path) -> (Running, String) {
    let program = Running::start("cosurf-aggregator", folder, &["view", &model.display().to_string()]);
    let url = program.page();
    (program, url)
}

/// What the viewer draws from camera `index` of its scene.
fn picture(browser: &Chromium, index: usize) -> Picture {
    let taken = format!("cosurf.then((viewer) => viewer.picture(viewer.scene.cameras[{index}]))");
    let url = browser.value(&taken);
    let png = decode_base64(url.as_str().unwrap().strip_prefix("data:image/png;base64,").unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("picture.png");
    fs::write(&path, png).unwrap();
    Picture::read(&path).unwrap()
}

/// PSNR of a picture against what the CPU renderer shows, as a PNG would hold it, dB.
fn psnr(picture: &Picture, rendering: &Rendering) -> f64 {
    let expected = Picture::from_unit(rendering.size_px, &rendering.rgb);
    assert_eq!(picture.size_px, expected.size_px);
    let unit = |picture: &Picture| picture.rgb.iter().map(|v| f32::from(*v) / 255.0).collect::<Vec<f32>>();
    metrics::psnr(&unit(picture), &unit(&expected))
}

/// The splats as the viewer gets them.
fn quantised(splats: &Splats) -> Splats {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.spz");
    spz::write(&path, splats, spz::Version::V3).unwrap();
    spz::read(&path).unwrap()
}

/// The smallest PSNR of the pictures of some cameras, against the quantised splats and against the splats, dB.
fn worst(browser: &Chromium, splats: &Splats, cameras: &[(usize, Camera)]) -> [f64; 2] {
    let renderers = [quantised(splats), splats.clone()].map(|splats| Renderer::new(&splats, 2));
    let [mut same, mut before] = renderers;
    cameras.iter().fold([f64::MAX; 2], |[a, b], (index, camera)| {
        let picture = picture(browser, *index);
        [a.min(psnr(&picture, &same.render(camera))), b.min(psnr(&picture, &before.render(camera)))]
    })
}

#[test]
fn the_viewer_draws_what_the_cpu_renderer_draws() {
    let Some(browser) = Chromium::start([700, 600]) else { return };
    let folder = tempfile::tempdir().unwrap();
    ply::write(&folder.path().join("global.ply"), &model(), &LocalFrame::WORLD).unwrap();
    camera_list::write(&folder.path().join("cameras.json"), &cameras()).unwrap();
    let (_program, url) = serve(folder.path(), folder.path());
    browser.open(&url);
    let listed: Vec<(usize, Camera)> = cameras().into_iter().enumerate().collect();
    let [same, before] = worst(&browser, &model(), &listed);
    assert!(same > SAME_SPLATS_DB && before > BEFORE_QUANTISING_DB, "{same} dB, {before} dB");
    depths_are_those_of_the_renderer(&browser);
    keys_move_the_camera(&browser);
    areas_and_profiles_are_those_of_the_ground(&browser);
    layers_of_photographs_count_what_these_show(&browser);
    assert_eq!(browser.complaints(), [""; 0]);
}

/// Picks points of a picture and compares their depths.
fn depths_are_those_of_the_renderer(browser: &Chromium) {
    let expected = Renderer::new(&quantised(&model()), 2).render(&cameras()[0]);
    let points: Vec<[u32; 2]> = (0..6).map(|i| [20 + 35 * i, 60 + 15 * i]).collect();
    let picks = format!(
        "cosurf.then(async ({{drawing, scene}}) => {{ const camera = scene.cameras[0]; \
         while (!(await drawing.sort(camera))); \
         return {points:?}.map(([x, y]) => drawing.depthAt(camera, [x + 0.5, y + 0.5])); }})"
    );
    let depths = browser.value(&picks);
    for ([x, y], depth) in points.iter().zip(depths.as_array().unwrap()) {
        let wanted = f64::from(expected.depth[(y * 240 + x) as usize]);
        let got = depth.as_f64().unwrap_or(0.0);
        assert!((got - wanted).abs() <= DEPTH_SHARE * wanted, "{x} {y}: {got} instead of {wanted}");
    }
    assert!(expected.depth.iter().any(|depth| *depth > 0.0));
}

/// A key turns the view; the buttons tell their state; a measurement tells a distance.
fn keys_move_the_camera(browser: &Chromium) {
    let press = |key: &str| {
        let script = format!(
            "cosurf.then((viewer) => {{ const before = viewer.walk.yaw; \
             viewer.canvas.dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}})); \
             return [viewer.walk.yaw - before, \
             viewer.section.querySelector('[data-does=measure]').getAttribute('aria-pressed')]; }})"
        );
        browser.value(&script)
    };
    assert!(press("ArrowLeft")[0].as_f64().unwrap() < 0.0 && press("ArrowRight")[0].as_f64().unwrap() > 0.0);
    assert_eq!(press("m")[1], "true");
    let told = browser.value(
        "cosurf.then(async (viewer) => { const {clientWidth: w, clientHeight: h} = viewer.canvas; \
         await viewer.pick([0.4 * w, 0.5 * h]); await viewer.pick([0.6 * w, 0.5 * h]); \
         return viewer.told.textContent; })",
    );
    let told = told.as_str().unwrap();
    assert!(told.starts_with("distance ") && told.contains("height difference"), "{told}");
}

/// The area of a polygon, and the heights along a line, against the ground that the splats lie on.
fn areas_and_profiles_are_those_of_the_ground(browser: &Chromium) {
    let told = browser.value(
        "cosurf.then(async (viewer) => { viewer.does('area'); \
         viewer.points = [[0, 0, 0], [10, 0, 5], [10, 8, -5], [0, 8, 0]]; await viewer.describe(); \
         const area = viewer.told.textContent; viewer.does('profile'); \
         viewer.points = [[-20, 3, 0], [20, 3, 0]]; await viewer.describe(); \
         const path = viewer.section.querySelector('.chart path').getAttribute('d'); \
         return [area, viewer.told.textContent, path.length]; })",
    );
    assert!(told[0].as_str().unwrap().starts_with("area on the map 80.00 "), "{told}");
    let words: Vec<&str> = told[1].as_str().unwrap().split(' ').collect();
    let figure = |i: usize| words[i].parse::<f64>().unwrap();
    assert!((figure(2) - 40.0).abs() < 0.01, "{told}");
    // Along y = 3 the ground lies between -2.83 and 2.83; its splats are up to a metre wide.
    assert!((-3.6..-1.5).contains(&figure(6)) && (1.5..3.6).contains(&figure(8)), "{told}");
    assert!(told[2].as_u64().unwrap() > 500, "{told}");
}

/// The number of photographs that each splat is on, and the device of the one that shows it finest, against the cameras; then
/// the colours of both layers.
fn layers_of_photographs_count_what_these_show(browser: &Chromium) {
    let devices = "cosurf.then((viewer) => { viewer.scene.devices = ['a', 'b'].map((name, i) => ({name, color: [[20, 40, 200], [198, 47, 73]][i], \
                   arrived_s: Date.now() / 1000 - [100, 200000][i]})); \
                   viewer.scene.errors = {bounds_m: [0.01, 0.02, 0.05, 0.1, 0.2, 0.5], classes: '5'.repeat(6000)}; \
                   viewer.scene.cameras.forEach((camera, i) => { camera.device = i >> 1; }); \
                   viewer.section.querySelectorAll('[data-value]').forEach((it) => { it.hidden = false; }); \
                   return viewer.drawing.sorter.marks(viewer.scene.cameras)\
                   .then(({counts, owners}) => [[...counts], [...owners]]); })";
    let marks = browser.value(devices);
    let splats = quantised(&model());
    let mut wrong = 0;
    for (i, mean) in splats.means.iter().enumerate() {
        let world = DVec3::from(mean.map(f64::from));
        let shown = cameras().into_iter().enumerate().filter_map(|(k, camera)| {
            let at = camera.cam_from_world.rotation * world + camera.cam_from_world.translation;
            let px = DVec2::new(at.x, at.y) / at.z * camera.focal_px + camera.center_px;
            let [width, height] = camera.size_px.map(f64::from);
            let is_in = at.z > 0.0 && px.min_element() >= 0.0 && px.x <= width && px.y <= height;
            is_in.then_some((at.z, k >> 1))
        });
        let shown: Vec<(f64, usize)> = shown.collect();
        let owner = shown.iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or(65535, |(_, device)| *device);
        let got = [0, 1].map(|part| marks[part][i].as_u64().unwrap() as usize);
        wrong += usize::from(got != [shown.len(), owner]);
    }
    // Some splats lie on the edge of a picture.
    assert!(wrong <= splats.len() / 200, "{wrong} of {}", splats.len());
    let layer = |layer: u32| {
        let middle = format!(
            "cosurf.then(async (viewer) => {{ viewer.does('layer', {layer}); await viewer.takeLayer({layer}); \
             const camera = viewer.scene.cameras[2]; await viewer.picture(camera, {layer}); \
             const gl = viewer.drawing.gl; const pixel = new Uint8Array(4); \
             gl.readPixels(120, 90, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); \
             return [[...pixel], viewer.section.querySelector('.legend').innerText, \
             viewer.section.querySelector('[data-value=\"{layer}\"]').getAttribute('aria-pressed')]; }})"
        );
        browser.value(&middle)
    };
    let (confidence, owner, age, error, colour) = (layer(3), layer(4), layer(5), layer(6), layer(0));
    assert!(confidence[1].as_str().unwrap().contains("16 or more"), "{confidence}");
    assert!(owner[1].as_str().unwrap().starts_with("a\nb\n") && owner[2] == "true", "{owner}");
    assert_eq!(colour[1], "", "{colour}");
    // The middle of the third picture is on all four, and the fourth, of b, is the nearest.
    // The pixel is darker where the splats leave some of the background.
    let is_of = |layer: &serde_json::Value, color: [f64; 3]| {
        let pixel = [0, 1, 2].map(|k| layer[0][k].as_f64().unwrap());
        let [most, of] = [pixel, color].map(|rgb| rgb.into_iter().fold(0.0, f64::max));
        assert!(pixel.iter().zip(color).all(|(v, c)| (v / most - c / of).abs() < 0.08), "{color:?}: {layer}");
    };
    is_of(&owner, [198.0, 47.0, 73.0]);
    is_of(&confidence, [33.0, 145.0, 140.0]);
    // 55 hours, and between 20 and 50 cm.
    is_of(&age, [33.0, 145.0, 140.0]);
    is_of(&error, [214.0, 69.0, 56.0]);
    assert!(age[1].as_str().unwrap().contains("less than a week"), "{age}");
    assert!(error[1].as_str().unwrap().contains("less than 50 cm"), "{error}");
}

/// The model of a mission or another folder with cameras, which the variable `VIEWER_MODEL` names.
#[test]
#[ignore = "needs a model: VIEWER_MODEL=DIR"]
fn the_viewer_draws_a_mission() {
    let folder = PathBuf::from(var_os("VIEWER_MODEL").expect("VIEWER_MODEL names the folder of a model"));
    let browser = Chromium::start([700, 600]).expect("chromedriver");
    let cameras = Dataset::cameras(&folder).unwrap();
    let frame = LocalFrame::of(cameras.iter());
    let splats = ply::read(&ply::of_model(&folder).unwrap(), &frame).unwrap();
    let logs = tempfile::tempdir().unwrap();
    let (_program, url) = serve(logs.path(), &folder.canonicalize().unwrap());
    browser.open(&url);
    let listed: Vec<(usize, Camera)> =
        cameras.iter().map(|camera| frame.local_camera(camera)).enumerate().step_by(12).collect();
    let [same, before] = worst(&browser, &splats, &listed);
    println!("{} cameras: at least {same:.2} dB, {before:.2} dB before quantising", listed.len());
    assert!(same > SAME_SPLATS_DB && before > BEFORE_QUANTISING_DB);
}
