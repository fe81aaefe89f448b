//! Which uploads get how much of the inbox's memory.
//!
//! An upload takes at most 1 MiB until chunks arrive, and then as many bytes as its sender may soon fill. So a header takes
//! no more room than its sender makes use of. If the memory is full, models without news give way, those first of which
//! least has arrived, then those of devices that send several at once. A device with several unfinished models gets at most
//! a quarter of the memory.

use std::collections::BTreeMap;
use std::time::Duration;

use cosurf_wire::{DeviceId, ModelHeader};

use super::Inbox;
use crate::identity::Role;
use crate::key::ModelKey;
use crate::transfer::Transfer;

/// The share of the memory for a device with several unfinished models.
const SHARE_OF_DEVICE: u64 = 4;
/// Limit on the unfinished models of a device.
const MODELS_OF_DEVICE: usize = 4;

impl Inbox {
    /// Makes room for a new model. Returns the bytes that it may take at first; `None` if there is no room.
    pub(super) fn make_room_for(&mut self, now: Duration, header: &ModelHeader) -> Option<u64> {
        let key = ModelKey::from(header);
        // A device receives from its aggregator only.
        let claim = match self.identity.role {
            Role::Device => header.body_bytes,
            Role::Aggregator => Transfer::first_claim(header),
        };
        if !self.is_within_share(key, claim) {
            return None;
        }
        while self.transfers.len() >= self.limits.models_max || !self.fits(claim) {
            self.drop_stalled(now, key, None).or_else(|| self.drop_surplus(key))?;
        }
        Some(claim)
    }

    /// Lets an upload take as many more bytes as its sender may soon fill, if there is room.
    pub(super) fn make_room_for_more(&mut self, now: Duration, key: ModelKey) {
        let Some(transfer) = self.transfers.get(&key) else { return };
        let (claim, received) = (transfer.wanted_claim(), transfer.received_bytes());
        let more = claim - transfer.claim();
        if more == 0 || !self.is_within_share(key, claim) {
            return;
        }
        while !self.fits(more) {
            if self.drop_stalled(now, key, Some(received)).or_else(|| self.drop_surplus(key)).is_none() {
                return;
            }
        }
        if let Some(transfer) = self.transfers.get_mut(&key) {
            transfer.grow(claim);
        }
    }

    fn fits(&self, bytes: u64) -> bool {
        self.unfinished_bytes() + bytes <= self.limits.total_bytes_max
    }

    /// Whether a model may take so many bytes beside the other models of its device.
    fn is_within_share(&self, key: ModelKey, claim: u64) -> bool {
        let is_other = |(other, _): &(&ModelKey, &Transfer)| other.device == key.device && **other != key;
        let others: Vec<u64> =
            self.transfers.iter().filter(is_other).map(|(_, transfer)| transfer.claim()).collect();
        let bytes = others.iter().sum::<u64>() + claim;
        self.identity.role == Role::Device
            || others.is_empty()
            || (others.len() < MODELS_OF_DEVICE && bytes <= self.limits.total_bytes_max / SHARE_OF_DEVICE)
    }

    /// Drops the stalled model of which least has arrived, in favour of the model `key`. `None` if there is none. If
    /// `received` bytes of `key` have arrived already, a model that waits for room too gives way only if less has arrived of
    /// it, so that two do not drop each other in turn.
    fn drop_stalled(&mut self, now: Duration, key: ModelKey, received: Option<u64>) -> Option<()> {
        let gives_way = |(other, transfer): &(&ModelKey, &Transfer)| {
            let has_less = |received| (transfer.received_bytes(), **other) < (received, key);
            **other != key
                && transfer.is_stalled(now)
                && (!transfer.lacks_room() || received.is_none_or(has_less))
        };
        let stalled = self.transfers.iter().filter(gives_way);
        let least = stalled.min_by_key(|(_, transfer)| (transfer.received_bytes(), transfer.last_news));
        let least = *least?.0;
        self.transfers.remove(&least);
        Some(())
    }

    /// Drops an unfinished model of a device that sends several, in favour of the model `key` of a device that sends no
    /// other: of the device that takes most, the one of which least has arrived. `None` if there is none. So a few devices
    /// that hoard memory do not keep the others out.
    fn drop_surplus(&mut self, key: ModelKey) -> Option<()> {
        let fetching =
            || self.transfers.iter().filter(|(other, transfer)| **other != key && transfer.is_fetching());
        let mut claims: BTreeMap<DeviceId, (usize, u64)> = BTreeMap::new();
        for (other, transfer) in fetching() {
            let (models, bytes) = claims.entry(other.device).or_default();
            (*models, *bytes) = (*models + 1, *bytes + transfer.claim());
        }
        if claims.contains_key(&key.device) {
            return None;
        }
        let several = claims.into_iter().filter(|(_, (models, _))| *models > 1);
        let heaviest = several.max_by_key(|(_, (_, bytes))| *bytes)?.0;
        let of_heaviest = fetching().filter(|(other, _)| other.device == heaviest);
        let least = *of_heaviest.min_by_key(|(_, transfer)| transfer.received_bytes())?.0;
        self.transfers.remove(&least);
        Some(())
    }
}
