//! The device that computes a merge: the CPU or a graphics card.

use cosurf_engine::backend::Channels;
use cosurf_engine::budget::{Costs, DRIVER_BYTES, PAIRS_PER_SEEN_SPLAT, PROCESS_BYTES};
use cosurf_engine::{Capacity, Device, DeviceChoice, DeviceError};
use cosurf_scene::{Camera, Splats};

use super::error::MergeError;
use super::memory::{STUDENT_SPLATS, student_bytes};
use super::settings::MergeSettings;

/// A computing device, and the number of CPU threads, at least 1.
#[derive(Clone, Debug)]
pub(super) struct Computer {
    pub(super) device: Device,
    pub(super) threads: usize,
}

impl Computer {
    /// Runs `work`. If a graphics card that was chosen automatically fails or needs too much memory, runs `work` again on
    /// the CPU.
    pub(super) fn run<T>(
        self,
        choice: DeviceChoice,
        mut work: impl FnMut(&Self) -> Result<T, MergeError>,
    ) -> Result<T, MergeError> {
        match work(&self) {
            Err(
                MergeError::Device(_)
                | MergeError::TooLittleMemory { .. }
                | MergeError::PicturesTooLarge { .. }
                | MergeError::ModelsTooLarge { .. },
            ) if choice == DeviceChoice::Auto && self.device.is_gpu() => {
                work(&Self { device: Device::Cpu, ..self })
            }
            done => done,
        }
    }
}

/// Opens the chosen device. With [`DeviceChoice::Auto`], a graphics card is used only if a large tile fits within the
/// memory limit of the merge, with buffers that the card can bind.
pub(super) fn choose(
    settings: &MergeSettings,
    splats: usize,
    sh_degree: u32,
    cameras: &[Vec<Camera>],
) -> Result<Device, DeviceError> {
    if settings.device != DeviceChoice::Auto {
        return settings.device.open();
    }
    if !settings.compress && settings.epochs == 0 {
        return Ok(Device::Cpu); // there is nothing to compute
    }
    let all: Vec<Camera> = cameras.iter().flatten().copied().collect();
    let shape = Capacity::to_train(&Splats::with_capacity(0, sh_degree), &all, Channels::Geometry);
    let has_room = |device: &Device| {
        let splats = splats.min(STUDENT_SPLATS);
        let costs = Costs::of(&shape, device.binding_bytes_max());
        let bytes = student_bytes(device, &shape, splats) + PROCESS_BYTES + DRIVER_BYTES;
        bytes <= settings.memory_bytes && splats <= costs.splats_max(PAIRS_PER_SEEN_SPLAT)
    };
    // Looking for a card loads drivers, which keep their memory even if no card is found. So the CPU must have enough
    // room beside that memory.
    if !has_room(&Device::Cpu) {
        return Ok(Device::Cpu);
    }
    let device = settings.device.open()?;
    Ok(if has_room(&device) { device } else { Device::Cpu })
}
