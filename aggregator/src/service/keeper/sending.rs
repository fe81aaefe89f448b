//! What devices get: the service's own newest revision or that of the aggregator above, and under which number.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_link::{ModelKey, Node, Offer};
use cosurf_wire::{DeviceId, ModelHeader, ModelId};

use super::Keeper;
use crate::service::above::{Above, Own};
use crate::service::error::ServiceError;
use crate::service::event::ServiceEvent;
use crate::service::record::{KeptOut, Merging};
use crate::service::round::Round;

impl Keeper {
    /// The highest number of the service's own revisions.
    pub(super) fn own_number(&self) -> Option<ModelId> {
        self.global.map(|global| global.model).max(self.sent.number())
    }

    /// The number of the next revision that devices get, of the service's own or from above.
    pub(super) fn next_number(&self) -> ModelId {
        self.own_number()
            .max(self.handed.number())
            .max(self.used)
            .map_or(ModelId(1), |newest| ModelId(newest.0 + 1))
    }

    /// Lets the next revision have a higher number than any that devices may have from a folder that was lost, because one of
    /// them has refused the revision `refused`. Sessions follow the clock, and revisions do not, unless they have jumped. So
    /// a device that refuses everything makes no more than one jump in a session. Returns whether there is one.
    pub(super) fn jump(&mut self, refused: ModelId, now: Duration) -> bool {
        let session = ModelId(self.session);
        let (own, handed) = (self.own_number(), self.handed.number());
        if own.max(handed) != Some(refused) || refused >= session {
            return false;
        }
        self.used = self.used.max(Some(session));
        // The aggregator above need not offer again what it has offered.
        let from_above = self.above.as_ref().and_then(Above::newest).filter(|_| handed > own);
        if from_above.is_none_or(|model| self.hand_on(model, true).is_err()) {
            self.round = Some(Round::at_once(self.round.take(), now));
        }
        true
    }

    /// Whether devices may have a model with a higher number than the service's own: one whose file was set aside, or one
    /// of an aggregator above that is no longer configured.
    pub(super) fn is_outnumbered(&self) -> bool {
        let own = self.own_number();
        self.used > own.max(self.handed.number()) || self.above.is_none() && self.handed.number() > own
    }

    /// Whether the newest revision is too large to be sent whole, and its tiles are not there.
    pub(super) fn lacks_tiles(&self) -> bool {
        let is_large = |header: ModelHeader| header.splats as usize > self.work.whole_splats_max;
        self.global.is_some_and(is_large) && self.sent.newest().is_none()
    }

    /// Hands on what came from the aggregator above. Sends the service's own revision once it has waited long enough.
    pub(super) fn follow_above(&mut self, node: &mut Node, now: Duration) -> Result<(), ServiceError> {
        // A revision whose file is lost was there, and the aggregator above may have it.
        let has_own = (self.global.is_some() || self.used.is_some()) && !self.shelf.newest().is_empty();
        let own = match has_own {
            false => Own::None,
            true if self.own_number() > self.handed.number() => Own::Newest,
            true => Own::Some,
        };
        let Some(above) = &mut self.above else { return Ok(()) };
        if let Some((header, is_answer)) = above.take_news(own) {
            self.hand_on(header, is_answer)?;
        }
        let Some(above) = &mut self.above else { return Ok(()) };
        if above.advance(&self.shelf.stores().whole)? {
            self.finish_handing_on(node)?;
        } else if above.has_waited(now) {
            self.send_own(node)?;
        }
        Ok(())
    }

    /// Begins to hand a model of the aggregator above on.
    pub(super) fn hand_on(&mut self, model: ModelHeader, is_answer: bool) -> Result<(), ServiceError> {
        let others: Vec<DeviceId> = self.shelf.withdrawn_devices().collect();
        let record = Merging::read(&self.folder);
        let devices = self.shelf.newest();
        let Some(above) = &mut self.above else { return Ok(()) };
        above.begin(model, is_answer, devices, &others, record.as_ref())
    }

    pub(super) fn finish_handing_on(&mut self, node: &mut Node) -> Result<(), ServiceError> {
        let (own, next) = (self.own_number().max(self.used), self.next_number());
        let Some(above) = &mut self.above else { return Ok(()) };
        if above.finish(&mut self.handed, self.device, own, next)? {
            self.rebroadcast.begin(node, &self.handed, &self.receivers())?;
        }
        Ok(())
    }

    /// Offers the newest revision again, as it is on the disk.
    pub(super) fn offer_again(
        &mut self,
        node: &mut Node,
        now: Duration,
    ) -> Result<ServiceEvent, ServiceError> {
        let global = self.global.expect("a merged model has a revision");
        let (header, body) = self.globals.get(ModelKey::from(global))?;
        self.to_offer = false;
        let record = Merging::read(&self.folder);
        let (inputs, kept_out) =
            record.map(|record| (record.inputs.len(), record.kept_out)).unwrap_or_default();
        let event = self.broadcast(node, now, Offer { header, body }, inputs, kept_out)?;
        self.tell_restored();
        Ok(event)
    }

    /// Offers a global model to all devices, whole or in tiles. An edge offers what came from above if that is newer, or
    /// waits for it. [`ServiceEvent::Delivered`] follows once all devices that
    /// sent a complete model and are not given up have stored what they get. `inputs` counts the models given to the
    /// merge, including those `kept_out`.
    pub(super) fn broadcast(
        &mut self,
        node: &mut Node,
        now: Duration,
        offer: Offer,
        inputs: usize,
        kept_out: Vec<KeptOut>,
    ) -> Result<ServiceEvent, ServiceError> {
        let header = offer.header;
        let is_above_newer = self.handed.number() > self.own_number();
        match &mut self.above {
            Some(above) if is_above_newer => {
                let model = above.newest();
                self.rebroadcast.begin(node, &self.handed, &self.receivers())?;
                if let Some(model) = model {
                    self.hand_on(model, false)?;
                }
            }
            above => {
                if !above.as_mut().is_some_and(|above| above.waits(now)) {
                    self.offer(node, offer)?;
                }
            }
        }
        Ok(ServiceEvent::Merged { header, models: inputs.saturating_sub(kept_out.len()), kept_out })
    }

    /// Offers the service's own newest revision to the devices, as it is on the disk.
    pub(super) fn send_own(&mut self, node: &mut Node) -> Result<(), ServiceError> {
        let Some(global) = self.global else { return Ok(()) };
        let (header, body) = self.globals.get(ModelKey::from(global))?;
        self.offer(node, Offer { header, body })
    }

    /// Offers the service's own newest revision to the devices: in its tiles, if there are any, or whole.
    pub(super) fn offer(&mut self, node: &mut Node, whole: Offer) -> Result<(), ServiceError> {
        let receivers = self.receivers();
        match self.sent.newest() {
            Some(_) => self.rebroadcast.begin(node, &self.sent, &receivers)?,
            None => self.rebroadcast.begin_whole(node, whole, &receivers),
        }
        Ok(())
    }

    /// The devices that sent a complete model and are not given up.
    pub(super) fn receivers(&self) -> Vec<DeviceId> {
        let senders = self.shelf.newest().into_iter().map(|header| header.device);
        senders.filter(|device| !self.given_up.contains(device) && !self.revoked.contains(device)).collect()
    }

    /// The devices that a manifest lists even if they get no tiles, so that they do not wait for a later one.
    pub(super) fn without_tiles(&self) -> BTreeMap<DeviceId, Vec<u32>> {
        let senders = self.shelf.newest().into_iter().map(|header| header.device);
        senders.chain(self.shelf.withdrawn_devices()).map(|device| (device, Vec::new())).collect()
    }
}
