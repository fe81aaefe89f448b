//! What there is to see and to do on a running site: its state, events, metrics, map and models, and the operator's
//! actions.

use std::convert::Infallible;
use std::error::Error;
use std::iter::successors;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::{Bytes, to_bytes};
use axum::extract::{Path, Request, State};
use axum::http::StatusCode;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use cosurf_wire::DeviceId;
use futures_util::Stream;
use futures_util::stream::unfold;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::spawn_blocking;
use tokio::time::{sleep, timeout};

use super::action::{Act, Action};
use super::audit::Audit;
use super::board::Board;
use super::listen::Peer;
use super::metrics::{self, metrics};
use super::models::{Models, Served};
use super::pages::{html, live_page, spz_file, typed};
use super::site_map::Atlas;
use crate::service::old_revisions;

/// Largest number of readers of events.
const READERS_MAX: usize = 64;
/// Shortest time between two events for a reader.
const EVENT_EVERY: Duration = Duration::from_millis(500);
/// Time after which a reader of events is told that the server still lives.
const ALIVE_EVERY: Duration = Duration::from_secs(5);
/// Largest body of a request, bytes.
const BODY_BYTES_MAX: usize = 4096;
/// Time within which the body of a request must arrive.
const BODY_WITHIN: Duration = Duration::from_secs(5);

/// A running site for its routes.
#[derive(Clone)]
pub(super) struct Live {
    board: Board,
    act: Option<Act>,
    audit: Arc<Audit>,
    readers: Arc<Semaphore>,
    models: Models,
    atlas: Arc<Mutex<Atlas>>,
}

impl Live {
    /// Without `act` there are no actions.
    pub(super) fn new(board: Board, act: Option<Act>) -> Self {
        let audit = Arc::new(Audit::of(board.folder()));
        let readers = Arc::new(Semaphore::new(READERS_MAX));
        Self { board, act, audit, readers, models: Models::default(), atlas: Arc::default() }
    }

    /// The routes of the site.
    pub(super) fn routes(self) -> Router {
        let routes = Router::new()
            .route("/", get(page))
            .route("/api/state", get(state))
            .route("/api/events", get(events))
            .route("/api/map", get(map))
            .route("/metrics", get(show_metrics))
            .route("/scene.json", get(async |State(live): State<Live>| scene(live.newest().await)))
            .route("/first.spz", get(async |State(live): State<Live>| first(live.newest().await)))
            .route("/model.spz", get(async |State(live): State<Live>| spz(live.newest().await)))
            .route("/tiles/{revision}/{index}", get(tile))
            .route("/before/{shown}/scene.json", get(before_scene))
            .route("/before/{shown}/model.spz", get(before_spz));
        let routes = match self.act {
            Some(_) => routes
                .route("/api/forget", post(forget))
                .route("/api/revoke", post(revoke))
                .route("/api/restore", post(restore))
                .route("/api/revisions", get(revisions))
                .route("/api/merge", post(merge)),
            None => routes,
        };
        routes.with_state(self)
    }

    async fn newest(&self) -> Option<Served> {
        self.models.newest(&self.board).await
    }

    /// The revision before the one that a page shows.
    async fn before(&self, shown: u64) -> Option<Served> {
        self.models.before(&self.board, shown).await
    }

    /// Does the action that a request's body describes. `usage` tells how to describe one.
    async fn act_on<T: DeserializeOwned>(
        self,
        request: Request,
        by: Peer,
        action: impl FnOnce(T) -> Option<Action>,
        usage: &'static str,
    ) -> Response {
        let body = match body_of(request).await {
            Ok(body) => body,
            Err(refusal) => return refusal.into_response(),
        };
        match serde_json::from_slice(&body).ok().and_then(action) {
            Some(Action::Forget(device)) if !self.board.knows(&device) => {
                (StatusCode::NOT_FOUND, format!("the site knows no device {device}\n")).into_response()
            }
            Some(action) => self.act(action, by.0).await,
            None => (StatusCode::BAD_REQUEST, usage).into_response(),
        }
    }

    /// Does an action, and records it. An action that cannot be recorded is not done.
    async fn act(self, action: Action, by: IpAddr) -> Response {
        let work = move || {
            let Some(act) = &self.act else { return StatusCode::NOT_FOUND.into_response() };
            let failed = |status, error: String| (status, format!("{error}\n")).into_response();
            if let Err(error) = self.audit.note(by, &action, "asked for") {
                return failed(
                    StatusCode::INTERNAL_SERVER_ERROR,
                    format!("not done, as it is not recorded: {error}"),
                );
            }
            let done = act(&action);
            let outcome = done.as_ref().map_or_else(|error| format!("failed: {error}"), |()| "done".into());
            let recorded = self.audit.note(by, &action, &outcome);
            self.board.note_line(&format!("the operator at {by} asks to {action}: {outcome}"));
            match (done, recorded) {
                (Ok(()), Ok(())) => StatusCode::NO_CONTENT.into_response(),
                (Ok(()), Err(error)) => failed(StatusCode::INTERNAL_SERVER_ERROR, error.to_string()),
                (Err(error), _) => failed(StatusCode::CONFLICT, error),
            }
        };
        spawn_blocking(work).await.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR.into_response())
    }
}

async fn page(State(live): State<Live>) -> Response {
    html(live_page(live.board.revision(), live.act.is_some()))
}

async fn before_scene(State(live): State<Live>, Path(shown): Path<u64>) -> Result<Response, StatusCode> {
    scene(live.before(shown).await)
}

async fn before_spz(State(live): State<Live>, Path(shown): Path<u64>) -> Result<Response, StatusCode> {
    spz(live.before(shown).await)
}

fn json(value: &impl Serialize) -> Response {
    typed("application/json", serde_json::to_string(value).expect("numbers and texts"))
}

async fn state(State(live): State<Live>) -> Response {
    json(&live.board.state())
}

async fn show_metrics(State(live): State<Live>) -> Response {
    typed(metrics::CONTENT_TYPE, metrics(&live.board.state()))
}

async fn map(State(live): State<Live>) -> Response {
    let work = move || {
        let mut atlas = live.atlas.lock().unwrap_or_else(PoisonError::into_inner);
        json(&atlas.map(live.board.folder(), &live.board.models()))
    };
    spawn_blocking(work).await.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR.into_response())
}

fn scene(model: Option<Served>) -> Result<Response, StatusCode> {
    model.map(|model| typed("application/json", model.scene)).ok_or(StatusCode::NOT_FOUND)
}

fn first(model: Option<Served>) -> Result<Response, StatusCode> {
    model.and_then(|model| model.first).map(spz_file).ok_or(StatusCode::NOT_FOUND)
}

fn spz(model: Option<Served>) -> Result<Response, StatusCode> {
    model.map(|model| spz_file(model.spz)).ok_or(StatusCode::NOT_FOUND)
}

/// A tile of the newest revision.
async fn tile(
    State(live): State<Live>,
    Path((revision, index)): Path<(u64, usize)>,
) -> Result<Response, StatusCode> {
    live.models.tile(revision, index).await.map(spz_file).ok_or(StatusCode::NOT_FOUND)
}

/// The state of the site, and then what changes of it.
async fn events(State(live): State<Live>) -> Response {
    let Ok(permit) = live.readers.clone().try_acquire_owned() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many readers of events\n").into_response();
    };
    let alive = Event::default().event("alive").data("");
    let keep_alive = KeepAlive::new().interval(ALIVE_EVERY).event(alive);
    Sse::new(states(live.board, permit)).keep_alive(keep_alive).into_response()
}

/// A reader of events.
struct Reader {
    board: Board,
    changes: watch::Receiver<u64>,
    /// The newest change that it has been told; 0 before the first event.
    seen: u64,
    /// Its place among the readers.
    _permit: OwnedSemaphorePermit,
}

/// The events of a reader. The next one is made once the connection has taken the one before, so it sums up all that a slow
/// reader has missed.
fn states(board: Board, permit: OwnedSemaphorePermit) -> impl Stream<Item = Result<Event, Infallible>> {
    let changes = board.changes();
    let reader = Reader { board, changes, seen: 0, _permit: permit };
    unfold(reader, |mut reader| async {
        if reader.seen > 0 {
            sleep(EVENT_EVERY).await;
            reader.changes.changed().await.ok()?;
        }
        reader.changes.mark_unchanged();
        let (state, seen) = reader.board.state_since(reader.seen);
        reader.seen = seen;
        let text = serde_json::to_string(&state).ok()?;
        Some((Ok(Event::default().event("state").data(text)), reader))
    })
}

/// The body of a request to forget a device.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ForgetRequest {
    device: String,
}

/// The body of a request to revoke a device.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RevokeRequest {
    device: String,
    /// Whether to withdraw its models as well.
    forget: bool,
}

/// The body of a request to restore a revision.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RestoreRequest {
    revision: u64,
}

async fn forget(State(live): State<Live>, Extension(by): Extension<Peer>, request: Request) -> Response {
    let action = |asked: ForgetRequest| Some(Action::Forget(DeviceId::new(&asked.device).ok()?));
    live.act_on(request, by, action, "send {\"device\": \"NAME\"}\n").await
}

async fn revoke(State(live): State<Live>, Extension(by): Extension<Peer>, request: Request) -> Response {
    let action = |RevokeRequest { device, forget }| {
        Some(Action::Revoke { device: DeviceId::new(&device).ok()?, forget })
    };
    live.act_on(request, by, action, "send {\"device\": \"NAME\", \"forget\": false}\n").await
}

async fn restore(State(live): State<Live>, Extension(by): Extension<Peer>, request: Request) -> Response {
    let action = |asked: RestoreRequest| Some(Action::Restore(asked.revision));
    live.act_on(request, by, action, "send {\"revision\": NUMBER}\n").await
}

/// The revisions that can be restored.
async fn revisions(State(live): State<Live>) -> Response {
    let work = move || match old_revisions(live.board.folder()) {
        Ok(revisions) => json(&revisions),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    };
    spawn_blocking(work).await.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR.into_response())
}

async fn merge(State(live): State<Live>, Extension(by): Extension<Peer>, request: Request) -> Response {
    match body_of(request).await {
        Ok(body) if body.is_empty() => live.act(Action::Merge, by.0).await,
        Ok(_) => (StatusCode::BAD_REQUEST, "send no body\n").into_response(),
        Err(refusal) => refusal.into_response(),
    }
}

/// The body of a request, or the answer if it is too large or comes too slowly.
async fn body_of(request: Request) -> Result<Bytes, (StatusCode, &'static str)> {
    let body = timeout(BODY_WITHIN, to_bytes(request.into_body(), BODY_BYTES_MAX));
    let slow = |_| (StatusCode::REQUEST_TIMEOUT, "the body of the request came too slowly\n");
    body.await.map_err(slow)?.map_err(|error| match is_broken(&error) {
        true => (StatusCode::BAD_REQUEST, "the body of the request is broken\n"),
        false => (StatusCode::PAYLOAD_TOO_LARGE, "the body of the request is too large\n"),
    })
}

/// Whether a body could not be read, because a chunk is broken or the connection has ended. Otherwise it is too large.
fn is_broken(error: &axum::Error) -> bool {
    let first: &(dyn Error + 'static) = error;
    successors(Some(first), |error| (*error).source()).any(|error| error.is::<hyper::Error>())
}
