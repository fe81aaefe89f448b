//! The XMP files that RealityCapture writes beside the photographs.
//!
//! `Rotation` is `cam_from_world`, row by row, with the axes of [`crate::camera`]; `Position` is the camera's centre. Each
//! quantity is an attribute or an element.

use std::path::Path;

use glam::{DQuat, DVec2, DVec3};
use roxmltree::Node;

use super::film::FilmLens;
use crate::error::Refusal;
use crate::rotation::{from_rows, is_rotation};
use crate::shot::{Shot, find_picture};
use crate::xml::{child, numbers};
use crate::{Pose, SceneError, xml};

/// The namespace of RealityCapture's names.
pub(super) const NAMESPACE: &str = "http://www.capturingreality.com/ns/xcr/";
/// Models of lenses that are read: none of distortion, and Brown's with three or four radial and up to two tangential
/// coefficients. The others are *division* and two rational ones.
const MODELS: [&str; 5] = ["perspective", "brown3", "brown4", "brown3t2", "brown4t2"];

/// Reads a file; `None` if it has no pose. The picture lies beside it, with the same name but for its extension.
pub(super) fn read(path: &Path) -> Result<Option<Shot>, SceneError> {
    let text = xml::read(path)?;
    let parse = || {
        let document = xml::parse(&text)?;
        let description = document.descendants().find(|node| node.tag_name().name() == "Description");
        description.map_or(Ok(None), |description| shot(description, path))
    };
    parse().map_err(|refusal: Refusal| refusal.of(path))
}

/// The text of one of RealityCapture's attributes or elements.
fn field<'a>(node: Node<'a, 'a>, name: &str) -> Option<&'a str> {
    let is_it = |found: &roxmltree::Attribute| {
        found.name() == name && found.namespace().is_some_and(|space| space.starts_with(NAMESPACE))
    };
    let attribute = node.attributes().find(is_it).map(|attribute| attribute.value());
    attribute.or_else(|| child(node, name)?.text())
}

fn shot(node: Node, path: &Path) -> Result<Option<Shot>, Refusal> {
    let (Some(rotation), Some(position)) = (field(node, "Rotation"), field(node, "Position")) else {
        return Ok(None);
    };
    let rotation = from_rows(&numbers::<9>(rotation)?);
    if !is_rotation(&rotation) {
        return Err("its Rotation is not a rotation".into());
    }
    let rotation = DQuat::from_mat3(&rotation).normalize();
    let translation = -(rotation * DVec3::from(numbers::<3>(position)?));
    let folder = path.parent().unwrap_or(Path::new(""));
    let stem = path.file_stem().and_then(|stem| stem.to_str()).ok_or("its name is not a text in UTF-8")?;
    let (name, picture) = find_picture(folder, stem);
    Ok(Some(Shot {
        name,
        cam_from_world: Pose { rotation, translation },
        lens: film_lens(node)?.on(&picture)?,
        path: picture,
    }))
}

fn film_lens(node: Node) -> Result<FilmLens, Refusal> {
    let number =
        |name: &str, usual: f64| field(node, name).map_or(Ok([usual]), numbers::<1>).map(|[number]| number);
    let model = field(node, "DistortionModel").unwrap_or(MODELS[0]);
    if !MODELS.contains(&model) {
        return Err(FilmLens::unsupported(&format!("the model '{}'", model.escape_debug())));
    }
    if (number("Skew", 0.0)?, number("AspectRatio", 1.0)?) != (0.0, 1.0) {
        return Err(FilmLens::unsupported("the skew or the aspect ratio"));
    }
    let focal_mm = field(node, "FocalLength35mm").ok_or("has no FocalLength35mm")?;
    let [focal_mm] = numbers::<1>(focal_mm)?;
    let center_share = DVec2::new(number("PrincipalPointU", 0.0)?, number("PrincipalPointV", 0.0)?);
    let distortion = field(node, "DistortionCoeficients").map_or(Ok([0.0; 6]), numbers::<6>)?;
    Ok(FilmLens { focal_mm, center_share, distortion })
}
