//! How users name a device, and how a device is opened.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuChoice, GpuError};

/// The device that a user chose: `auto`, `cpu`, `gpu` or `gpu:N`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum DeviceChoice {
    /// A real graphics card if one can be opened, else the processor. Software drivers are never chosen, because they
    /// are slower than the CPU backend.
    #[default]
    Auto,
    /// The processor.
    Cpu,
    /// The best GPU, or the GPU with this number. Either may be a software driver.
    Gpu(Option<usize>),
}

/// The requested device cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceError {
    /// The graphics card cannot be opened, has too little memory, or failed.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The program was built without GPU support.
    #[error("this program was built without GPUs; use --compute cpu, or build it with the feature `gpu`")]
    NotBuilt,
}

/// The device was lost during a training.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}; run again to resume from the last checkpoint, with --compute cpu if this happens twice")]
pub struct DeviceLost(pub String);

impl FromStr for DeviceChoice {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu(None)),
            _ => {
                let index = text.strip_prefix("gpu:").and_then(|index| index.parse().ok());
                index.map(|index| Self::Gpu(Some(index))).ok_or("give auto, cpu, gpu or gpu:N")
            }
        }
    }
}

impl TryFrom<String> for DeviceChoice {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<DeviceChoice> for String {
    fn from(choice: DeviceChoice) -> Self {
        choice.to_string()
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu(None) => f.write_str("gpu"),
            Self::Gpu(Some(index)) => write!(f, "gpu:{index}"),
        }
    }
}

/// An open device.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Device {
    /// The processor.
    Cpu,
    /// A graphics card.
    #[cfg(feature = "gpu")]
    Gpu(Gpu),
}

impl Device {
    /// Whether the device is a graphics card.
    pub fn is_gpu(&self) -> bool {
        !matches!(self, Self::Cpu)
    }

    /// Devices of the same class compute the same bits: all processors, or equal graphics cards with the same driver.
    pub fn class(&self) -> String {
        match self {
            Self::Cpu => "cpu".into(),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.to_string(),
        }
    }

    /// Largest buffer that a pass can bind, bytes; `None` on the processor.
    pub fn binding_bytes_max(&self) -> Option<u64> {
        match self {
            Self::Cpu => None,
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => Some(gpu.adapter().binding_bytes_max),
        }
    }

    /// Fails once the device is lost. Results that were read since the last successful check are then not valid.
    pub fn check(&self) -> Result<(), DeviceError> {
        match self {
            Self::Cpu => Ok(()),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.lost().map_or(Ok(()), |reason| Err(GpuError::Lost(reason).into())),
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => gpu.fmt(f),
        }
    }
}

impl DeviceChoice {
    /// Opens the chosen device. Fails if a GPU was requested, but does not exist or cannot be opened.
    #[cfg(feature = "gpu")]
    pub fn open(self) -> Result<Device, DeviceError> {
        let choice = match self {
            Self::Cpu => return Ok(Device::Cpu),
            Self::Auto => GpuChoice::Real,
            Self::Gpu(None) => GpuChoice::Any,
            Self::Gpu(Some(index)) => GpuChoice::Index(index),
        };
        match Gpu::open(choice) {
            Ok(gpu) => Ok(Device::Gpu(gpu)),
            Err(_) if self == Self::Auto => Ok(Device::Cpu),
            Err(error) => Err(error.into()),
        }
    }

    /// Opens the chosen device. Fails if a GPU was requested, because this program is built without GPUs.
    #[cfg(not(feature = "gpu"))]
    pub fn open(self) -> Result<Device, DeviceError> {
        match self {
            Self::Auto | Self::Cpu => Ok(Device::Cpu),
            Self::Gpu(_) => Err(DeviceError::NotBuilt),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn device_names_parse_and_print_alike() {
        for word in ["auto", "cpu", "gpu", "gpu:0", "gpu:12"] {
            assert_eq!(word.parse::<DeviceChoice>().expect("a device").to_string(), word);
        }
        for word in ["", "GPU", "gpu:", "gpu:x", "gpu:-1", "cuda"] {
            assert!(word.parse::<DeviceChoice>().is_err(), "{word}");
        }
    }
}
