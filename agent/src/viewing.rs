//! Opens a finished model to render it, on a device or within a limit of memory.

use std::path::PathBuf;

use anyhow::{Result, anyhow, ensure};
use cosurf_contract::usage;
use cosurf_engine::{DeviceChoice, Place, Rendering, ViewError, ViewMemory, Views};
use cosurf_scene::{Camera, LocalFrame};

/// Opens the model in the file `model` to render it from `cameras`, which are in `frame`. With a limit, it is rendered
/// on the CPU, and the process stays within `memory_bytes`, of which it needs `beside_bytes` for other things than
/// rendering. Fails if the file is no model, or a GPU is asked for together with a limit.
pub fn open(
    model: PathBuf,
    frame: &LocalFrame,
    cameras: &[Camera],
    device: DeviceChoice,
    threads: usize,
    memory_bytes: Option<u64>,
    beside_bytes: u64,
) -> Result<Views> {
    let place = match memory_bytes {
        None => Place::On(device),
        Some(limit_bytes) => {
            ensure!(
                !matches!(device, DeviceChoice::Gpu(_)),
                "a limit of memory is kept on the CPU only; leave out --memory, or use --compute cpu"
            );
            Place::Within(ViewMemory {
                limit_bytes,
                held_bytes: usage::held_bytes,
                made_bytes: beside_bytes,
                made_bytes_per_pixel: 0,
            })
        }
    };
    let mut views = Views::open(model, frame, place, threads)?;
    views.expect(cameras.to_vec());
    Ok(views)
}

/// What the model shows from a camera. Fails with the remedy if there is too little memory.
pub fn render(model: &mut Views, camera: &Camera) -> Result<Rendering> {
    model.render(camera).map_err(|error| match error {
        ViewError::TooLittleMemory { needed_bytes, .. } => {
            anyhow!(
                "{error}; allow --memory {}MiB or choose a smaller --max-size",
                needed_bytes.div_ceil(1 << 20)
            )
        }
        error => error.into(),
    })
}
