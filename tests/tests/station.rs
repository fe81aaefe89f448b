//! The operator's page of a running service, in a headless browser and under load: it follows devices and revisions, says
//! that the aggregator has stopped, finds it again, and is usable by keyboard, on a phone, and in dark colours.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use cosurf_contract::{AgentPhase, AgentStatus};
use cosurf_link::{MqttTransport, Outgoing, PublishError, Transport};
use cosurf_tests::axe::Axe;
use cosurf_tests::chromium::{Chromium, decode_base64};
use cosurf_tests::running::{PATIENCE, Running};
use cosurf_tests::site::{Site, await_log, await_page};
use cosurf_tests::usage::peak_bytes;
use cosurf_tests::wide_ground::write_models;
use cosurf_wire::{DeviceId, SiteId, Topic};

/// The aggregator says every 5 s that it lives, and the page waits for 12 s.
const LOST_WITHIN: Duration = Duration::from_secs(60);

/// Publishes the status of a device as its agent would.
fn tell(transport: &mut MqttTransport, device: &str, step: u32) {
    let status = AgentStatus {
        phase: AgentPhase::Training,
        step,
        psnr: Some(20.0 + step as f32 / 100.0),
        ..AgentStatus::new(1000, "0.1.0")
    };
    let topic = Topic::Status { device: DeviceId::new(device).unwrap() };
    let topic = topic.to_text(&SiteId::new("site").unwrap());
    let message = Outgoing { topic, payload: serde_json::to_vec(&status).unwrap(), retain: true };
    while transport.publish(&message) == Err(PublishError::Busy) {
        transport.poll(Duration::from_millis(1));
    }
}

#[test]
fn the_page_follows_a_site_and_finds_it_again() {
    let Some(browser) = Chromium::start([1100, 900]) else { return };
    let site = Site::at_once();
    let program = site.start();
    browser.open(&program.page());
    let mut client = site.client();
    tell(&mut client, "drone-1", 17);
    let shown = "document.querySelector('#devices').innerText.includes('17 of 1000')";
    let progress = await_page(&browser, shown, PATIENCE);
    site.upload("drone-1", 1, 2000);
    await_log(&program, "global model, revision 1");
    let model = await_page(&browser, "document.body.dataset.revision === '1'", PATIENCE);
    let begun = Instant::now();
    assert_eq!(browser.value("cosurf.then((viewer) => viewer.scene.splats > 100)"), true);
    println!("first progress after {progress:.1?}, model after {:.1?}", model + begun.elapsed());
    await_page(&browser, "document.querySelectorAll('#map polygon').length === 3", PATIENCE);
    revisions_are_compared(&browser, &site, &program);
    the_operator_acts(&browser, &site);
    an_older_revision_is_restored(&browser, &site, &program);
    a_device_is_withdrawn(&browser, &site, &program);
    a_device_is_revoked(&browser, &site, &program);
    everything_is_reached_by_keyboard(&browser);
    assert_eq!(browser.complaints(), [""; 0]);
    drop((program, client));
    browser.run("scrollTo(0, document.documentElement.scrollHeight)");
    await_page(&browser, "!document.querySelector('#lost').hidden", LOST_WITHIN);
    assert!(browser.holds("scrollY > 300"), "the page is long enough to scroll");
    let is_seen = "(({top, bottom}) => top >= 0 && bottom <= innerHeight)\
                   (document.querySelector('#lost').getBoundingClientRect())";
    assert!(browser.holds(is_seen), "the banner is in the window");
    fs::remove_file(site.folder.path().join("cosurf-aggregator.log")).unwrap();
    let _again = site.start();
    let found = "document.querySelector('#lost').hidden && document.querySelector('#devices').innerText.includes('drone-1')";
    await_page(&browser, found, LOST_WITHIN);
}

/// The printed address of a page for all networks can be opened.
#[test]
fn a_page_for_all_networks_is_printed_as_addresses_that_open() {
    let site = Site::at_once();
    let folder = site.folder.path();
    let program = Running::start("cosurf-aggregator", folder, &["run", "--http", "0.0.0.0:0"]);
    program.page();
    sleep(Duration::from_millis(200)); // for further lines
    let log = program.log();
    let urls: Vec<&str> = log.lines().filter_map(|line| line.strip_prefix("http://")).collect();
    assert!(urls.last().unwrap().starts_with("127.0.0.1:"), "{log}");
    for url in urls {
        let (host, rest) = url.split_once('/').unwrap();
        let address: SocketAddr = host.parse().unwrap();
        assert!(!address.ip().is_unspecified() && rest.starts_with("?token="), "{log}");
        let answer = read(address, &format!("/{rest}"), Duration::ZERO, |_| false);
        assert!(answer.starts_with(b"HTTP/1.1 303"), "{}", String::from_utf8_lossy(&answer));
    }
}

/// The page of a mission shows the first progress within two seconds of the first event, and the merged model within five of
/// its revision, as the browser gets it.
#[test]
fn the_page_of_a_mission_shows_progress_and_model_in_time() {
    let Some(browser) = Chromium::start([1100, 900]) else { return };
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data").display().to_string();
    let town = ["town", &data, "--size", "96", "--views", "48"];
    let (has_town, log) = Running::start("cosurf-aggregator", folder.path(), &town).end();
    assert!(has_town, "{log}");
    let mission = ["mission", "--data", &data, "--agents", "2", "--steps", "300", "--http", "127.0.0.1:0"];
    let program = Running::start("cosurf-aggregator", folder.path(), &mission);
    browser.open(&program.page());
    let page: SocketAddr = program.page().split('/').nth(2).unwrap().parse().unwrap();
    let state = || String::from_utf8_lossy(&read(page, "/api/state", Duration::ZERO, |_| false)).into_owned();
    let begun = Instant::now();
    while !state().contains("\"phase\":") {
        assert!(begun.elapsed() < PATIENCE);
        sleep(Duration::from_millis(20));
    }
    let progress = await_page(&browser, "document.querySelector('#devices progress')", PATIENCE);
    while !state().contains("\"revision\":{") {
        assert!(begun.elapsed() < PATIENCE);
        sleep(Duration::from_millis(20));
    }
    let merged = Instant::now();
    await_page(&browser, "document.body.dataset.revision === '1'", PATIENCE);
    assert_eq!(browser.value("cosurf.then((viewer) => viewer.scene.splats > 100)"), true);
    let model = merged.elapsed();
    println!("first progress after {progress:.1?}, model after {model:.1?}");
    assert!(progress < Duration::from_secs(2) && model < Duration::from_secs(5), "{progress:?} {model:?}");
    let devices = browser.value("cosurf.then((viewer) => viewer.scene.devices.map(({name}) => name))");
    assert_eq!(devices, serde_json::json!(["agent-1", "agent-2"]));
    let (has_flown, log) = program.end();
    assert!(has_flown, "{log}");
    the_report_names_no_folder(&browser, folder.path());
}

/// A client gets the report, also its part for engineers: where the files of the mission were is nobody's business.
fn the_report_names_no_folder(browser: &Chromium, folder: &Path) {
    browser.open(&format!("file://{}", folder.join("out/report.html").display()));
    let whole = "document.documentElement.outerHTML";
    assert!(browser.holds(&format!("{whole}.includes('2 agents over')")), "the engineers' part is there");
    let name = folder.file_name().unwrap().to_str().unwrap();
    assert!(browser.holds(&format!("!{whole}.includes('{name}')")), "{name} is in the report");
}

/// A second revision is offered, and the first one can be seen beside it.
fn revisions_are_compared(browser: &Chromium, site: &Site, program: &Running) {
    site.upload("drone-1", 2, 2500);
    await_log(program, "global model, revision 2");
    await_page(browser, "!document.querySelector('#newer').hidden", PATIENCE);
    browser.run("document.querySelector('#newer').click()");
    await_page(browser, "document.body.dataset.revision === '2'", PATIENCE);
    let told = browser.value("cosurf.then((viewer) => viewer.compare().then(() => viewer.told.textContent))");
    assert!(told.as_str().unwrap().contains("revision 1"), "{told}");
    assert!(browser.holds("!document.querySelector('.before').hidden"));
    // Both revisions are of one device, in whose colour the layer of owners shows them.
    let shares = browser.value(
        "cosurf.then(async (viewer) => { const {scene, comparison} = viewer; \
         for (const its of [scene, comparison.scene]) { const {arrived_s} = its.devices[0]; \
           if (!(Math.abs(Date.now() / 1000 - arrived_s) < 600)) throw new Error(`it arrived at ${arrived_s}`); } \
         const color = scene.devices[0].color; const brightest = Math.max(...color); \
         const share = ({gl}) => { const [width, height] = [gl.canvas.width, gl.canvas.height]; \
           const pixels = new Uint8Array(4 * width * height); \
           gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels); let [lit, its] = [0, 0]; \
           for (let i = 0; i < pixels.length; i += 4) { const pixel = pixels.subarray(i, i + 3); \
             const bright = Math.max(...pixel); if (bright < brightest / 4) continue; lit++; \
             if (color.every((value, k) => Math.abs(pixel[k] / bright - value / brightest) < 0.1)) its++; } \
           return its / lit; }; \
         const camera = viewer.walk.camera([300, 200]); const result = []; \
         for (const layer of [0, 4]) { viewer.section.querySelector('[data-value=\"4\"]').hidden = false; \
           await viewer.takeLayer(layer); viewer.show(camera); await comparison.show(camera, 0); \
           await viewer.drawing.sort(camera); viewer.drawing.draw(camera, 0); \
           result.push([viewer.drawing, comparison.drawing].map(share)); } \
         await viewer.takeLayer(0); return result; })",
    );
    let [[now_0, before_0], [now_4, before_4]] =
        [0, 1].map(|layer| [0, 1].map(|side| shares[layer][side].as_f64().unwrap()));
    assert!(now_0 < 0.5 && before_0 < 0.5 && now_4 > 0.9 && before_4 > 0.9, "{shares}");
}

/// Acts as the page's buttons do, and finds the action in the record.
fn the_operator_acts(browser: &Chromium, site: &Site) {
    browser.run("document.querySelector('#merge').click()");
    await_page(browser, "document.querySelector('#answer').textContent === 'Done.'", PATIENCE);
    let record = fs::read_to_string(site.folder.path().join("out/actions.jsonl")).unwrap();
    assert!(record.contains("\"action\":\"merge now\"") && record.contains("127.0.0.1"), "{record}");
}

/// Restores the first of two revisions, which stays until the operator asks for a merge.
fn an_older_revision_is_restored(browser: &Chromium, site: &Site, program: &Running) {
    let summary = |text: &str| format!("document.querySelector('#summary').textContent.includes('{text}')");
    await_page(browser, "document.querySelector('#restore-revision').value === '1'", PATIENCE);
    browser.run("window.confirm = () => false; document.querySelector('#restore').click()");
    browser.run("window.confirm = () => true; document.querySelector('#restore').click()");
    await_log(program, "revision 3 repeats revision 1");
    await_page(browser, &summary("it repeats revision 1"), PATIENCE);
    site.upload("drone-1", 3, 2500);
    await_page(browser, "document.querySelector('#devices').innerText.includes('3')", PATIENCE);
    // The list tells what each revision is, newest first. Times are of today, in the browser's words.
    await_page(browser, "document.querySelectorAll('#restore-revision option').length === 2", PATIENCE);
    let listed = "[...document.querySelectorAll('#restore-revision option')].map((it) => it.textContent)";
    let listed = browser.value(listed);
    let year = browser.value("new Date().toLocaleString(undefined, {dateStyle: 'medium'})");
    for (i, number) in [2, 1].into_iter().enumerate() {
        let record = fs::read(site.folder.path().join(format!("out/revisions/{number}.json"))).unwrap();
        let record: serde_json::Value = serde_json::from_slice(&record).unwrap();
        let splats = &record["summary"]["splats"];
        let is_it = |text: &str| {
            text.starts_with(&format!("{number} · {}", year.as_str().unwrap()))
                && text.ends_with(&format!(" · 1 model · {splats} splats"))
        };
        assert!(listed[i].as_str().is_some_and(is_it), "{number}: {listed}");
    }
    browser.run("document.querySelector('#merge').click()");
    await_log(program, "global model, revision 4");
    let repeats = "[...document.querySelectorAll('#restore-revision option')].some((it) => \
                   it.textContent.startsWith('3 ·') && it.textContent.endsWith('repeats revision 1'))";
    await_page(browser, repeats, PATIENCE);
    await_page(browser, &format!("!{}", summary("it repeats")), PATIENCE);
    let record = fs::read_to_string(site.folder.path().join("out/actions.jsonl")).unwrap();
    assert_eq!(record.matches("\"restore revision 1\",\"outcome\":\"done\"").count(), 1, "{record}");
}

/// Forgets a device, which is then no active one in the table and in the choices, until it sends another model.
fn a_device_is_withdrawn(browser: &Chromium, site: &Site, program: &Running) {
    site.upload("drone-3", 1, 2200);
    await_log(program, "from 2 models");
    let of_device =
        "[...document.querySelectorAll('#devices tr')].find((row) => row.innerText.includes('drone-3'))";
    let chosen =
        "[...document.querySelectorAll('#forget-device option')].find((it) => it.value === 'drone-3')";
    await_page(browser, &format!("{chosen}?.textContent === 'drone-3'"), PATIENCE);
    browser.run("document.querySelector('#forget-device').value = 'drone-3'; document.querySelector('#forget').click()");
    await_log(program, "drone-3 is withdrawn");
    await_page(browser, &format!("{of_device}?.innerText.includes('withdrawn')"), PATIENCE);
    assert!(browser.holds(&format!("{of_device}.className === 'silent'")));
    assert!(browser.holds(&format!("{chosen}.textContent === 'drone-3 (withdrawn)'")));
    assert!(
        browser.holds("document.querySelector('#forget-device').value === 'drone-3'"),
        "the choice stays"
    );
    site.upload("drone-3", 2, 2300);
    await_page(browser, &format!("{chosen}?.textContent === 'drone-3'"), PATIENCE);
    assert!(!browser.holds(&format!("{of_device}.innerText.includes('withdrawn')")));
}

/// Revokes a device that only tells how far it is. It says so, and is heard no more.
fn a_device_is_revoked(browser: &Chromium, site: &Site, program: &Running) {
    tell(&mut site.client(), "drone-2", 5);
    let has_row = "document.querySelector('#devices').innerText.includes('drone-2')";
    await_page(browser, has_row, PATIENCE);
    browser.run(
        "document.querySelector('#forget-device').value = 'drone-2'; document.querySelector('#revoke').click()",
    );
    await_log(program, "drone-2 is revoked");
    await_page(browser, "document.querySelector('#devices').innerText.includes('revoked')", PATIENCE);
    tell(&mut site.client(), "drone-2", 400);
    tell(&mut site.client(), "drone-1", 500);
    await_page(browser, "document.querySelector('#devices').innerText.includes('500 of 1000')", PATIENCE);
    assert!(!browser.holds("document.querySelector('#devices').innerText.includes('400 of 1000')"));
    let revoke = site.folder.path().join("out/revoked/drone-2");
    assert!(revoke.is_file());
}

/// Goes through the page with the Tab key.
fn everything_is_reached_by_keyboard(browser: &Chromium) {
    let elements = "[...document.querySelectorAll('button, select, input, a[href], [tabindex=\"0\"]')]\
                    .filter((it) => it.checkVisibility())";
    let count = browser.value(&format!("{elements}.length")).as_u64().unwrap();
    assert!(count > 15, "{count}");
    for _ in 0..count + 5 {
        browser.press_tab();
        browser.run("document.activeElement.dataset.reached = 'yes'");
    }
    let missed =
        browser.value(&format!("{elements}.filter((it) => !it.dataset.reached).map((it) => it.outerHTML)"));
    assert_eq!(missed, serde_json::json!([]));
}

#[test]
fn pages_have_no_serious_fault_on_any_screen() {
    let Some(browser) = Chromium::start([1100, 900]) else { return };
    let Some(axe) = Axe::installed() else { return };
    let site = Site::at_once();
    let program = site.start();
    // A device without a model comes first in the tables.
    tell(&mut site.client(), "a-drone", 5);
    tell(&mut site.client(), "drone-1", 17);
    site.upload("drone-1", 1, 2000);
    site.upload("drone-2", 1, 2100);
    // As long as a name can be.
    site.upload(&"a-very-long-name".repeat(4), 1, 2200);
    await_log(&program, "from 3 models");
    let revision = program.log().lines().find_map(|line| {
        let (revision, rest) = line.split_once("global model, revision ")?.1.split_once(':')?;
        rest.contains("from 3 models").then(|| revision.to_owned())
    });
    await_log(&program, &format!("report.html shows revision {}", revision.unwrap()));
    let out = site.folder.path().join("out");
    let viewer = Running::start("cosurf-aggregator", &out, &["view", "."]);
    let pages = [
        ("live", program.page()),
        ("report", format!("file://{}/report.html", out.display())),
        ("viewer", viewer.page()),
    ];
    for (name, url) in &pages {
        for (width_px, is_dark) in [(1100, false), (1100, true), (390, false), (390, true)] {
            browser.look(width_px, is_dark);
            browser.open(url);
            // With the layer of the owners, whose legend names both devices, although another one was asked for just before.
            let legend = "cosurf.then(async (viewer) => { \
                          await Promise.all([3, 4].map((layer) => viewer.takeLayer(layer))); \
                          return viewer.section.querySelector('.legend').innerText; })";
            let legend = browser.value(legend).to_string();
            assert!(legend.contains("drone-1") && legend.contains("drone-2"), "{name}: {legend}");
            if *name == "live" {
                await_page(&browser, "document.querySelector('#devices td')", PATIENCE);
            }
            devices_have_their_colours(&browser, name);
            keep(&browser, &format!("{name}-{width_px}-{}", if is_dark { "dark" } else { "light" }));
            assert_eq!(axe.faults(&browser), [""; 0], "{name}, {width_px} px wide, dark: {is_dark}");
            // Not `innerWidth`, which grows with what does not fit.
            let is_wide = format!("document.documentElement.scrollWidth > {width_px}");
            assert!(!browser.holds(&is_wide), "{name} is wider than {width_px} px");
        }
    }
}

/// A device has the same colour in the legend of the model as in the tables and on the map of a page.
fn devices_have_their_colours(browser: &Chromium, page: &str) {
    let colors = browser.value(
        "(() => { const of = (it) => getComputedStyle(it).backgroundColor; const colors = {}; \
         const add = (name, color) => (colors[name] ??= []).push(color); \
         document.querySelectorAll('.legend li').forEach((it) => add(it.innerText, of(it.firstChild))); \
         document.querySelectorAll('.dot').forEach((it) => add(it.parentElement.innerText, of(it))); \
         document.querySelectorAll('#map text').forEach((it) => it.previousSibling?.tagName === 'circle' \
           && add(it.textContent, getComputedStyle(it.previousSibling).fill)); \
         return ['drone-1', 'drone-2'].map((name) => colors[name]); })()",
    );
    let [one, other] = [0, 1].map(|i| colors[i].as_array().unwrap());
    // The legend; the table, which the page of one model lacks; and the map, which only the live page has.
    let places = match page {
        "live" => 3,
        "report" => 2,
        _ => 1,
    };
    assert_eq!([one.len(), other.len()], [places; 2], "{page}: {colors}");
    assert!(
        one.iter().all(|color| *color == one[0]) && other.iter().all(|color| *color == other[0]),
        "{colors}"
    );
    assert_ne!(one[0], other[0]);
}

/// Keeps a picture of the page for people to look at.
fn keep(browser: &Chromium, name: &str) {
    let folder: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("target/screens");
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join(format!("{name}.png")), decode_base64(&browser.whole_page())).unwrap();
}

const DEVICES: usize = 200;
const READERS: usize = 50;
/// Steps that each device tells, one after the other.
const STEPS: u32 = 20;
/// Largest state of 200 devices, bytes.
const STATE_BYTES_MAX: usize = 300_000;
/// What the program may take beside uploads and merges, of which there are none here, bytes.
const CROWD_BYTES_MAX: u64 = 160 << 20;

/// The answer of a request, up to `bytes_max`, or to the first part that satisfies `is_over`.
fn read(page: SocketAddr, path: &str, pause: Duration, is_over: impl Fn(&[u8]) -> bool) -> Vec<u8> {
    let mut stream = TcpStream::connect(page).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes()).unwrap();
    sleep(pause);
    let (mut text, mut part) = (Vec::new(), vec![0; 64 << 10]);
    loop {
        let count = stream.read(&mut part).unwrap();
        text.extend_from_slice(&part[..count]);
        if count == 0 || is_over(&text) {
            return text;
        }
    }
}

fn contains(text: &[u8], part: &str) -> bool {
    text.windows(part.len()).any(|window| window == part.as_bytes())
}

/// Many devices tell how far they are while many readers follow. A reader gets changes, not whole states; one that does not
/// read for seconds gets what it has missed in few events.
#[test]
fn two_hundred_devices_and_fifty_readers() {
    let site = Site::at_once();
    let program = site.start();
    program.page();
    let mut client = site.client();
    let last = format!("\"device\":\"drone-{}\"", DEVICES - 1);
    let whole = thread::scope(|scope| {
        // The log is at the end of an event.
        let is_over =
            |text: &[u8]| contains(&text[text.len().saturating_sub(8192)..], "the model of last arrived");
        let page = site.page;
        let follow = move |pause| read(page, "/api/events", pause, is_over);
        let readers: Vec<_> = (0..READERS).map(|_| scope.spawn(move || follow(Duration::ZERO))).collect();
        let slow = scope.spawn(move || follow(Duration::from_secs(4)));
        for step in 1..=STEPS {
            (0..DEVICES).for_each(|i| tell(&mut client, &format!("drone-{i}"), step));
        }
        let newest = format!("\"step\":{STEPS},");
        let begun = Instant::now();
        let whole = loop {
            let whole = read(site.page, "/api/state", Duration::ZERO, |_| false);
            let text = String::from_utf8_lossy(&whole).into_owned();
            if text.contains(&last) && text.matches(&newest).count() == DEVICES {
                break whole;
            }
            assert!(begun.elapsed() < PATIENCE, "{text}");
            sleep(Duration::from_millis(100));
        };
        site.upload("last", 1, 300);
        let bytes: Vec<usize> = readers.into_iter().map(|reader| reader.join().unwrap().len()).collect();
        let events = |text: &[u8]| String::from_utf8_lossy(text).matches("event: state").count();
        let slow = slow.join().unwrap();
        println!("a reader got {} bytes, a slow one {} events", bytes[0], events(&slow));
        whole
    });
    let peak = peak_bytes(program.process()).unwrap();
    println!("state {} bytes, peak {} MiB", whole.len(), peak >> 20);
    assert!(whole.len() < STATE_BYTES_MAX && peak < CROWD_BYTES_MAX, "{} {peak}", whole.len());
}

/// Pairs of merges that are compared, one without and one with the page.
const PAIRS: usize = 5;
/// Models of 102,400 splats that are merged side by side: some 10 s on two cores.
const MERGED: usize = 8;
/// Their distance: the ground of each is 96 m wide, metres.
const MERGED_PITCH_M: f32 = 93.0;
/// What the page may add to the duration of a merge, a share of it.
const DELAY_MAX: f64 = 0.05;

/// How long the merge of some models takes, seconds, while a crowd of devices tell how far they are; with a page, beside a crowd
/// of readers as well.
fn merge_s(has_page: bool) -> f64 {
    // Readers are there before the merge begins.
    let site = Site::with("frame = \"site\"\nquorum = 1\nquiet_s = 3\nrefine = false\n");
    let corners: Vec<[f32; 2]> = (0..MERGED).map(|i| [MERGED_PITCH_M * i as f32, 0.0]).collect();
    write_models(&site.folder.path().join("out"), &corners, 1);
    let program = if has_page { site.start() } else { site.start_without_page() };
    let mut client = site.client();
    (0..DEVICES).for_each(|i| tell(&mut client, &format!("drone-{i}"), 1));
    let is_merged = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !is_merged.load(Ordering::Relaxed) {
                // As often as 200 agents do, each every five seconds.
                (0..DEVICES).for_each(|i| {
                    tell(&mut client, &format!("drone-{i}"), 2);
                    sleep(Duration::from_millis(25));
                });
            }
        });
        if has_page {
            assert!(program.page().contains(&site.page.to_string()));
            let is_over = |text: &[u8]| contains(&text[text.len().saturating_sub(8192)..], "global model");
            let page = site.page;
            (0..READERS)
                .for_each(|_| _ = scope.spawn(move || read(page, "/api/events", Duration::ZERO, is_over)));
        }
        await_log(&program, &format!("from {MERGED} models"));
        is_merged.store(true, Ordering::Relaxed);
    });
    let record = fs::read(site.folder.path().join("out/merged.json")).unwrap();
    serde_json::from_slice::<serde_json::Value>(&record).unwrap()["seconds"].as_f64().unwrap()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Both kinds take turns, so that whatever slows the computer down for a while slows both.
#[test]
#[ignore = "measures for minutes, on a computer that does nothing else"]
fn a_merge_beside_the_page() {
    let mut times: Vec<[f64; 2]> = Vec::new();
    for i in 0..PAIRS {
        let order = if i % 2 == 0 { [false, true] } else { [true, false] };
        let mut pair = [0.0; 2];
        order.into_iter().for_each(|has_page| pair[usize::from(has_page)] = merge_s(has_page));
        println!(
            "merge {:.2} s, beside the page {:.2} s: {:+.1} %",
            pair[0],
            pair[1],
            100.0 * (pair[1] / pair[0] - 1.0)
        );
        times.push(pair);
    }
    let [without, with] = [0, 1].map(|kind| median(times.iter().map(|pair| pair[kind])));
    let [least, most] = [f64::min, f64::max].map(|of| times.iter().map(|pair| pair[0]).reduce(of).unwrap());
    let delay = with / without - 1.0;
    println!(
        "medians of {PAIRS}: {without:.2} s, beside the page {with:.2} s: {:+.1} %; without the page {least:.2} to {most:.2} s",
        100.0 * delay
    );
    assert!(without > 8.0, "a merge of {without:.2} s is too short to tell {DELAY_MAX}");
    assert!(most < (1.0 + 2.0 * DELAY_MAX) * least, "this computer does something else: {times:?}");
    assert!(delay <= DELAY_MAX, "{times:?}");
}
