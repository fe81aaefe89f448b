//! A service as a loop: it receives messages, stores and merges models, and reports events to its owner.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cosurf_link::{Credentials, Node, PlannedCell, Transport};
use cosurf_wire::{DeviceId, ModelHeader};

use super::above::AboveLink;
use super::control::{Command, ServiceConfig};
use super::error::ServiceError;
use super::event::ServiceEvent;
use super::folder::models;
use super::keeper::{Keeper, RunState};
use super::reporting::{ReportTask, Reporter, Reporting};
use crate::queue::Queue;
use crate::store::Store;

/// Longest wait for a message before commands and merges are checked.
const LISTEN: Duration = Duration::from_millis(50);

/// A service whose folder is open and that is not running yet.
#[derive(Debug)]
pub struct Service {
    pub(super) node: Node,
    pub(super) keeper: Keeper,
}

impl Service {
    /// Opens the folder; creates it if it is missing.
    pub fn open(config: ServiceConfig) -> Result<Self, ServiceError> {
        let (identity, limits) = (config.identity, config.limits);
        let models = models(&config.folder);
        let (keeper, known) = Keeper::open(config)?;
        let mut service = Self { node: Node::new(identity, limits, &known), keeper };
        service.node.keep_arrived(&models)?;
        service.node.revoke(service.keeper.revoked());
        Ok(service.with_plan(BTreeMap::new()))
    }

    /// Tells each device its cell of this plan, or that it has none.
    pub(super) fn with_plan(mut self, cells: BTreeMap<DeviceId, PlannedCell>) -> Self {
        self.node.share_plan(cells);
        self
    }

    /// Signs outgoing messages with `credentials`, and accepts only messages that the credentials trust.
    pub fn with(mut self, credentials: Credentials) -> Self {
        self.node.set_credentials(credentials);
        self
    }

    /// Sets the limit on devices, see [`Node::set_devices_max`], and on those whose models are kept.
    pub fn with_devices_max(mut self, devices_max: usize) -> Self {
        self.node.set_devices_max(devices_max);
        self.keeper.set_devices_max(devices_max);
        self
    }

    /// Lets workers distil the tiles of merges. Their results are kept in `results`, which nobody else may use.
    pub fn with_workers(mut self, results: Store, queue: Queue) -> Self {
        self.keeper.employ(results, queue);
        self
    }

    /// Makes a report of each revision while no models are merged.
    pub fn with_reports(mut self, reporter: Reporter, task: ReportTask) -> Self {
        self.keeper.report(Reporting::new(reporter, task));
        self
    }

    /// Hands the global model of the aggregator above on to the devices. Revisions of the service's own wait for the next
    /// model from above, at most for `wait`.
    pub(crate) fn below(mut self, link: AboveLink, wait: Duration) -> Self {
        self.keeper.follow(link, wait);
        self
    }

    /// Serves until a command ends it, or until `on_event` returns `Break`. Returns the header of the newest
    /// revision of the global model, if there is one.
    pub fn run<T: Transport>(
        mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        commands: &Receiver<Command>,
        mut on_event: impl FnMut(ServiceEvent) -> ControlFlow<()>,
    ) -> Option<ModelHeader> {
        let mut state = RunState::Running;
        loop {
            state = state.max(self.keeper.obey(&mut self.node, commands, now()));
            let broke = self.step(transport, &now, LISTEN, &mut on_event).is_break();
            let ends = match state {
                RunState::Running => false,
                RunState::Finishing => !self.keeper.is_merging() && !self.keeper.is_due(now()),
                RunState::Stopping => true,
            };
            if ends || broke {
                return self.keeper.global();
            }
        }
    }

    /// Whether models are being merged.
    #[cfg(test)]
    pub(crate) fn is_merging(&self) -> bool {
        self.keeper.is_merging()
    }

    /// Listens for at most `wait`, handles what arrives, and merges models when a merge is due.
    pub(crate) fn step<T: Transport>(
        &mut self,
        transport: &mut T,
        now: impl Fn() -> Duration,
        wait: Duration,
        mut on_event: impl FnMut(ServiceEvent) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let heard = self.node.step(transport, &now, wait);
        if let Some(event) = heard.and_then(|event| self.keeper.take(&mut self.node, event, now())) {
            on_event(event)?;
        }
        match self.keeper.work(&mut self.node, now()) {
            Some(event) => on_event(event),
            None => ControlFlow::Continue(()),
        }
    }
}
