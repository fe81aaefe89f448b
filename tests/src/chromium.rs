//! Drives a headless Chromium through chromedriver, by the WebDriver protocol of the W3C. Graphics are those of
//! SwiftShader, so that pictures do not depend on the computer's card.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

use crate::skips::skip;

/// Longest time that a script in a page may take.
const SCRIPT_WITHIN: Duration = Duration::from_secs(240);
/// Arguments of Chromium. In containers there is no sandbox for it.
const ARGUMENTS: [&str; 4] =
    ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];

/// A running browser with one page. It ends when this value is dropped.
#[derive(Debug)]
pub struct Chromium {
    driver: Child,
    port: u16,
    session: String,
}

impl Chromium {
    /// Starts a browser with a window of this size, px. If chromedriver or Chromium is not installed, reports that the test
    /// is skipped and returns `None`; panics instead if the environment variable `REQUIRE_CHROMIUM` is set.
    pub fn start(window_px: [u32; 2]) -> Option<Self> {
        let mut command = Command::new("chromedriver");
        command.arg("--port=0").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        let Ok(mut driver) = command.spawn() else {
            skip("REQUIRE_CHROMIUM", "chromedriver is not installed");
            return None;
        };
        let port = port_of(&mut driver);
        let mut browser = Self { driver, port, session: String::new() };
        let size = format!("--window-size={},{}", window_px[0], window_px[1]);
        let arguments: Vec<&str> = ARGUMENTS.into_iter().chain([&*size]).collect();
        let wanted = json!({"capabilities": {"alwaysMatch": {
            "timeouts": {"script": SCRIPT_WITHIN.as_millis() as u64},
            "goog:loggingPrefs": {"browser": "ALL"},
            "goog:chromeOptions": {"args": arguments},
        }}});
        match browser.ask("POST", "/session", &wanted) {
            Ok(value) => browser.session = value["sessionId"].as_str().unwrap().to_owned(),
            Err(error) => {
                skip("REQUIRE_CHROMIUM", format!("Chromium does not start: {error}"));
                return None;
            }
        }
        Some(browser)
    }

    /// Opens a page, and waits until it is loaded.
    pub fn open(&self, url: &str) {
        self.of_session("POST", "/url", &json!({"url": url}));
    }

    /// The value of an expression in the page; of its promise, if it is one. Panics if it throws.
    pub fn value(&self, expression: &str) -> Value {
        let script = format!(
            "const done = arguments[arguments.length - 1];\
             Promise.resolve().then(() => {expression})\
             .then((value) => done({{value}}), (error) => done({{error: String(error.stack)}}));"
        );
        let mut answer = self.of_session("POST", "/execute/async", &json!({"script": script, "args": []}));
        assert!(answer["error"].is_null(), "{expression}: {}", answer["error"]);
        answer["value"].take()
    }

    /// Whether a condition holds in the page. It does not while another page is loading.
    pub fn holds(&self, condition: &str) -> bool {
        let script = json!({"script": format!("return Boolean({condition})"), "args": []});
        let path = format!("/session/{}/execute/sync", self.session);
        self.ask("POST", &path, &script).is_ok_and(|value| value == true)
    }

    /// Runs a script in the page. The page's policy does not apply to it.
    pub fn run(&self, script: &str) {
        self.of_session("POST", "/execute/sync", &json!({"script": script, "args": []}));
    }

    /// What the page and the browser have complained about since the last call, one line each.
    pub fn complaints(&self) -> Vec<String> {
        let log = self.of_session("POST", "/se/log", &json!({"type": "browser"}));
        let lines = log.as_array().unwrap().iter();
        let bad = lines.filter(|line| line["level"] != "INFO" && line["level"] != "DEBUG");
        bad.map(|line| line["message"].as_str().unwrap().to_owned()).collect()
    }

    /// Shows pages with this width, px, and in dark or light colours from the next one that is opened.
    pub fn look(&self, width_px: u32, is_dark: bool) {
        let size =
            json!({"width": width_px, "height": 900, "deviceScaleFactor": 1, "mobile": width_px < 500});
        self.developer("Emulation.setDeviceMetricsOverride", &size);
        let scheme = if is_dark { "dark" } else { "light" };
        let media = json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]});
        self.developer("Emulation.setEmulatedMedia", &media);
    }

    /// Presses the Tab key, as a user without a mouse does.
    pub fn press_tab(&self) {
        for kind in ["rawKeyDown", "keyUp"] {
            let key = json!({"type": kind, "key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9});
            self.developer("Input.dispatchKeyEvent", &key);
        }
    }

    /// A picture of the whole page as PNG, in base64.
    pub fn whole_page(&self) -> String {
        let taken = self.developer("Page.captureScreenshot", &json!({"captureBeyondViewport": true}));
        taken["data"].as_str().unwrap().to_owned()
    }

    /// Asks Chromium by its developer tools' protocol, which chromedriver passes on.
    fn developer(&self, method: &str, params: &Value) -> Value {
        self.of_session("POST", "/goog/cdp/execute", &json!({"cmd": method, "params": params}))
    }

    fn of_session(&self, method: &str, path: &str, body: &Value) -> Value {
        self.ask(method, &format!("/session/{}{path}", self.session), body).unwrap()
    }

    /// Asks chromedriver. The error is its message.
    fn ask(&self, method: &str, path: &str, body: &Value) -> Result<Value, String> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(SCRIPT_WITHIN + Duration::from_secs(30))).unwrap();
        let body = if method == "POST" { body.to_string() } else { String::new() };
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\nContent-Type: application/json\r\n\
             Content-Length: {}\r\n\r\n{body}",
            body.len()
        )
        .unwrap();
        let mut answer = read_answer(stream);
        match answer["value"]["error"].as_str() {
            Some(error) => Err(format!("{error}: {}", answer["value"]["message"])),
            None => Ok(answer["value"].take()),
        }
    }
}

/// The bytes of a text in base64.
pub fn decode_base64(text: &str) -> Vec<u8> {
    let value = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u32> = text.bytes().filter(|c| *c != b'=').map(|c| u32::from(value(c))).collect();
    digits
        .chunks(4)
        .flat_map(|chunk| {
            let bits = chunk.iter().enumerate().fold(0, |bits, (i, digit)| bits | digit << (18 - 6 * i));
            bits.to_be_bytes()[1..chunk.len()].to_vec()
        })
        .collect()
}

/// The port on which a chromedriver listens, which it prints.
fn port_of(driver: &mut Child) -> u16 {
    let mut lines = BufReader::new(driver.stdout.take().unwrap());
    let port = (&mut lines).lines().map_while(Result::ok).find_map(|line| {
        let (_, rest) = line.split_once("started successfully on port ")?;
        rest.trim_end_matches('.').parse().ok()
    });
    driver.stdout = Some(lines.into_inner()); // it writes more, and would end if nobody could read it
    port.expect("chromedriver prints its port")
}

/// The body of an answer.
fn read_answer(stream: TcpStream) -> Value {
    let mut reader = BufReader::new(stream);
    let mut length = 0;
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).unwrap();
        if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        if line.trim().is_empty() {
            break;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    serde_json::from_slice(&body).unwrap()
}

impl Drop for Chromium {
    fn drop(&mut self) {
        if !self.session.is_empty() && !std::thread::panicking() {
            let _ = self.ask("DELETE", &format!("/session/{}", self.session), &Value::Null);
        }
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
