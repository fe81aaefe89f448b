//! The viewer: a model that people walk through in a browser, with plain JavaScript and WebGL 2. The files in `viewer/` are
//! part of this program, so a page needs nothing from elsewhere.
//!
//! What it knows nothing about: the pages that show it. A page has [`STYLE`] in its head and [`SECTION`] in its body, and
//! runs [`script()`] at its end. The model is either part of the page ([`embedded`]) or beside it, as `scene.json` and
//! `model.spz`.
//!
//! Where to start reading: [`Walkable`], a model for the viewer; then `viewer/view.js`, which lists the parts in the browser.

mod error;
mod lie;
mod model;
mod room;

pub use error::WalkableError;
pub(crate) use lie::{ground_axes, up_of};
pub use model::Walkable;
pub use room::{FIRST_SPLATS, Room};

/// The viewer's part of a page's style sheet.
pub(crate) const STYLE: &str = include_str!("viewer/viewer.css");

/// The viewer's part of a page's body.
pub(crate) const SECTION: &str = include_str!("viewer/viewer.html");

/// The files of the viewer that compute with points and cameras, without drawing.
pub(crate) const GEOMETRY: [&str; 2] = [include_str!("viewer/walk.js"), include_str!("viewer/places.js")];

/// The files of the viewer, in an order in which each one uses only those before it.
const SCRIPTS: [&str; 12] = [
    include_str!("viewer/decode.js"),
    include_str!("viewer/marks.js"),
    include_str!("viewer/sort.js"),
    include_str!("viewer/shaders.js"),
    include_str!("viewer/draw.js"),
    include_str!("viewer/walk.js"),
    include_str!("viewer/places.js"),
    include_str!("viewer/profile.js"),
    include_str!("viewer/compare.js"),
    include_str!("viewer/tiles.js"),
    include_str!("viewer/input.js"),
    include_str!("viewer/view.js"),
];

/// The viewer's script. It starts the viewer of the page, and leaves the promise of it in `globalThis.cosurf`.
pub(crate) fn script() -> String {
    format!("'use strict';\n(() => {{\n{}}})();\n", SCRIPTS.concat())
}

/// The end of a page that contains its model: the model, the scene and the script, as elements.
pub(crate) fn embedded(model: &Walkable, base64: impl Fn(&[u8]) -> String) -> String {
    // In JSON, a `<` can stand only in texts. Escaped, it cannot end the element.
    let scene = model.scene_json().replace('<', "\\u003c");
    format!(
        "<script type=\"application/json\" id=\"viewer-scene\">{scene}</script>\n\
         <script type=\"text/plain\" id=\"viewer-model\">{}</script>\n<script>{}</script>\n",
        base64(model.spz()),
        script()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A page puts the script into an element, and promises that it loads nothing from elsewhere.
    #[test]
    fn the_script_ends_no_element_and_names_no_other_address() {
        let script = script();
        for part in ["</script", "<!--", "http:", "https:", "import(", "eval("] {
            let without_svg = script.replace("http://www.w3.org/2000/svg", "");
            assert!(!without_svg.contains(part), "{part}");
        }
        assert!(script.len() < 80 << 10, "{} bytes", script.len());
    }

    /// The shaders repeat constants of the engine. `tests/tests/viewer.rs` compares whole pictures, but runs only where
    /// there is a browser.
    #[test]
    fn the_shaders_have_the_constants_of_the_engine() {
        let shaders = include_str!("viewer/shaders.js");
        for constant in [
            "NEAR = 0.2;",
            "LINEARISATION_MARGIN = 0.15;",
            "LOW_PASS_PX2 = 0.3;",
            "ALPHA_MIN = 1.0 / 255.0;",
            "ALPHA_MAX = 0.99;",
            "SURFACE_ALPHA = 0.5;",
            "GRAZING = 0.01;",
        ] {
            assert!(shaders.contains(constant), "{constant}");
        }
    }
}
