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
                           .viewer{height:100vh;height:100dvh;border-radius:0}";

/// The page of a model.
pub(super) fn model_page(title: &str) -> String {
    let body = format!("<body><main>{}</main><script src=\"/viewer.js\"></script></body>", viewer::SECTION);
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
        .route("/live.js", file(js, include_str!("live.js").to_owned()))
        .route("/live.css", file(css, format!("{}{}", include_str!("live.css"), viewer::STYLE)))
}

/// An answer with a page.
pub(super) fn html(text: String) -> Response {
    typed("text/html; charset=utf-8", text)
}

/// An answer of this type.
pub(super) fn typed(content_type: &'static str, body: impl IntoResponse) -> Response {
    ([(CONTENT_TYPE, content_type)], body).into_response()
}
