//! What there is to see and to do on a running site: its state, events, metrics, the newest model, and the operator's
//! actions.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Bytes, to_bytes};
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use cosurf_wire::DeviceId;
use futures_util::Stream;
use futures_util::stream::unfold;
use serde::Deserialize;
use tokio::sync::{Mutex, OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::spawn_blocking;
use tokio::time::sleep;

use super::board::Board;
use super::metrics::{self, metrics};
use super::pages::{html, live_page, typed};
use crate::viewer::{Room, Walkable};

/// Largest number of readers of events.
const READERS_MAX: usize = 32;
/// Shortest time between two events for a reader.
const EVENT_EVERY: Duration = Duration::from_millis(500);
/// Time after which a reader of events is told that the server still lives.
const ALIVE_EVERY: Duration = Duration::from_secs(15);
/// Largest body of a request, bytes.
const BODY_BYTES_MAX: usize = 4096;
/// What the model of the page may take.
const ROOM: Room = Room { memory_bytes: Some(128 << 20), file_bytes: Some(32 << 20) };

/// Withdraws a device at the operator's request. The error is one line for the operator.
pub type Forget = Arc<dyn Fn(&DeviceId) -> Result<(), String> + Send + Sync>;

/// A running site for its routes.
#[derive(Clone)]
pub(super) struct Live {
    board: Board,
    forget: Option<Forget>,
    readers: Arc<Semaphore>,
    /// The newest model that was asked for, with its revision.
    model: Arc<Mutex<Option<(u64, Served)>>>,
}

/// A model as it is served.
#[derive(Clone)]
struct Served {
    scene: Bytes,
    spz: Bytes,
}

impl Live {
    /// Without `forget` there are no actions.
    pub(super) fn new(board: Board, forget: Option<Forget>) -> Self {
        Self { board, forget, readers: Arc::new(Semaphore::new(READERS_MAX)), model: Arc::default() }
    }

    /// The routes of the site.
    pub(super) fn routes(self) -> Router {
        let routes = Router::new()
            .route("/", get(page))
            .route("/api/state", get(state))
            .route("/api/events", get(events))
            .route("/metrics", get(show_metrics))
            .route("/scene.json", get(scene))
            .route("/model.spz", get(spz));
        let routes = match self.forget {
            Some(_) => routes.route("/api/forget", post(forget)),
            None => routes,
        };
        routes.with_state(self)
    }

    /// The newest model; `None` if there is none, or if it cannot be shown.
    async fn model(&self) -> Option<Served> {
        let revision = self.board.revision()?;
        // Held while the model is read, so that several readers do not read it at once.
        let mut known = self.model.lock().await;
        if let Some((of, served)) = known.as_ref()
            && *of == revision
        {
            return Some(served.clone());
        }
        let folder = self.board.folder().to_owned();
        let model = spawn_blocking(move || Walkable::read(&folder, ROOM)).await.ok()?;
        let model =
            model.inspect_err(|error| self.board.note_line(&format!("no model to show: {error}"))).ok()?;
        let scene = Bytes::from(model.scene_json());
        let served = Served { scene, spz: model.into_spz().into() };
        *known = Some((revision, served.clone()));
        Some(served)
    }

    /// Withdraws a device, and logs it.
    fn withdraw(&self, device: &DeviceId) -> Response {
        let Some(forget) = &self.forget else { return StatusCode::NOT_FOUND.into_response() };
        let done = forget(device);
        let outcome = done.as_ref().map_or_else(|error| format!("failed: {error}"), |()| "done".into());
        self.board.note_line(&format!("the operator forgets {device}: {outcome}"));
        match done {
            Ok(()) => StatusCode::NO_CONTENT.into_response(),
            Err(error) => (StatusCode::CONFLICT, format!("{error}\n")).into_response(),
        }
    }
}

async fn page(State(live): State<Live>) -> Response {
    html(live_page(live.board.revision(), live.forget.is_some()))
}

async fn state(State(live): State<Live>) -> Response {
    let text = serde_json::to_string(&live.board.state()).expect("numbers and texts");
    typed("application/json", text)
}

async fn show_metrics(State(live): State<Live>) -> Response {
    typed(metrics::CONTENT_TYPE, metrics(&live.board.state()))
}

async fn scene(State(live): State<Live>) -> Response {
    let model = live.model().await;
    model.map_or(StatusCode::NOT_FOUND.into_response(), |model| typed("application/json", model.scene))
}

async fn spz(State(live): State<Live>) -> Response {
    let model = live.model().await;
    model.map_or(StatusCode::NOT_FOUND.into_response(), |model| typed("application/octet-stream", model.spz))
}

/// The state of the site, again after each change.
async fn events(State(live): State<Live>) -> Response {
    let Ok(permit) = live.readers.clone().try_acquire_owned() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many readers of events\n").into_response();
    };
    let keep_alive = KeepAlive::new().interval(ALIVE_EVERY);
    Sse::new(states(live.board, permit)).keep_alive(keep_alive).into_response()
}

/// A reader of events.
struct Reader {
    board: Board,
    changes: watch::Receiver<u64>,
    is_first: bool,
    /// Its place among the readers.
    _permit: OwnedSemaphorePermit,
}

fn states(board: Board, permit: OwnedSemaphorePermit) -> impl Stream<Item = Result<Event, Infallible>> {
    let changes = board.changes();
    let reader = Reader { board, changes, is_first: true, _permit: permit };
    unfold(reader, |mut reader| async {
        if !std::mem::take(&mut reader.is_first) {
            sleep(EVENT_EVERY).await;
            reader.changes.changed().await.ok()?;
        }
        reader.changes.mark_unchanged();
        let text = serde_json::to_string(&reader.board.state()).ok()?;
        Some((Ok(Event::default().event("state").data(text)), reader))
    })
}

/// The body of a request to forget a device.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ForgetRequest {
    device: String,
}

async fn forget(State(live): State<Live>, request: Request) -> Response {
    let Ok(body) = to_bytes(request.into_body(), BODY_BYTES_MAX).await else {
        return StatusCode::PAYLOAD_TOO_LARGE.into_response();
    };
    let asked = serde_json::from_slice::<ForgetRequest>(&body).ok();
    match asked.and_then(|asked| DeviceId::new(&asked.device).ok()) {
        Some(device) => live.withdraw(&device),
        None => (StatusCode::BAD_REQUEST, "send {\"device\": \"NAME\"}\n").into_response(),
    }
}
