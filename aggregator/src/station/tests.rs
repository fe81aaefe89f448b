//! What strangers can do to the server, over sockets.
#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cosurf_contract::AgentStatus;
use cosurf_wire::DeviceId;

use super::*;

/// A request with these header lines and this body. Returns the answer, or what came of it.
fn ask(address: SocketAddr, line: &str, headers: &[&str], body: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let headers: String = headers.iter().map(|header| format!("{header}\r\n")).collect();
    let length = body.len();
    let request = format!("{line} HTTP/1.1\r\n{headers}Content-Length: {length}\r\n\r\n{body}");
    let _ = stream.write_all(request.as_bytes()); // the server may refuse before the end
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

fn status(answer: &str) -> u16 {
    answer.split_whitespace().nth(1).and_then(|text| text.parse().ok()).unwrap_or(0)
}

struct Site {
    server: Server,
    token: Token,
    board: Board,
    done: Arc<Mutex<Vec<Action>>>,
    folder: tempfile::TempDir,
}

impl Site {
    fn start(address: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (token, board) = (Token::random().unwrap(), Board::new(folder.path()));
        let done = Arc::new(Mutex::new(Vec::new()));
        let list = done.clone();
        let act: Act = Arc::new(move |action| {
            list.lock().unwrap().push(*action);
            Ok(())
        });
        let server = serve_site(address.parse().unwrap(), &token, board.clone(), Some(act)).unwrap();
        Self { server, token, board, done, folder }
    }

    fn address(&self) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], self.server.address().port()))
    }

    fn get(&self, path: &str) -> String {
        ask(self.address(), &format!("GET {path}"), &["Host: localhost"], "")
    }

    fn post(&self, path: &str, headers: &[&str], body: &str) -> u16 {
        let headers: Vec<&str> = ["Host: localhost"].iter().chain(headers).copied().collect();
        status(&ask(self.address(), &format!("POST {path}"), &headers, body))
    }
}

#[test]
fn only_the_operator_acts_and_every_action_is_logged() {
    let site = Site::start("127.0.0.1:0");
    let body = r#"{"device": "drone-1"}"#;
    let bearer = format!("Authorization: Bearer {}", site.token.as_str());
    assert_eq!(site.post("/api/forget", &[], body), 401);
    assert_eq!(site.post("/api/forget", &["Authorization: Bearer 0123456789abcdef"], body), 401);
    assert_eq!(site.post("/api/forget", &[&bearer, "Origin: http://evil.example"], body), 403);
    assert_eq!(site.post("/api/forget", &[&bearer], r#"{"device": "<b>"}"#), 400);
    // The answer may be lost, because the server closes the connection before it has read everything.
    assert_ne!(site.post("/api/forget", &[&bearer], &"x".repeat(100_000)), 204);
    assert_eq!(site.post("/api/merge", &[], ""), 401);
    assert_eq!(site.post("/api/merge", &[&bearer], "{}"), 400, "no body");
    assert_eq!(site.post("/api/merge", &[&bearer], &"x".repeat(5000)), 413);
    assert_eq!(site.post("/api/forget", &[&bearer], body), 404, "no device of the site");
    assert!(site.done.lock().unwrap().is_empty());
    site.board.note_status(DeviceId::new("drone-1").unwrap(), AgentStatus::new(1, "1"));
    assert_eq!(site.post("/api/forget", &[&bearer], body), 204);
    assert_eq!(site.post("/api/merge", &[&bearer], ""), 204);
    let forget = Action::Forget(DeviceId::new("drone-1").unwrap());
    let revoke = r#"{"device": "drone-2", "forget": true}"#;
    for (path, body) in [("/api/revoke", revoke), ("/api/restore", r#"{"revision": 3}"#)] {
        assert_eq!(site.post(path, &[], body), 401, "{path}");
        assert_eq!(site.post(path, &[&bearer], "{}"), 400, "{path}");
        assert_eq!(site.post(path, &[&bearer], body), 204, "{path}");
    }
    let revoke = Action::Revoke { device: DeviceId::new("drone-2").unwrap(), forget: true };
    assert_eq!(*site.done.lock().unwrap(), [forget, Action::Merge, revoke, Action::Restore(3)]);
    assert!(site.get("/api/state").contains("the operator at 127.0.0.1 asks to forget drone-1: done"));
    let record = std::fs::read_to_string(site.folder.path().join("actions.jsonl")).unwrap();
    for part in [
        "\"by\":\"127.0.0.1\"",
        "\"action\":\"forget drone-1\"",
        "\"action\":\"merge now\"",
        "\"action\":\"revoke and forget drone-2\"",
        "\"action\":\"restore revision 3\"",
        "\"outcome\":\"done\"",
    ] {
        assert!(record.contains(part), "{part}: {record}");
    }
}

#[test]
fn strangers_beyond_this_computer_see_nothing_without_the_token() {
    let site = Site::start("0.0.0.0:0");
    for path in
        ["/", "/api/state", "/api/events", "/metrics", "/model.spz", "/viewer.js", "/?token=0123456789abcdef"]
    {
        assert_eq!(status(&site.get(path)), 401, "{path}");
    }
    assert_eq!(status(&site.get("/healthz")), 200);
    let bearer = format!("Authorization: Bearer {}", site.token.as_str());
    assert_eq!(status(&ask(site.address(), "GET /metrics", &["Host: x", &bearer], "")), 200);
}

#[test]
fn refused_requests_are_told_and_a_flood_of_them_in_few_lines() {
    let site = Site::start("127.0.0.1:0");
    site.post("/api/merge", &[], "");
    ask(site.address(), "GET /api/state", &["Host: evil.example"], "");
    site.post("/api/merge", &["Origin: http://evil.example"], "");
    (0..40).for_each(|_| _ = site.post("/api/forget?token=secret", &[], ""));
    let state = site.get("/api/state");
    for line in [
        "refused POST /api/merge of 127.0.0.1: a token is needed",
        "refused GET /api/state of 127.0.0.1: open this server as",
        "refused POST /api/merge of 127.0.0.1: a page of another site",
    ] {
        assert!(state.contains(line), "{line}: {state}");
    }
    assert_eq!(state.matches("refused ").count(), 5, "{state}");
    assert!(!state.contains("secret"), "{state}");
}

#[test]
fn paths_lead_nowhere_and_other_hosts_are_refused() {
    let site = Site::start("127.0.0.1:0");
    for path in
        ["/../Cargo.toml", "/%2e%2e/Cargo.toml", "/viewer.js/../../etc/passwd", "//etc/passwd", "/etc/passwd"]
    {
        assert_eq!(status(&site.get(path)), 404, "{path}");
    }
    assert_eq!(status(&ask(site.address(), "GET /api/state", &["Host: evil.example"], "")), 403);
    let two = ["Host: localhost", "Host: evil.example"];
    assert_eq!(status(&ask(site.address(), "GET /api/state", &two, "")), 400);
    let page = site.get("/");
    assert!(page.contains("content-security-policy: default-src 'none'"), "{page}");
}

#[test]
fn large_and_slow_requests_end_the_connection() {
    let site = Site::start("127.0.0.1:0");
    let large = format!("X: {}", "x".repeat(100_000));
    assert_ne!(status(&ask(site.address(), "GET /", &["Host: localhost", &large], "")), 200);
    let slow_body = ["/api/forget", "/api/merge"].map(|path| format!(
        "POST {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\nContent-Length: 9\r\n\r\n{{",
        site.token.as_str()
    ));
    let begun = Instant::now();
    let slow = ["GET / HTTP/1.1\r\n", &slow_body[0], &slow_body[1]].map(|start| {
        let mut slow = TcpStream::connect(site.address()).unwrap();
        slow.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        slow.write_all(start.as_bytes()).unwrap();
        slow
    });
    for (mut slow, told) in slow.into_iter().zip([0, 408, 408]) {
        let mut answer = Vec::new();
        let _ = slow.read_to_end(&mut answer);
        assert!(begun.elapsed() < Duration::from_secs(15));
        assert_eq!(status(&String::from_utf8_lossy(&answer)), told);
    }
    assert!(site.done.lock().unwrap().is_empty());
}

#[test]
fn a_broken_chunk_is_told_apart_from_a_large_body() {
    let site = Site::start("127.0.0.1:0");
    let token = site.token.as_str();
    for path in ["/api/forget", "/api/merge"] {
        for (body, told) in [("ZZZ\r\n{}\r\n0\r\n\r\n", 400), ("2000\r\n", 413)] {
            let mut stream = TcpStream::connect(site.address()).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
            let more = if told == 413 { "x".repeat(0x2000) + "\r\n0\r\n\r\n" } else { String::new() };
            let request = format!(
                "POST {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}\r\n\
                 Transfer-Encoding: chunked\r\n\r\n{body}{more}"
            );
            stream.write_all(request.as_bytes()).unwrap();
            let mut answer = Vec::new();
            let _ = stream.read_to_end(&mut answer);
            let answer = String::from_utf8_lossy(&answer);
            assert_eq!(status(&answer), told, "{path}: {answer}");
        }
    }
    assert!(site.done.lock().unwrap().is_empty());
}

#[test]
fn a_thousand_idle_connections_keep_nobody_out() {
    let site = Site::start("127.0.0.1:0");
    let mut reader = TcpStream::connect(site.address()).unwrap();
    reader.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    reader.write_all(b"GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    assert!(reader.read(&mut [0; 1024]).unwrap() > 0);
    let idle: Vec<TcpStream> = (0..1000).filter_map(|_| TcpStream::connect(site.address()).ok()).collect();
    assert!(idle.len() > 128, "{}", idle.len());
    for _ in 0..3 {
        assert_eq!(status(&site.get("/healthz")), 200);
    }
    site.board.note_line("the reader stays connected");
    let (mut text, mut part) = (String::new(), [0; 4096]);
    while !text.contains("the reader stays") {
        let count = reader.read(&mut part).unwrap();
        assert!(count > 0, "{text}");
        text.push_str(&String::from_utf8_lossy(&part[..count]));
    }
}

#[test]
fn texts_of_devices_reach_a_page_only_as_json() {
    let site = Site::start("127.0.0.1:0");
    let problem = Some("<script>alert(1)</script>".to_owned());
    let status = AgentStatus { problem, ..AgentStatus::new(1, "1") };
    site.board.note_status(DeviceId::new("drone-1").unwrap(), status);
    assert!(!site.get("/").contains("alert(1)") && !site.get("/metrics").contains("alert(1)"));
    let state = site.get("/api/state");
    assert!(state.contains("content-type: application/json") && state.contains("alert(1)"), "{state}");
    assert!(!site.get("/live.js").contains("innerHTML"));
}

/// Names that would end a line or begin a header are no names of devices: they are neither answered with nor written anywhere.
#[test]
fn names_of_devices_inject_no_headers_and_no_lines() {
    let site = Site::start("127.0.0.1:0");
    let bearer = format!("Authorization: Bearer {}", site.token.as_str());
    let names = [
        r"drone\r\nSet-Cookie: a=b",
        r"drone\nX-Injected: yes",
        r"drone\u0000",
        r"drone\u2028X",
        "../../etc/passwd",
        "drone%0d%0aX-Injected: yes",
        &"d".repeat(65),
    ];
    for name in names {
        for (path, more) in [("/api/forget", ""), ("/api/revoke", r#", "forget": true"#)] {
            let body = format!(r#"{{"device": "{name}"{more}}}"#);
            let headers = ["Host: localhost", &bearer];
            let answer = ask(site.address(), &format!("POST {path}"), &headers, &body);
            assert_eq!(status(&answer), 400, "{name}: {answer}");
            assert!(!answer.contains("drone") && !answer.contains("passwd"), "{name}: {answer}");
        }
    }
    // A path is told, but as one line of text.
    site.post("/api/forget%0d%0aX-Injected:%20yes", &[], "");
    assert!(site.done.lock().unwrap().is_empty() && !site.folder.path().join("actions.jsonl").exists());
    let state = site.get("/api/state");
    assert!(
        state.contains("refused POST /api/forget%0d%0aX-Injected") && !state.contains("passwd"),
        "{state}"
    );
    let head = state.split("\r\n\r\n").next().unwrap();
    assert!(!head.to_lowercase().contains("x-injected"), "{head}");
}

#[test]
fn a_reader_of_events_gets_the_state_at_once() {
    let site = Site::start("127.0.0.1:0");
    let mut stream = TcpStream::connect(site.address()).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    stream.write_all(b"GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut text = String::new();
    let mut part = [0; 4096];
    while !text.contains("event: state") || !text.contains("uptime_s") {
        let count = stream.read(&mut part).unwrap();
        assert!(count > 0, "{text}");
        text.push_str(&String::from_utf8_lossy(&part[..count]));
    }
}
