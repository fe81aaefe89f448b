//! Lists the graphics cards of a machine, and opens one.

use std::fmt;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use cosurf_shaders::Shader;
use wgpu::{Adapter, DeviceType, Limits};

use super::bindings::{self, Bindings};
use super::hush::hushed;
use super::pass::{Constants, Pass};
#[cfg(feature = "gpu-timestamps")]
use super::timestamps::{PassTime, Timestamps};

/// Errors of a GPU. After all buffers are allocated and all passes compiled, the only possible error is the loss of the
/// device.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No adapter of the requested kind, or no driver for it.
    #[error("no GPU with a Vulkan, Metal or DirectX 12 driver was found; use --compute cpu")]
    None,
    /// No adapter has this index.
    #[error("there is no GPU {index}, only {count} (see the command `devices`)")]
    NoSuch {
        /// The requested index.
        index: usize,
        /// Number of adapters.
        count: usize,
    },
    /// The driver refused to open the adapter.
    #[error("{name} cannot be used: {reason}; use --compute cpu")]
    Refused {
        /// Name of the adapter.
        name: String,
        /// The driver's message.
        reason: String,
    },
    /// A buffer would be larger than the adapter can bind.
    #[error(
        "{label} takes {bytes} bytes, but {name} binds at most {bytes_max} at once; use fewer splats or smaller pictures"
    )]
    TooLarge {
        /// Name of the buffer.
        label: &'static str,
        /// Size of the buffer, bytes.
        bytes: u64,
        /// Size of the largest buffer that the adapter can bind, bytes.
        bytes_max: u64,
        /// Name of the adapter.
        name: String,
    },
    /// The device was lost while it computed.
    #[error("{0}; run again, with --compute cpu if this happens twice")]
    Lost(String),
    /// The adapter's memory is full.
    #[error("{name} has too little memory; use fewer splats or smaller pictures")]
    OutOfMemory {
        /// Name of the adapter.
        name: String,
    },
}

/// Description of an adapter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterSummary {
    /// Name of the adapter, as its driver states it.
    pub name: String,
    /// Graphics API: `vulkan`, `metal` or `dx12`.
    pub api: String,
    /// Name and version of the driver.
    pub driver: String,
    /// Whether the adapter is a software driver, which runs on the processor.
    pub is_software: bool,
    /// Largest buffer that a pass can bind, bytes.
    pub binding_bytes_max: u64,
    /// Number of invocations of each subgroup, 8 to 64; `None` if it varies, or if the adapter has no subgroup
    /// operations.
    pub subgroup_size: Option<u32>,
}

/// Which adapter to open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuChoice {
    /// The best real graphics card.
    Real,
    /// The best adapter; a software driver if there is nothing else.
    Any,
    /// The adapter at this index of [`adapters`].
    Index(usize),
}

/// All adapters, best first.
pub fn adapters() -> Vec<AdapterSummary> {
    found().iter().map(summary).collect()
}

/// Values of the `override` constant of passes with subgroups, for each size of subgroups.
pub(super) const SUBGROUPS: [(u32, Constants); 4] = [
    (8, &[("SUBGROUP", 8.0)]),
    (16, &[("SUBGROUP", 16.0)]),
    (32, &[("SUBGROUP", 32.0)]),
    (64, &[("SUBGROUP", 64.0)]),
];

/// Features that are used where an adapter has them.
fn features_of_use() -> wgpu::Features {
    #[cfg(feature = "gpu-timestamps")]
    let timestamps = wgpu::Features::TIMESTAMP_QUERY;
    #[cfg(not(feature = "gpu-timestamps"))]
    let timestamps = wgpu::Features::empty();
    wgpu::Features::SUBGROUP | timestamps
}

fn found() -> Vec<Adapter> {
    let backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    let descriptor = wgpu::InstanceDescriptor {
        backends,
        flags: wgpu::InstanceFlags::empty(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    };
    let mut adapters = hushed(|| {
        let instance = wgpu::Instance::new(descriptor);
        pollster::block_on(instance.enumerate_adapters(backends))
    });
    adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    });
    adapters
}

fn summary(adapter: &Adapter) -> AdapterSummary {
    let info = adapter.get_info();
    AdapterSummary {
        api: format!("{:?}", info.backend).to_lowercase(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        is_software: info.device_type == DeviceType::Cpu,
        binding_bytes_max: adapter
            .limits()
            .max_storage_buffer_binding_size
            .min(adapter.limits().max_buffer_size),
        subgroup_size: adapter
            .features()
            .contains(wgpu::Features::SUBGROUP)
            .then(|| subgroup_size(&info))
            .flatten(),
        name: info.name,
    }
}

/// Number of invocations of each subgroup, if it is always the same and divides the pixels of a tile.
fn subgroup_size(info: &wgpu::AdapterInfo) -> Option<u32> {
    let size = info.subgroup_min_size;
    (size == info.subgroup_max_size && [8, 16, 32, 64].contains(&size)).then_some(size)
}

/// An open graphics card.
#[derive(Clone, Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    adapter: AdapterSummary,
    /// Passes compiled so far.
    passes: Arc<Mutex<Vec<Pass>>>,
    /// `None` if the adapter cannot write timestamps.
    #[cfg(feature = "gpu-timestamps")]
    pub(super) timestamps: Option<Arc<Timestamps>>,
    /// Why the device was lost; empty until then.
    lost: Arc<OnceLock<String>>,
    /// The bind groups of one model and its buffers; `None` if they are not kept.
    bindings: Option<Arc<Mutex<Bindings>>>,
}

impl Gpu {
    /// Opens an adapter. The limits for the sizes of buffers are those of the adapter; all others are wgpu's default
    /// limits.
    pub fn open(choice: GpuChoice) -> Result<Self, GpuError> {
        Self::open_bound(choice, u64::MAX)
    }

    /// As [`Self::open`], but passes can bind at most `binding_bytes_max` bytes of a buffer.
    pub(super) fn open_bound(choice: GpuChoice, binding_bytes_max: u64) -> Result<Self, GpuError> {
        let adapters = found();
        let adapter = match choice {
            GpuChoice::Any => adapters.first().ok_or(GpuError::None)?,
            GpuChoice::Real => {
                adapters.iter().find(|adapter| !summary(adapter).is_software).ok_or(GpuError::None)?
            }
            GpuChoice::Index(index) => {
                adapters.get(index).ok_or(GpuError::NoSuch { index, count: adapters.len() })?
            }
        };
        let mut adapter_summary = summary(adapter);
        adapter_summary.binding_bytes_max = adapter_summary.binding_bytes_max.min(binding_bytes_max);
        let required_limits = Limits {
            max_storage_buffer_binding_size: adapter_summary.binding_bytes_max,
            max_buffer_size: adapter.limits().max_buffer_size,
            ..Limits::default()
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("cosurf"),
            required_limits,
            required_features: adapter.features() & features_of_use(),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).map_err(|error| {
            GpuError::Refused { name: adapter_summary.name.clone(), reason: error.to_string() }
        })?;
        #[cfg(feature = "gpu-timestamps")]
        let timestamps = device
            .features()
            .contains(wgpu::Features::TIMESTAMP_QUERY)
            .then(|| Arc::new(Timestamps::new(&device)));
        let gpu = Self {
            device,
            queue,
            adapter: adapter_summary,
            passes: Arc::default(),
            #[cfg(feature = "gpu-timestamps")]
            timestamps,
            lost: Arc::default(),
            bindings: None,
        };
        let (of_loss, of_error) = (gpu.loser(), gpu.loser());
        gpu.device
            .set_device_lost_callback(move |reason, message| of_loss(&format!("{reason:?}: {message}")));
        // This crate makes no invalid wgpu calls, so an error that reaches this callback means that the driver failed.
        gpu.device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| of_error(&error.to_string())));
        Ok(gpu)
    }

    /// Returns the constants of the passes with subgroups; `None` for a software driver, for which such passes are slow, and
    /// for a card without subgroups of a fixed size.
    pub(super) fn subgroups(&self) -> Option<Constants> {
        let size = self.adapter.subgroup_size.filter(|_| !self.adapter.is_software)?;
        SUBGROUPS.into_iter().find(|(known, _)| *known == size).map(|(_, constants)| constants)
    }

    /// The same open adapter for a new model, whose bind groups are kept until
    /// [`Self::forget_bindings`].
    pub(super) fn for_model(&self) -> Self {
        Self { bindings: Some(Arc::default()), ..self.clone() }
    }

    /// Frees the buffers that only kept bind groups still use.
    pub(super) fn forget_bindings(&self) {
        if let Some(bindings) = &self.bindings {
            bindings.lock().unwrap_or_else(PoisonError::into_inner).forget();
        }
    }

    /// The bind group with which `buffers[i]` is binding `i` of `pass`.
    pub(super) fn bind_group(&self, pass: &Pass, buffers: &[&wgpu::Buffer]) -> wgpu::BindGroup {
        match &self.bindings {
            None => bindings::make(&self.device, pass, buffers),
            Some(kept) => {
                kept.lock().unwrap_or_else(PoisonError::into_inner).get(&self.device, pass, buffers)
            }
        }
    }

    /// Returns a function that records the loss of the device and the reason, in one line. Later reasons are ignored.
    fn loser(&self) -> impl Fn(&str) + Send + Sync + use<> {
        let (lost, name) = (self.lost.clone(), self.adapter.name.clone());
        move |reason| {
            let reason: Vec<&str> = reason.split_whitespace().collect();
            let _ = lost.set(format!("{name} was lost ({})", reason.join(" ")));
        }
    }

    /// Why the device was lost, if it is.
    pub(crate) fn lost(&self) -> Option<String> {
        self.lost.get().cloned()
    }

    /// Records a loss of the device that the driver has not reported.
    pub(super) fn lose(&self, reason: &str) {
        self.loser()(reason);
    }

    /// The same open adapter. A software driver is treated as a graphics card, and a graphics card as a software
    /// driver.
    #[cfg(test)]
    pub(super) fn disguised(&self) -> Self {
        let adapter = AdapterSummary { is_software: !self.adapter.is_software, ..self.adapter.clone() };
        Self { adapter, ..self.clone() }
    }

    /// The same open adapter, treated as one without subgroups.
    #[cfg(test)]
    pub(super) fn without_subgroups(&self) -> Self {
        Self { adapter: AdapterSummary { subgroup_size: None, ..self.adapter.clone() }, ..self.clone() }
    }

    /// The open adapter.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.adapter
    }

    /// The time that each pass took since the last call, longest first; `None` if the adapter cannot write timestamps.
    /// At most 2048 dispatches are measured between two calls. Waits until the card is idle.
    #[cfg(feature = "gpu-timestamps")]
    pub fn take_pass_times(&self) -> Option<Vec<PassTime>> {
        self.timestamps.as_ref().map(|timestamps| timestamps.read(&self.device, &self.queue))
    }

    /// The pass of a shader, compiled once for this device.
    pub(super) fn pass(&self, shader: Shader) -> Pass {
        self.pass_with(shader, &[])
    }

    /// As [`Self::pass`], with values for the shader's `override` constants.
    pub(super) fn pass_with(&self, shader: Shader, constants: Constants) -> Pass {
        let mut compiled = self.passes.lock().unwrap_or_else(PoisonError::into_inner);
        let is_it = |pass: &&Pass| pass.name == shader.name && pass.constants == constants;
        if let Some(pass) = compiled.iter().find(is_it) {
            return pass.clone();
        }
        let pass = Pass::compile(&self.device, shader, constants);
        compiled.push(pass.clone());
        pass
    }

    /// Runs `allocate` and returns its result. Fails if the adapter has too little memory for the buffers that
    /// `allocate` creates.
    pub(super) fn allocating<T>(
        &self,
        allocate: impl FnOnce() -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let allocated = allocate();
        match pollster::block_on(scope.pop()) {
            Some(_) => Err(GpuError::OutOfMemory { name: self.adapter.name.clone() }),
            None => allocated,
        }
    }
}

impl fmt::Display for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} ({})", self.adapter.name, self.adapter.api)
    }
}
