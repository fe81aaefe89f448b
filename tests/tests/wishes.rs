//! What the operator asks for in the page is done in the order of the requests, and once it is answered it outlasts a kill.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;

use cosurf_tests::running::Running;
use cosurf_tests::site::{Site, await_log};

/// A running site with two revisions.
fn site_with_two_revisions() -> (Site, Running) {
    let site = Site::at_once();
    let program = site.start();
    for number in 1..=2 {
        site.upload("drone-1", number, 2000 + 100 * number as usize);
        await_log(&program, &format!("global model, revision {number}"));
    }
    (site, program)
}

/// Sends a request with the token that the program has printed. Returns the answer.
fn ask(program: &Running, request: &str, body: &str) -> String {
    let page = program.page();
    let (address, token) = page.trim_start_matches("http://").split_once("/?token=").unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    let length = body.len();
    let text = format!(
        "{request} HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\nContent-Length: {length}\r\n\r\n{body}"
    );
    stream.write_all(text.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// Asks for an action that must be accepted.
fn act(program: &Running, path: &str, body: &str) {
    let answer = ask(program, &format!("POST {path}"), body);
    assert!(answer.starts_with("HTTP/1.1 204"), "{path} {body}: {answer}");
}

/// Kills the program at once and starts it again, with a new log.
fn killed_and_started(site: &Site, program: Running) -> Running {
    drop(program);
    fs::remove_file(site.folder.path().join("cosurf-aggregator.log")).unwrap();
    site.start()
}

#[test]
fn a_merge_that_was_asked_for_is_made_before_a_restore_that_was_asked_for_later() {
    let (_site, program) = site_with_two_revisions();
    act(&program, "/api/restore", "{\"revision\": 1}");
    await_log(&program, "revision 3 repeats revision 1");
    act(&program, "/api/merge", "");
    act(&program, "/api/restore", "{\"revision\": 1}");
    // Before the merge, it would be revision 3 once more.
    await_log(&program, "revision 5 repeats revision 1");
}

#[test]
fn a_merge_that_was_answered_outlasts_a_kill() {
    let (site, program) = site_with_two_revisions();
    act(&program, "/api/restore", "{\"revision\": 1}");
    await_log(&program, "revision 3 repeats revision 1");
    act(&program, "/api/merge", "");
    let program = killed_and_started(&site, program);
    await_log(&program, "global model, revision 4");
    assert!(!program.log().contains("repeats"), "{}", program.log());
}

#[test]
fn a_device_that_was_forgotten_before_a_kill_is_told_as_withdrawn() {
    let (site, program) = site_with_two_revisions();
    site.upload("drone-2", 1, 2300);
    await_log(&program, "from 2 models");
    act(&program, "/api/forget", "{\"device\": \"drone-2\"}");
    let program = killed_and_started(&site, program);
    await_log(&program, "from 1 model");
    let state = ask(&program, "GET /api/state", "");
    let drone = state.split("{\"device\":\"drone-2\"").nth(1).unwrap();
    assert!(drone.split("{\"device\"").next().unwrap().contains("\"is_withdrawn\":true"), "{state}");
    assert!(program.log().contains("drone-2 is withdrawn"), "{}", program.log());
}
