//! Publishing: the local model goes out in chunks until the aggregator has it on its disk; the global model
//! comes in and is kept. Both survive a kill at any moment: what was published is remembered by number and
//! hash, what came in is on the disk before it is acknowledged.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use cosurf_contract::AgentEvent;
use cosurf_engine::Renderer;
use cosurf_link::{
    Credentials, FirstLayer, Identity, InboxLimits, ModelStore, Node, NodeEvent, Offer, Transport,
    body_to_model, model_to_body,
};
use cosurf_scene::{Base, Camera, Splats, ply};
use cosurf_wire::{ModelHeader, ModelId, ModelKind};
use serde::{Deserialize, Serialize};

use crate::flights::Flights;
use crate::outputs::write_json;

/// Longest wait for something to hear before the time is looked at again.
const LOOK_UP: Duration = Duration::from_millis(200);

/// What to send and what to wait for.
pub struct Publication<'a> {
    /// Who sends.
    pub identity: Identity,
    /// The trained model.
    pub splats: &'a Splats,
    /// The cameras that it saw.
    pub cameras: &'a [Camera],
    /// What is sent first, to stand in for the model; without one, the splats that the pictures need most.
    pub base: Option<&'a Base>,
    /// Set where ground that other devices show as well is left to its owner.
    pub sharing: Option<Sharing<'a>>,
    /// The frame of the model, the key that signs it, and whose global models are believed.
    pub credentials: &'a Credentials,
    /// The agent's folder.
    pub out: &'a Path,
    /// Whether to wait for a global model.
    pub wait_global: bool,
    /// Most bytes that a global model on its way in may take.
    pub inbox_bytes: u64,
    /// After the last acknowledgement the link gets this long to carry it out.
    pub farewell: Duration,
}

/// How ground is shared with other devices: see [`crate::flights`].
#[derive(Clone, Copy)]
pub struct Sharing<'a> {
    /// What this device has photographed, as it was told by [`tell`].
    pub flight: &'a [Camera],
    /// How long no other device must have told its flight.
    pub quiet: Duration,
    /// To compute with, at least 1.
    pub threads: usize,
}

/// What was published last: so that the same model keeps its number, and another one gets the next.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Published {
    model: u64,
    blake3: String,
}

/// Tells other devices what this one has photographed. Gives up after `patience` where nobody answers.
pub fn tell<T: Transport>(
    identity: Identity,
    credentials: &Credentials,
    flight: &[Camera],
    transport: &mut T,
    now: impl Fn() -> Duration,
    patience: Duration,
    farewell: Duration,
) {
    // A global model that is offered meanwhile is for later.
    let busy =
        InboxLimits { body_bytes_max: u64::MAX, total_bytes_max: u64::MAX, models_max: 0, stored_max: 0 };
    let mut node = Node::new(identity, busy, &[]);
    node.set_credentials(credentials.clone());
    node.announce_flight(flight);
    let mut end = now() + patience;
    let mut is_told = false;
    while now() < end {
        let event = node.step(transport, &now, LOOK_UP);
        if matches!(event, Some(NodeEvent::Connected)) && !is_told {
            is_told = true;
            end = now() + farewell;
        }
    }
}

/// Sends the model, and stays until it is acknowledged and, if wanted, a global model is stored. `now` is
/// time since any moment.
pub fn publish<T: Transport>(
    publication: &Publication,
    transport: &mut T,
    now: impl Fn() -> Duration,
    mut on_event: impl FnMut(AgentEvent),
) -> Result<()> {
    let Publication { identity, out, wait_global, inbox_bytes, .. } = *publication;
    let (globals, known) = ModelStore::open(&out.join("global"))?;
    let limits = InboxLimits {
        body_bytes_max: inbox_bytes,
        total_bytes_max: inbox_bytes,
        models_max: 1,
        stored_max: 64,
    };
    let mut node = Node::new(identity, limits, &known);
    node.set_credentials(publication.credentials.clone());
    let mut waiting = publication.sharing.map(|sharing| Waiting::of(&sharing, &mut node, identity));
    let mut bytes_total = None;
    let mut is_acknowledged = false;
    let mut has_global = false;
    loop {
        if bytes_total.is_none() && waiting.as_ref().is_none_or(|waiting| waiting.is_over(now())) {
            let offer = match waiting.take() {
                Some(waiting) => shared(publication, &waiting, &mut on_event)?,
                None => offer(publication, publication.splats, publication.base, ModelKind::Local)?,
            };
            bytes_total = Some(offer.header.body_bytes);
            node.upload(offer);
        }
        if is_acknowledged && (has_global || !wait_global) {
            break;
        }
        let Some(event) = node.step(transport, &now, LOOK_UP) else { continue };
        match event {
            NodeEvent::Disconnected { attempt, reason } => {
                on_event(AgentEvent::Retrying { what: who_is_silent(&reason).to_owned(), attempt });
            }
            NodeEvent::Connected => {
                if let Some(waiting) = &mut waiting {
                    waiting.quiet_since.get_or_insert(now());
                }
            }
            NodeEvent::Flight(device, cameras) => {
                if let Some(waiting) = &mut waiting {
                    waiting.flights.note(device, cameras);
                    waiting.quiet_since = Some(now());
                }
            }
            NodeEvent::Progress(_, progress) => {
                let bytes_total = bytes_total.unwrap_or_default();
                on_event(AgentEvent::Publishing { bytes_sent: progress.bytes_sent, bytes_total });
            }
            NodeEvent::Uploaded(_, progress) => {
                is_acknowledged = true;
                on_event(AgentEvent::Acknowledged { bytes_sent: progress.bytes_sent });
            }
            NodeEvent::UploadRefused { key, reason, .. } if !reason.is_temporary() => {
                bail!("the aggregator refuses model {}: {reason}", key.model);
            }
            NodeEvent::UploadRefused { reason, .. } => {
                on_event(AgentEvent::Retrying { what: format!("the aggregator ({reason})"), attempt: 1 });
            }
            NodeEvent::Known(header) if !has_global => {
                // Received before a kill or a restart; it is on the disk.
                has_global = true;
                on_event(received(&header));
            }
            NodeEvent::Store { header, body } => match store_global(&globals, out, &header, &body) {
                Ok(()) => {
                    node.stored(header.into());
                    has_global = true;
                    on_event(received(&header));
                }
                Err(error) => {
                    node.store_failed(header.into());
                    on_event(AgentEvent::Retrying { what: format!("the disk ({error:#})"), attempt: 1 });
                }
            },
            _ => {}
        }
    }
    let end = now() + publication.farewell;
    while now() < end {
        node.step(transport, &now, LOOK_UP);
    }
    Ok(())
}

/// An upload that waits for the flights of others.
struct Waiting<'a> {
    sharing: Sharing<'a>,
    flights: Flights,
    quiet_since: Option<Duration>,
}

impl<'a> Waiting<'a> {
    fn of(sharing: &Sharing<'a>, node: &mut Node, identity: Identity) -> Self {
        node.announce_flight(sharing.flight);
        let flights = Flights::new(identity.device, sharing.flight);
        Self { sharing: *sharing, flights, quiet_since: None }
    }

    fn is_over(&self, now: Duration) -> bool {
        self.quiet_since.is_some_and(|since| now >= since + self.sharing.quiet)
    }
}

/// The model but for what is left to others.
fn shared(
    publication: &Publication,
    waiting: &Waiting,
    on_event: &mut impl FnMut(AgentEvent),
) -> Result<Offer> {
    let Publication { splats, cameras, base, .. } = *publication;
    let Waiting { sharing, flights, .. } = waiting;
    let removed = flights.compression(splats, cameras, sharing.threads)?.removed;
    on_event(AgentEvent::Compressed { removed: removed.len(), of: splats.len(), others: flights.others() });
    let base = base.map(|base| base.without(&removed));
    let kind = if removed.is_empty() { ModelKind::Local } else { ModelKind::Compressed };
    offer(publication, &splats.without(&removed), base.as_ref(), kind)
}

fn received(header: &ModelHeader) -> AgentEvent {
    AgentEvent::GlobalReceived { revision: header.model, splats: header.splats as usize }
}

/// `broker 10.0.0.2:1883` of `broker 10.0.0.2:1883: connection refused (attempt 2)`.
fn who_is_silent(reason: &str) -> &str {
    reason.rsplit_once(": ").map_or(reason, |(who, _)| who)
}

/// The model as it is sent, under the number that it had before if it was sent before.
fn offer(publication: &Publication, splats: &Splats, base: Option<&Base>, kind: ModelKind) -> Result<Offer> {
    let path = publication.out.join("published.json");
    let body = match base {
        Some(base) => model_to_body(splats, publication.cameras, FirstLayer::Base(base)),
        None => {
            let importance = Renderer::new(splats, 1).importance(publication.cameras);
            model_to_body(splats, publication.cameras, FirstLayer::ByImportance(&importance))
        }
    }?;
    let hash = blake3::hash(&body).to_hex().to_string();
    let mut published: Published = match fs::read(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .with_context(|| format!("{}; remove it to publish anew", path.display()))?,
        Err(_) => Published::default(),
    };
    if published.blake3 != hash {
        published = Published { model: published.model + 1, blake3: hash };
        write_json(&path, &published)?;
    }
    let views = publication.cameras.len() as u32;
    Ok(Offer::from_body(publication.identity.device, ModelId(published.model), kind, views, body)?)
}

/// Writes the global model for the agent's next flight, and as a PLY for people.
fn store_global(globals: &ModelStore, out: &Path, header: &ModelHeader, body: &[u8]) -> Result<()> {
    let model = body_to_model(body)?;
    ply::write(&global_ply(out), &model.splats)?;
    globals.put(header, body)?;
    Ok(())
}

/// Where the newest global model lies.
pub fn global_ply(out: &Path) -> PathBuf {
    out.join("global.ply")
}
