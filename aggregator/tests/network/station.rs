//! An aggregator's service on a thread of its own.

use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use cosurf_aggregator::merge::MergeSettings;
use cosurf_aggregator::service::{Command, Expected, Service, ServiceConfig, ServiceEvent};
use cosurf_link::{BrokerAddress, Identity, InboxLimits, MqttConfig, MqttTransport, Role};
use cosurf_tests::offers::identity;
use cosurf_wire::DeviceId;

/// Time after which a wait has failed; a service needs seconds.
const PATIENCE: Duration = Duration::from_secs(120);

/// The address of any free port of this machine.
pub(crate) fn loopback() -> SocketAddr {
    ([127, 0, 0, 1], 0).into()
}

/// A running service.
pub(crate) struct Station {
    commands: Sender<Command>,
    events: Receiver<ServiceEvent>,
    thread: JoinHandle<bool>,
}

impl Station {
    /// The identity of the service on its broker.
    pub(crate) fn identity() -> Identity {
        identity(Role::Aggregator, "ground")
    }

    /// Serves in `folder` and merges once all `devices` have uploaded.
    pub(crate) fn start(
        folder: &Path,
        broker: BrokerAddress,
        devices: [&str; 2],
        merge: MergeSettings,
    ) -> Self {
        let identity = Self::identity();
        let service = Service::open(ServiceConfig {
            identity,
            folder: folder.to_owned(),
            limits: InboxLimits::default(),
            expected: Expected::Devices(devices.map(|name| DeviceId::new(name).unwrap()).into()),
            merge,
            threads: 1,
        })
        .unwrap();
        let (commands, orders) = channel();
        let (say, events) = channel();
        let thread = thread::spawn(move || {
            let begun = Instant::now();
            let mut transport =
                MqttTransport::start(MqttConfig { broker, identity, will: None, tls: None, login: None });
            let on_event = |event| {
                let _ = say.send(event);
                ControlFlow::Continue(())
            };
            service.run(&mut transport, || begun.elapsed(), &orders, on_event).is_some()
        });
        Self { commands, events, thread }
    }

    /// Waits for an event that `is_it` accepts. Events before it are dropped.
    pub(crate) fn wait_for(&self, is_it: impl Fn(&ServiceEvent) -> bool) {
        while !is_it(&self.events.recv_timeout(PATIENCE).unwrap()) {}
    }

    /// Stops the service; returns true if it has a global model.
    pub(crate) fn finish(self) -> bool {
        self.commands.send(Command::Finish).unwrap();
        self.thread.join().unwrap()
    }
}
