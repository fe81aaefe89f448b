//! Opens a finished model to render it, within a limit of memory.

use std::path::Path;

use anyhow::{Result, ensure};
use cosurf_engine::budget::Viewing;
use cosurf_engine::{DeviceChoice, Renderer};
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::{Camera, LocalFrame, ply};

/// Opens the model to render it from `cameras`, which are in `frame`. With a limit, it is rendered on the CPU, and the
/// process stays within `memory_bytes`, of which it needs `beside_bytes` for other things than rendering. Fails if the
/// model cannot be read, the device cannot be opened, a GPU is asked for together with a limit, or the limit is too
/// small.
pub fn open(
    model: &Path,
    frame: &LocalFrame,
    cameras: &[Camera],
    device: DeviceChoice,
    threads: usize,
    memory_bytes: Option<u64>,
    beside_bytes: u64,
) -> Result<Renderer> {
    let Some(memory_bytes) = memory_bytes else {
        return Ok(Renderer::on(device, threads, &ply::read(model, frame)?)?);
    };
    ensure!(
        !matches!(device, DeviceChoice::Gpu(_)),
        "a limit of memory is kept on the CPU only; leave out --memory, or use --compute cpu"
    );
    let (splats, sh_degree) = ply::size(model)?;
    let pixels = |camera: &&Camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1]);
    let size_px = cameras.iter().max_by_key(pixels).map_or([1, 1], |camera| camera.size_px);
    let viewing = Viewing { splats, sh_degree, size_px };
    let fits = |pairs| {
        let needed_bytes = viewing.bytes(pairs) + beside_bytes;
        ensure!(
            needed_bytes <= memory_bytes,
            "{}: {splats} splats and pictures of up to {} × {} px need --memory {}MiB instead of {}, or a smaller --max-size",
            model.display(),
            size_px[0],
            size_px[1],
            needed_bytes.div_ceil(1 << 20),
            format_bytes(memory_bytes)
        );
        Ok(())
    };
    fits(viewing.usual_pairs())?;
    let mut renderer = Renderer::on(DeviceChoice::Cpu, threads, &ply::read(model, frame)?)?;
    let pairs = cameras.iter().map(|camera| renderer.pairs(camera)).max().unwrap_or(0);
    fits(pairs)?;
    renderer.reserve_pairs(pairs);
    Ok(renderer)
}
