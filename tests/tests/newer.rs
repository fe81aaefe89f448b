//! A page that shows one revision while newer ones come, in a headless browser.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use cosurf_tests::chromium::Chromium;
use cosurf_tests::running::{PATIENCE, Running};
use cosurf_tests::site::{Site, await_log, await_page};

/// The layer of depths, which every model has.
const DEPTH: u32 = 1;

#[test]
fn a_page_keeps_what_is_set_while_revisions_come() {
    let Some(browser) = Chromium::start([1100, 900]) else { return };
    let site = Site::at_once();
    let program = site.start();
    make_revisions(&site, &program, 1, 2);
    browser.open(&program.page());
    await_page(&browser, "document.body.dataset.revision === '2'", PATIENCE);
    browser.value("cosurf.then(() => true)");
    make_revisions(&site, &program, 3, 4);
    await_page(&browser, "document.querySelector('#newer').textContent === 'Show revision 4'", PATIENCE);
    let told = browser.value("cosurf.then((viewer) => viewer.compare().then(() => viewer.told.textContent))");
    assert_eq!(told, "Left of the border is revision 1, right of it revision 2.");
    browser.value(&format!(
        "cosurf.then(async (viewer) => {{ const border = document.querySelector('.slide input'); border.value = 30; \
         border.dispatchEvent(new Event('input')); viewer.walk.yaw = 1; await viewer.takeLayer({DEPTH}); return true; }})"
    ));
    browser.run("document.querySelector('#newer').click()");
    await_page(&browser, "document.body.dataset.revision === '4'", PATIENCE);
    let is_set = "document.querySelector('.told').textContent === 'Left of the border is revision 3, right of it revision 4.' \
                  && !document.querySelector('.before').hidden && document.querySelector('.slide input').value === '30'";
    await_page(&browser, is_set, PATIENCE);
    assert!(browser.holds(&format!(
        "document.querySelector('[data-value=\"{DEPTH}\"]').getAttribute('aria-pressed') === 'true'"
    )));
    let walk = browser.value("cosurf.then(({walk: {yaw}}) => yaw)");
    assert_eq!(walk, 1, "the camera stays");
    the_last_model_is_withdrawn(&browser, &program);
    assert_eq!(browser.complaints(), [""; 0]);
}

/// Uploads models of one device until the revisions with these numbers are there.
fn make_revisions(site: &Site, program: &Running, first: u64, last: u64) {
    for number in first..=last {
        site.upload("drone-1", number, 2000 + 100 * number as usize);
        await_log(program, &format!("global model, revision {number}"));
    }
}

/// Nothing is shown of a model that was withdrawn, and nothing leads to one.
fn the_last_model_is_withdrawn(browser: &Chromium, program: &Running) {
    browser.run("window.confirm = () => true; document.querySelector('#forget-device').value = 'drone-1'");
    browser.run("document.querySelector('#forget').click()");
    await_log(program, "the global model is removed");
    let is_gone = "document.body.dataset.revision === '' && !document.querySelector('.viewer') \
                   && document.querySelector('#newer').hidden \
                   && document.querySelector('#summary').textContent.includes('no global model')";
    await_page(browser, is_gone, PATIENCE);
}
