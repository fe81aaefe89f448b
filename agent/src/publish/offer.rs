//! Encodes the model for the upload, and gives it a number. The number changes only if the encoded bytes change.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::Result;
use cosurf_engine::Renderer;
use cosurf_link::{FirstLayer, Offer, model_to_body};
use cosurf_scene::{Base, SceneError, Splats, files};
use cosurf_wire::{ModelId, ModelKind};
use serde::{Deserialize, Serialize};

use super::publication::Publication;
use crate::outputs::write_json;

/// The content of `published.json`: number and hash of the model that was published last. If the model is published
/// again unchanged, it keeps its number; a different model gets the next number.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Published {
    model: u64,
    blake3: String,
}

/// Encodes the model and finds its number. The upload starts with `base` or, if that is `None`, with the most important
/// splats.
pub(super) fn offer(
    publication: &Publication,
    splats: &Splats,
    base: Option<&Base>,
    kind: ModelKind,
) -> Result<Offer> {
    let (cameras, frame) = (publication.cameras, publication.frame);
    let body = match base {
        Some(base) => model_to_body(splats, cameras, frame, FirstLayer::Base(base)),
        None => {
            let importance = Renderer::new(splats, 1).importance(cameras);
            model_to_body(splats, cameras, frame, FirstLayer::ByImportance(&importance))
        }
    }?;
    let model = number_of(&body, publication)?;
    let offer = Offer::from_body(publication.identity.device, model, kind, cameras.len() as u32, body)?;
    Ok(if publication.is_placed { offer } else { offer.without_place() })
}

/// The number of the model whose encoded bytes are `body`. A new number is written to disk before it is returned.
fn number_of(body: &[u8], publication: &Publication) -> Result<ModelId> {
    let path = path(publication.out);
    let hash = blake3::hash(body).to_hex().to_string();
    let last = read(&path)?;
    if last.blake3 == hash {
        return Ok(ModelId(last.model));
    }
    let model = last.model + 1;
    write_json(&path, &Published { model, blake3: hash })?;
    Ok(ModelId(model))
}

/// Writes down that the model which was published last has another number.
pub(super) fn renumber(out: &Path, model: ModelId) -> Result<()> {
    let path = path(out);
    let last = read(&path)?;
    write_json(&path, &Published { model: model.0, ..last })?;
    Ok(())
}

fn path(out: &Path) -> PathBuf {
    out.join("published.json")
}

/// A damaged file is set aside and counts as missing. If the aggregator has models of higher numbers, it says so.
fn read(path: &Path) -> Result<Published> {
    let read = files::read(path).and_then(|bytes| {
        serde_json::from_slice(&bytes).map_err(|error| SceneError::malformed(path, error.to_string()))
    });
    match read {
        Ok(published) => Ok(published),
        Err(SceneError::Io { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(Published::default()),
        Err(error) if files::is_damage(&error) => {
            let kept = files::set_aside(path)?;
            tracing::warn!("{error}; it is set aside as {}", kept.display());
            Ok(Published::default())
        }
        Err(error) => Err(error.into()),
    }
}
