//! The pages, and answers of one type.

use axum::Router;
use axum::body::Bytes;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use crate::report::escape;
use crate::viewer;

/// Styles of a page that only shows a model.
const MODEL_STYLE: &str = "html,body{margin:0;height:100%;background:#000;font:16px/1.5 system-ui,sans-serif}\
                           .viewer{height:100vh;height:100dvh;border-radius:0}\
                           h1{position:absolute;margin:0;clip-path:inset(50%)}";

/// The files of the live page's script, in an order in which each one uses only those before it.
const LIVE_SCRIPTS: [&str; 3] =
    [include_str!("live/rows.js"), include_str!("live/map.js"), include_str!("live/live.js")];

/// The page of a model.
pub(super) fn model_page(title: &str) -> String {
    // The heading is for screen readers: the model takes the whole page.
    let body = format!(
        "<body><main><h1>{}</h1>{}</main><script src=\"/viewer.js\"></script></body>",
        escape(title),
        viewer::SECTION
    );
    page(title, "model", &body)
}

/// The page of a running site, with the model if there is a revision. `acts` tells whether the operator can act.
pub(super) fn live_page(revision: Option<u64>, acts: bool) -> String {
    let (viewer, script) = match revision {
        Some(_) => (viewer::SECTION, "<script src=\"/viewer.js\"></script>"),
        None => ("", ""),
    };
    let main = include_str!("live.html").replace("VIEWER", viewer);
    let revision = revision.map_or_else(String::new, |revision| revision.to_string());
    let acts = if acts { "yes" } else { "" };
    let body = format!(
        "<body data-revision=\"{revision}\" data-acts=\"{acts}\">\n{main}{script}<script src=\"/live.js\"></script></body>"
    );
    page("cosurf ground station", "live", &body)
}

/// A page with this title, style sheet and body.
fn page(title: &str, style: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"><title>{}</title>\
         <link rel=\"icon\" href=\"data:,\"><link rel=\"stylesheet\" href=\"/{style}.css\"></head>\n{body}</html>\n",
        escape(title)
    )
}

/// The scripts and style sheets of all pages.
pub(super) fn files() -> Router {
    let file = |content_type, text: String| {
        let text = Bytes::from(text);
        get(move || async move { typed(content_type, text) })
    };
    let [css, js] = ["text/css; charset=utf-8", "text/javascript; charset=utf-8"];
    Router::new()
        .route("/viewer.js", file(js, viewer::script()))
        .route("/model.css", file(css, format!("{}{MODEL_STYLE}", viewer::STYLE)))
        .route("/live.js", file(js, live_script()))
        .route("/live.css", file(css, format!("{}{}", include_str!("live.css"), viewer::STYLE)))
}

/// The script of the live page, with the viewer's geometry.
fn live_script() -> String {
    format!("'use strict';\n(() => {{\n{}{}}})();\n", viewer::GEOMETRY.concat(), LIVE_SCRIPTS.concat())
}

/// An answer with a page.
pub(super) fn html(text: String) -> Response {
    typed("text/html; charset=utf-8", text)
}

/// An answer with splats.
pub(super) fn spz_file(spz: Bytes) -> Response {
    typed("application/octet-stream", spz)
}

/// An answer of this type.
pub(super) fn typed(content_type: &'static str, body: impl IntoResponse) -> Response {
    ([(CONTENT_TYPE, content_type)], body).into_response()
}
