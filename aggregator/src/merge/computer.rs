//! The device that computes a merge: the CPU or a graphics card.

use cosurf_engine::budget::DRIVER_BYTES;
use cosurf_engine::{Device, DeviceChoice, DeviceError};
use cosurf_scene::Camera;

use super::error::MergeError;
use super::memory::student_room;
use super::settings::MergeSettings;

/// A computing device, and the number of CPU threads, at least 1.
#[derive(Clone, Debug)]
pub(super) struct Computer {
    pub(super) device: Device,
    pub(super) threads: usize,
}

impl Computer {
    /// Runs `work`. If a graphics card that was chosen automatically fails, runs `work` again on the CPU.
    pub(super) fn run<T>(
        self,
        choice: DeviceChoice,
        mut work: impl FnMut(&Self) -> Result<T, MergeError>,
    ) -> Result<T, MergeError> {
        match work(&self) {
            Err(MergeError::Device(_)) if choice == DeviceChoice::Auto && self.device.is_gpu() => {
                work(&Self { device: Device::Cpu, ..self })
            }
            done => done,
        }
    }
}

/// Opens the chosen device. With [`DeviceChoice::Auto`], a graphics card is used only if all models can be trained at
/// once, within the memory limit of the merge and with buffers that the card can bind.
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
    let has_room = |device: &Device, memory_bytes: u64| {
        splats <= student_room(device, &MergeSettings { memory_bytes, ..*settings }, sh_degree, cameras)
    };
    // Looking for a card loads drivers, which keep their memory even if no card is found. So the CPU must have enough
    // room without that memory.
    if !has_room(&Device::Cpu, settings.memory_bytes.saturating_sub(DRIVER_BYTES)) {
        return Ok(Device::Cpu);
    }
    let device = settings.device.open()?;
    Ok(if has_room(&device, settings.memory_bytes) { device } else { Device::Cpu })
}
