//! The layers of the viewer on the operator's page, in a headless browser: they go on while revisions come, and what is told
//! and listed is of what is seen.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use cosurf_link::Offer;
use cosurf_scene::splats::SH_C0;
use cosurf_scene::{Camera, LocalFrame, Pose, Splats, ply};
use cosurf_tests::chromium::Chromium;
use cosurf_tests::models::random_splats;
use cosurf_tests::running::{PATIENCE, Running};
use cosurf_tests::site::{Site, await_log, await_page};
use cosurf_wire::{DeviceId, ModelId, ModelKind};
use glam::{DVec2, DVec3};

const DEVICES: [&str; 3] = ["a", "drone-1", "drone-2"];

/// Numbers of the layers in the viewer.
const COLOUR: u32 = 0;
const CONFIDENCE: u32 = 3;
const OWNER: u32 = 4;

#[test]
fn layers_go_on_while_revisions_come() {
    let Some(browser) = Chromium::start([1100, 900]) else { return };
    let site = Site::at_once();
    let program = site.start();
    (0..DEVICES.len()).for_each(|place| site.send(strip(place, 1)));
    await_log(&program, "from 3 models");
    browser.open(&program.page());
    await_page(&browser, "document.querySelector('#map image')?.getAttribute('href')", PATIENCE);
    the_map_keeps_plain_colours(&browser, &site);
    what_is_told_goes_with_what_is_shown(&browser);
    the_legend_lists_devices_of_the_revision_before(&browser, &program);
    assert_eq!(browser.complaints(), [""; 0]);
}

/// Splats that cannot be drawn are not said to be left out for the sake of the page's size.
#[test]
fn broken_splats_are_told_as_such() {
    let Some(browser) = Chromium::start([600, 500]) else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut splats = random_splats(1, 300, 0);
    (0..7).for_each(|i| splats.means[40 * i][0] = f32::NAN);
    ply::write(&folder.path().join("broken.ply"), &splats, &LocalFrame::WORLD).unwrap();
    let program = Running::start("cosurf-aggregator", folder.path(), &["view", "broken.ply"]);
    browser.open(&program.page());
    let told = browser.value("cosurf.then(({told}) => told.textContent)");
    assert_eq!(told, "7 splats of the file cannot be shown: infinite or not a number.");
}

/// The model of a device, of flat ground beside that of the device before, which overlaps it.
fn strip(place: usize, number: u64) -> Offer {
    let west = 10.0 * place as f32;
    let mut splats = Splats::with_capacity(24 * 24, 0);
    for i in 0..24 * 24 {
        let (x, y) = (west + 0.5 * (i % 24) as f32, 0.5 * (i / 24) as f32);
        let shade = 0.5 + 0.3 * (0.7 * x).sin() * (0.5 * y + number as f32).cos();
        let sh = [shade, 0.6 * shade, 1.0 - shade].map(|value| (value - 0.5) / SH_C0);
        splats.push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], [-1.0, -1.0, -5.0], 4.0, &sh);
    }
    let above = |x: f64, y: f64| Camera {
        cam_from_world: Pose::look_at(DVec3::new(x, y, 12.0), DVec3::new(x, y, 0.0), DVec3::Y),
        focal_px: DVec2::splat(90.0),
        center_px: DVec2::new(72.0, 54.0),
        size_px: [144, 108],
    };
    let cameras: Vec<Camera> = (0..4)
        .map(|i| above(f64::from(west) + 4.0 * f64::from(i % 2 + 1), 4.0 * f64::from(i / 2 + 1)))
        .collect();
    let device = DeviceId::new(DEVICES[place]).unwrap();
    Offer::new(device, ModelId(number), ModelKind::Local, 4, &splats, &cameras).unwrap()
}

fn take_layer(browser: &Chromium, layer: u32) {
    browser.value(&format!("cosurf.then((viewer) => viewer.takeLayer({layer}).then(() => true))"));
}

/// The picture under the map is drawn again when a model arrives: in plain colours, whichever layer the viewer shows, which
/// keeps its own.
fn the_map_keeps_plain_colours(browser: &Chromium, site: &Site) {
    // All pictures that the page takes of the model; it takes none but those of the map.
    browser.value(
        "cosurf.then((viewer) => { globalThis.pictures = []; const its = viewer.picture; \
         viewer.picture = async (...given) => { const url = await its.apply(viewer, given); pictures.push(url); return url; }; \
         return true; })",
    );
    for (i, layer) in [COLOUR, CONFIDENCE, OWNER].into_iter().enumerate() {
        take_layer(browser, layer);
        site.send(strip(i, 2));
        await_page(browser, &format!("pictures.length === {}", i + 1), PATIENCE);
        let is_painted = browser.value("cosurf.then(({drawing}) => Boolean(drawing.paint))");
        assert_eq!(is_painted, layer != COLOUR, "the viewer's own colours, layer {layer}");
    }
    // Of the same model from the same place; 255 if a pixel of one is black and that of the other white.
    let apart = browser.value(
        "(async () => { const pixels = await Promise.all(pictures.map(async (url) => { \
           const image = new Image(); image.src = url; await image.decode(); \
           const canvas = new OffscreenCanvas(image.width, image.height); \
           const context = canvas.getContext('2d'); context.drawImage(image, 0, 0); \
           return context.getImageData(0, 0, image.width, image.height).data; })); \
         if (!pixels[0].some((value, i) => i % 4 < 3 && value > 60)) throw new Error(`the map is black: ${pixels[0].length} ${pixels.map((its) => its.reduce((most, value, i) => i % 4 < 3 ? Math.max(most, value) : most, 0))} ${pictures[0].length}`); \
         return pixels.map((its) => its.reduce((most, value, i) => Math.max(most, Math.abs(value - pixels[0][i])), 0)); })()",
    );
    let apart: Vec<f64> = apart.as_array().unwrap().iter().map(|most| most.as_f64().unwrap()).collect();
    assert!(apart.iter().all(|most| *most < 20.0), "the map is drawn in a layer's colours: {apart:?}");
}

/// What is told of a layer or of a photograph's view goes with it.
fn what_is_told_goes_with_what_is_shown(browser: &Chromium) {
    let told = || browser.value("cosurf.then(({told}) => told.textContent)").as_str().unwrap().to_owned();
    let does =
        |name: &str| _ = browser.value(&format!("cosurf.then((viewer) => (viewer.does('{name}'), true))"));
    take_layer(browser, CONFIDENCE);
    assert!(told().starts_with("On how many photographs"), "{}", told());
    take_layer(browser, COLOUR);
    assert_eq!(told(), "", "the layer has gone");
    does("photograph");
    assert!(told().starts_with("The view of photograph 1 of"), "{}", told());
    take_layer(browser, COLOUR);
    assert!(
        told().starts_with("The view of photograph 1 of"),
        "a layer without a line of its own takes none away"
    );
    does("reset");
    assert_eq!(told(), "", "the view has gone");
    does("measure");
    does("reset");
    assert!(told().starts_with("Tap points"), "a measurement goes on: {}", told());
    does("measure");
}

/// A device that was forgotten since is on the side of *Before*, and in the legend as long as that is shown.
fn the_legend_lists_devices_of_the_revision_before(browser: &Chromium, program: &Running) {
    browser.run("window.confirm = () => true; document.querySelector('#forget-device').value = 'a'");
    browser.run("document.querySelector('#forget').click()");
    await_log(program, "from 2 models");
    await_page(browser, "!document.querySelector('#newer').hidden", PATIENCE);
    await_page(browser, "document.querySelector('#summary').textContent.includes('of 2 models')", PATIENCE);
    browser.run("document.querySelector('#newer').click()");
    await_page(browser, "globalThis.cosurf && globalThis.pictures === undefined", PATIENCE);
    let legend = |before: &str| {
        let names = browser.value(&format!(
            "cosurf.then(async (viewer) => {{ await viewer.takeLayer({OWNER}); {before}; \
             return [...viewer.section.querySelectorAll('.legend li')].map((it) => it.textContent); }})"
        ));
        names.as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let newest = ["drone-1", "drone-2", "on no photograph"];
    assert_eq!(legend(""), newest);
    let both = legend("await viewer.compare()");
    assert_eq!(both, ["drone-1", "drone-2", "a", "on no photograph"]);
    assert_eq!(legend("await viewer.compare()"), newest, "Before is hidden again");
}
