//! What there is to see: the page of a model, and the files of the viewer.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::extract::DefaultBodyLimit;
use axum::http::header::CONTENT_TYPE;
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Router, body::Bytes};

use super::error::StationError;
use super::guard::{Guard, protect};
use super::listen::Server;
use super::token::Token;
use crate::viewer::{self, Walkable};

/// Largest body of a request, bytes.
const BODY_BYTES_MAX: usize = 4096;
/// Styles of a page that only shows a model.
const STYLE: &str = "html,body{margin:0;height:100%;background:#000;font:16px/1.5 system-ui,sans-serif}\
                     .viewer{height:100vh;height:100dvh;border-radius:0}";

/// Serves one model until the server is dropped. Beyond this computer, `token` must be shown.
pub fn serve_model(address: SocketAddr, token: &Token, model: Walkable) -> Result<Server, StationError> {
    let scene = model.scene_json();
    let title = model.name().to_owned();
    let spz = Bytes::from(model.into_spz());
    let page: Arc<str> = page_of(&title).into();
    let routes = Router::new()
        .route("/", get(move || async move { html(page.to_string()) }))
        .route("/scene.json", get(move || async move { typed("application/json", scene) }))
        .route("/model.spz", get(move || async move { typed("application/octet-stream", spz) }));
    Server::start(address, guarded(routes.merge(viewer_files()), address, token))
}

/// The page of a model.
fn page_of(title: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"><title>{}</title>\
         <link rel=\"icon\" href=\"data:,\"><link rel=\"stylesheet\" href=\"/viewer.css\"></head>\n\
         <body><main>{}</main><script src=\"/viewer.js\"></script></body></html>\n",
        crate::report::escape(title),
        viewer::SECTION
    )
}

/// The script and the style sheet of the viewer.
fn viewer_files() -> Router {
    let script = Bytes::from(viewer::script());
    let style = Bytes::from(format!("{}{STYLE}", viewer::STYLE));
    Router::new()
        .route("/viewer.js", get(move || async move { typed("text/javascript; charset=utf-8", script) }))
        .route("/viewer.css", get(move || async move { typed("text/css; charset=utf-8", style) }))
}

/// Puts the guard in front of routes.
fn guarded(routes: Router, address: SocketAddr, token: &Token) -> Router {
    let guard = Guard { token: token.clone(), is_local: address.ip().is_loopback() };
    routes.layer(DefaultBodyLimit::max(BODY_BYTES_MAX)).layer(from_fn_with_state(guard, protect))
}

fn html(text: String) -> Response {
    typed("text/html; charset=utf-8", text)
}

fn typed(content_type: &'static str, body: impl IntoResponse) -> Response {
    ([(CONTENT_TYPE, content_type)], body).into_response()
}
