//! Starts the server: for one model, or for a running site.

use std::net::SocketAddr;

use axum::Router;
use axum::body::Bytes;
use axum::http::StatusCode;
use axum::middleware::from_fn_with_state;
use axum::routing::get;

use super::action::Act;
use super::board::Board;
use super::error::StationError;
use super::guard::{Guard, protect};
use super::listen::Server;
use super::live::Live;
use super::pages::{files, model_page, spz_file, typed};
use super::refusals::Refusals;
use super::token::Token;
use crate::viewer::Walkable;

/// Serves one model until the server is dropped. Beyond this computer, `token` must be shown.
pub fn serve_model(address: SocketAddr, token: &Token, model: Walkable) -> Result<Server, StationError> {
    let page = Bytes::from(model_page(model.name()));
    let scene = Bytes::from(model.scene_json());
    let first = model.first().map(Bytes::copy_from_slice);
    let spz = Bytes::from(model.into_spz());
    let routes = Router::new()
        .route("/", get(move || async move { typed("text/html; charset=utf-8", page) }))
        .route("/scene.json", get(move || async move { typed("application/json", scene) }))
        .route("/first.spz", get(move || async move { first.map(spz_file).ok_or(StatusCode::NOT_FOUND) }))
        .route("/model.spz", get(move || async move { spz_file(spz) }));
    start(address, token, routes, Refusals::new(|_| ()))
}

/// Serves a running site until the server is dropped. Without `act` there are no actions. Beyond this computer, `token` must be
/// shown, and for actions always.
pub fn serve_site(
    address: SocketAddr,
    token: &Token,
    board: Board,
    act: Option<Act>,
) -> Result<Server, StationError> {
    let log = board.clone();
    let refusals = Refusals::new(move |line| log.note_line(line));
    start(address, token, Live::new(board, act).routes(), refusals)
}

/// Starts the server with these routes, those of the files, and a guard in front of all.
fn start(
    address: SocketAddr,
    token: &Token,
    routes: Router,
    refusals: Refusals,
) -> Result<Server, StationError> {
    let guard = Guard { token: token.clone(), is_local: address.ip().is_loopback(), refusals };
    let routes = routes.merge(files()).layer(from_fn_with_state(guard, protect));
    // For programs that watch whether the server lives. It tells nothing else, and needs no token.
    Server::start(address, routes.route("/healthz", get(|| async { "ok\n" })))
}
