//! Reads the cameras of Agisoft Metashape: *File, Export, Export Cameras* as XML.
//!
//! Lenses are those of the manual of Metashape Professional 2.2, appendix *Camera models*; its P1 and P2 are p2 and p1 of
//! OpenCV. Poses are `chunk_from_cam` with the axes of [`crate::camera`]. The transform of the camera's component, or of the
//! chunk, takes them to the world: earth-centred (ECEF) if the chunk has a geographic or projected reference, else local.
//!
//! What it knows nothing about: coordinate systems other than by their kind.

use std::collections::HashMap;
use std::path::Path;

use glam::{DMat3, DQuat, DVec2, DVec3};
use roxmltree::{Document, Node};

use crate::error::Refusal;
use crate::lens::{Distortion, FullBrown, Lens};
use crate::rotation::{from_rows, is_rotation};
use crate::shot::{Shot, find_picture, picture_folder};
use crate::xml::{attribute, child, numbers, text, value};
use crate::{Pose, SceneError, xml};

/// What the chunk's world is, and its cameras.
#[derive(Debug, PartialEq)]
pub(crate) struct Cameras {
    /// The pictures with poses, in the file's order.
    pub(crate) shots: Vec<Shot>,
    /// Whether the world is the earth-centred, earth-fixed frame (ECEF), metres.
    pub(crate) is_geocentric: bool,
}

/// Whether a file's beginning is that of such an export.
pub(crate) fn is_one(head: &str) -> bool {
    head.contains("<document") && head.contains("<chunk")
}

/// Reads the file `path`. The pictures are in `images` beside it, or beside it; they may be missing.
pub(crate) fn read(path: &Path) -> Result<Cameras, SceneError> {
    let text = xml::read(path)?;
    let parse = || cameras(&xml::parse(&text)?, &picture_folder(path));
    parse().map_err(|refusal: Refusal| refusal.of(path))
}

fn cameras(document: &Document, folder: &Path) -> Result<Cameras, Refusal> {
    let chunk = document.descendants().find(|node| node.has_tag_name("chunk"));
    let chunk = chunk.ok_or("has no chunk; export the cameras of Metashape again, as XML")?;
    let sensors = by_id(chunk, "sensors", "sensor")?;
    let components = by_id(chunk, "components", "component")?;
    let whole = placement(chunk)?;
    let mut shots = Vec::new();
    let listed = child(chunk, "cameras").into_iter().flat_map(|cameras| cameras.descendants());
    for camera in listed.filter(|node| node.has_tag_name("camera")) {
        // Cameras without a transform were not aligned.
        let Some(matrix) = text(camera, "transform") else { continue };
        let label = attribute(camera, "label")?;
        let shot = || {
            let sensor =
                sensors.get(attribute(camera, "sensor_id")?).ok_or("names a sensor that the file lacks")?;
            let component = camera.attribute("component_id").and_then(|id| components.get(id));
            let placed = component.map_or(Ok(None), |component| placement(*component))?.or(whole);
            let (name, path) = find_picture(folder, label);
            let cam_from_world = pose(matrix, placed.unwrap_or(Placement::NONE))?;
            Ok(Shot { name, path, cam_from_world, lens: lens(*sensor)? })
        };
        shots.push(
            shot().map_err(|refusal: Refusal| refusal.at(format_args!("camera {}", label.escape_debug())))?,
        );
    }
    if shots.is_empty() {
        return Err(
            "has no camera with a transform; align the photographs in Metashape, and export again".into()
        );
    }
    let has_placement =
        whole.is_some() || components.values().any(|one| matches!(placement(*one), Ok(Some(_))));
    let is_local = text(chunk, "reference").is_none_or(|wkt| wkt.trim_start().starts_with("LOCAL_CS"));
    Ok(Cameras { shots, is_geocentric: has_placement && !is_local })
}

/// The elements of a list by their attribute `id`.
fn by_id<'a>(chunk: Node<'a, 'a>, list: &str, kind: &str) -> Result<HashMap<&'a str, Node<'a, 'a>>, Refusal> {
    let elements = child(chunk, list).into_iter().flat_map(|list| list.children());
    elements.filter(|node| node.has_tag_name(kind)).map(|node| Ok((attribute(node, "id")?, node))).collect()
}

/// Where a chunk or a component lies: `p_world = scale * rotation * p + translation`.
#[derive(Clone, Copy)]
struct Placement {
    scale: f64,
    rotation: DMat3,
    translation: DVec3,
}

impl Placement {
    const NONE: Self = Self { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
}

/// The placement of a chunk or component; `None` if it has none.
fn placement(node: Node) -> Result<Option<Placement>, Refusal> {
    let Some(transform) = child(node, "transform") else { return Ok(None) };
    let [Some(rotation), Some(translation)] = ["rotation", "translation"].map(|name| text(transform, name))
    else {
        return Ok(None); // a chunk that is not placed has an empty transform
    };
    let rotation = from_rows(&numbers::<9>(rotation)?);
    let translation = DVec3::from(numbers::<3>(translation)?);
    let scale = value(transform, "scale")?.unwrap_or(1.0);
    match is_rotation(&rotation) && scale > 0.0 {
        true => Ok(Some(Placement { scale, rotation, translation })),
        false => {
            Err("the transform of its chunk or component is not a rotation, translation and scale".into())
        }
    }
}

fn pose(matrix: &str, placed: Placement) -> Result<Pose, Refusal> {
    let m = numbers::<16>(matrix)?;
    let chunk_from_cam = from_rows(&[m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    if !(is_rotation(&chunk_from_cam) && m[12..] == [0.0, 0.0, 0.0, 1.0]) {
        return Err("its transform is not a rotation and translation".into());
    }
    let center = placed.scale * (placed.rotation * DVec3::new(m[3], m[7], m[11])) + placed.translation;
    let rotation = DQuat::from_mat3(&(placed.rotation * chunk_from_cam).transpose()).normalize();
    Ok(Pose { rotation, translation: -(rotation * center) })
}

fn lens(sensor: Node) -> Result<Lens, Refusal> {
    let kind = sensor.attribute("type").unwrap_or("frame");
    let calibrations = || sensor.children().filter(|node| node.has_tag_name("calibration"));
    // Later ones are adjusted; the first may be that of the EXIF data.
    let calibration = calibrations()
        .find(|node| node.attribute("class") == Some("adjusted"))
        .or(calibrations().next_back());
    let calibration =
        calibration.ok_or("its sensor has no calibration; align the photographs, and export again")?;
    let of = |name: &str| Ok::<f64, Refusal>(value(calibration, name)?.unwrap_or(0.0));
    let resolution = child(calibration, "resolution").or(child(sensor, "resolution"));
    let resolution = resolution.ok_or("its sensor has no resolution")?;
    let side = |name| {
        let text = attribute(resolution, name)?;
        text.parse::<u32>().map_err(|_| Refusal::from("its resolution is not two whole numbers"))
    };
    let size_px = [side("width")?, side("height")?];
    let radial = [of("k1")?, of("k2")?, of("k3")?, of("k4")?];
    let [p1, p2, p3, p4, b2] = [of("p1")?, of("p2")?, of("p3")?, of("p4")?, of("b2")?];
    let focal_px = DVec2::new(of("f")? + of("b1")?, of("f")?);
    let distortion = match kind {
        "frame" => {
            let (tangential, growth, skew) = ([p2, p1], [p3, p4], b2 / focal_px.x);
            Distortion::brown(FullBrown { radial, tangential, growth, skew })
        }
        "fisheye" if [p1, p2, p3, p4, b2] == [0.0; 5] => Distortion::Fisheye(radial),
        "fisheye" => {
            return Err("a coefficient p1 to p4 or b2 of its fisheye is not supported; let Metashape optimise the cameras without it, or export undistorted photographs".into());
        }
        _ => return Err(format!("its lens of the type {} is not supported", kind.escape_debug()).into()),
    };
    let center_px = 0.5 * DVec2::from(size_px.map(f64::from)) + DVec2::new(of("cx")?, of("cy")?);
    Lens { focal_px, center_px, size_px, distortion }.checked()
}
