//! A service with a page for a browser, devices that write to it, and waits for what the page shows.

use std::fs;
use std::net::{SocketAddr, TcpListener};
use std::thread::sleep;
use std::time::{Duration, Instant};

use cosurf_link::{MqttConfig, MqttTransport, Offer, Role, Transport, TransportEvent};
use cosurf_wire::ModelId;

use crate::chromium::Chromium;
use crate::live::upload;
use crate::offers::{broker_address, identity, mergeable_offer};
use crate::running::{PATIENCE, Running};

/// A service with a page, whose folder and addresses outlive its program.
#[derive(Debug)]
pub struct Site {
    /// The folder of `aggregator.toml`; the service has `out` in it.
    pub folder: tempfile::TempDir,
    broker: SocketAddr,
    /// Address of the page.
    pub page: SocketAddr,
}

impl Site {
    /// A service that merges each model at once, without refining what it merges.
    pub fn at_once() -> Self {
        Self::with("quorum = 1\nquiet_s = 0\nrefine = false\n")
    }

    /// A service with these further lines of its configuration.
    pub fn with(settings: &str) -> Self {
        let [broker, page] =
            [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap());
        let folder = tempfile::tempdir().unwrap();
        let text = format!("site = \"site\"\nout = \"out\"\nbind = \"{broker}\"\n{settings}");
        fs::write(folder.path().join("aggregator.toml"), text).unwrap();
        Self { folder, broker, page }
    }

    /// Starts the program, with the page.
    pub fn start(&self) -> Running {
        Running::start("cosurf-aggregator", self.folder.path(), &["run", "--http", &self.page.to_string()])
    }

    /// Starts the program without the page.
    pub fn start_without_page(&self) -> Running {
        Running::start("cosurf-aggregator", self.folder.path(), &["run"])
    }

    /// A client of the broker, once it is connected.
    pub fn client(&self) -> MqttTransport {
        let identity = identity(Role::Device, "teller");
        let broker = broker_address(self.broker);
        let mut transport =
            MqttTransport::start(MqttConfig { broker, identity, will: None, tls: None, login: None });
        let begun = Instant::now();
        while transport.poll(Duration::from_millis(50)) != Some(TransportEvent::Connected) {
            assert!(begun.elapsed() < PATIENCE);
        }
        transport
    }

    /// Uploads a model of `count` random splats under this number.
    pub fn upload(&self, device: &str, number: u64, count: usize) {
        let mut offer: Offer = mergeable_offer(device, count);
        offer.header.model = ModelId(number);
        self.send(offer);
    }

    /// Uploads a model.
    pub fn send(&self, offer: Offer) {
        let sender = identity(Role::Device, offer.header.device.as_str());
        upload(broker_address(self.broker), None, sender, offer, |_| (), |_| ());
    }
}

/// Waits until a condition holds in the page. Returns how long that took.
pub fn await_page(browser: &Chromium, condition: &str, within: Duration) -> Duration {
    let begun = Instant::now();
    while !browser.holds(condition) {
        assert!(begun.elapsed() < within, "{condition}: {:?}", browser.complaints());
        sleep(Duration::from_millis(50));
    }
    begun.elapsed()
}

/// Waits until a program has printed a text.
pub fn await_log(program: &Running, text: &str) {
    let begun = Instant::now();
    while !program.log().contains(text) {
        assert!(begun.elapsed() < PATIENCE, "{text}: {}", program.log());
        sleep(Duration::from_millis(20));
    }
}
