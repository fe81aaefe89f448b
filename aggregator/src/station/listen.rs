//! The server: accepts connections and bounds what each of them may take. A connection serves one request, so that an idle
//! one never outlives the time for a request's head; it ends earlier if another needs its place.

use std::cell::Cell;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{sleep, timeout};

use super::error::StationError;
use super::waiting::{Place, Waiting};

/// Largest number of connections. A further one takes the place of one whose request has not arrived, or is closed at once.
/// A page needs two, a browser opens up to six.
const CONNECTIONS_MAX: usize = 128;
/// Time within which the head of a request must arrive.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// Time after which a connection ends, whatever it does. A browser opens a new one for its events.
const CONNECTION_MAX: Duration = Duration::from_secs(900);
/// Largest head of a request, bytes. Hyper takes no less.
const HEAD_BYTES_MAX: usize = 8192;
/// Largest number of headers of a request.
const HEADERS_MAX: usize = 64;
/// Pause after an error of the system, for example if it has no more sockets.
const PAUSE: Duration = Duration::from_millis(50);

/// Where a request came from: the address of a browser or script, or of the proxy in front of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub(super) IpAddr);

/// A running server. It ends when this value is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    runtime: Option<Runtime>,
}

impl Server {
    /// Binds the address and serves the routes on a thread of its own.
    pub(super) fn start(address: SocketAddr, routes: Router) -> Result<Self, StationError> {
        let failed = |cause| StationError::Address { address, cause };
        let runtime = Builder::new_multi_thread().worker_threads(1).thread_name("http").enable_all().build();
        let runtime = runtime.map_err(StationError::Threads)?;
        let listener = runtime.block_on(TcpListener::bind(address)).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        runtime.spawn(accept(listener, routes));
        Ok(Self { address, runtime: Some(runtime) })
    }

    /// The address that is bound, with its port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn accept(listener: TcpListener, routes: Router) {
    let room = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    let waiting = Waiting::default();
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            sleep(PAUSE).await;
            continue;
        };
        let Some(permit) = permit(&room, &waiting).await else { continue };
        let routes = routes.clone().layer(Extension(Peer(from.ip())));
        waiting.add(from.ip(), |place| {
            tokio::spawn(async move {
                let _ = timeout(CONNECTION_MAX, serve(stream, routes, place)).await;
                drop(permit);
            })
        });
    }
}

/// A permit for a connection; `None` if the server is full and no connection can make room.
async fn permit(room: &Arc<Semaphore>, waiting: &Waiting) -> Option<OwnedSemaphorePermit> {
    if let Ok(permit) = room.clone().try_acquire_owned() {
        return Some(permit);
    }
    // The connection that ends gives its permit back.
    if waiting.make_room() { room.clone().acquire_owned().await.ok() } else { None }
}

/// Serves one request. Once it has arrived, the connection no longer waits. Errors are those of the other end, which nobody
/// can mend here.
async fn serve(stream: TcpStream, routes: Router, place: Place) {
    let (routes, place) = (TowerToHyperService::new(routes), Cell::new(Some(place)));
    let service = service_fn(move |request| {
        drop(place.take());
        routes.call(request)
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_WITHIN)
        .max_buf_size(HEAD_BYTES_MAX)
        .max_headers(HEADERS_MAX)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), service);
    let _ = connection.await;
}
