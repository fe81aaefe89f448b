//! The receiving service on its own thread, connected by MQTT, for a mission on one machine.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::mpsc::{self, Sender};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use cosurf_link::{MqttConfig, MqttTransport};
use cosurf_wire::{DeviceId, ModelHeader};

use super::control::Command;
use super::event::ServiceEvent;
use super::receive::Service;

/// A running service. Dropping it ends the service.
pub(crate) struct Station {
    commands: Option<Sender<Command>>,
    thread: Option<JoinHandle<Option<ModelHeader>>>,
}

impl Station {
    /// Starts to serve through the broker of `link`; `on_event` gets the service's events.
    pub(crate) fn start(
        service: Service,
        link: MqttConfig,
        now: Arc<dyn Fn() -> Duration + Send + Sync>,
        on_event: impl Fn(ServiceEvent) + Send + 'static,
    ) -> Self {
        let (commands, receiver) = mpsc::channel();
        let thread = thread::spawn(move || {
            let mut transport = MqttTransport::start(link);
            service.run(
                &mut transport,
                || now(),
                &receiver,
                |event| {
                    on_event(event);
                    ControlFlow::Continue(())
                },
            )
        });
        Self { commands: Some(commands), thread: Some(thread) }
    }

    /// Stops waiting for this device.
    pub(crate) fn give_up(&self, device: DeviceId) {
        self.tell(Command::GiveUp(device));
    }

    /// Finishes a merge that is due and ends the service. Returns the header of the newest global model, if
    /// there is one.
    pub(crate) fn finish(mut self) -> Option<ModelHeader> {
        self.tell(Command::Finish);
        self.thread.take().and_then(|thread| thread.join().ok().flatten())
    }

    /// Whether the service has ended without a command.
    pub(crate) fn has_died(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn tell(&self, command: Command) {
        if let Some(commands) = &self.commands {
            let _ = commands.send(command); // fails only if the service has ended already
        }
    }
}

impl Drop for Station {
    fn drop(&mut self) {
        self.commands = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
