//! Records dispatches of passes for one submission to the GPU. What the processor spends on each dispatch matters: a training
//! step of 100,000 splats has about 130 dispatches, and the card needs 2 ms for them. So dispatches share a compute pass of
//! wgpu, and their bind groups are kept ([`super::bindings`]).

use super::context::Gpu;
use super::pass::Pass;

/// Largest number of workgroups along one axis of a dispatch, as `GROUPS_ACROSS` in `types.wgsl`.
pub(super) const GROUPS_MAX: u32 = 65_535;

/// Records passes. They run in the order in which they are recorded.
#[derive(Debug)]
pub(super) struct Recorder<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    /// The compute pass of the last dispatches, until something else is recorded.
    open: Option<wgpu::ComputePass<'static>>,
}

impl<'a> Recorder<'a> {
    pub(super) fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self { gpu, encoder, open: None }
    }

    /// Records a pass with at least `groups` workgroups, none if `groups` is 0. `buffers[i]` is its binding `i`.
    pub(super) fn run(&mut self, pass: &Pass, buffers: &[&wgpu::Buffer], groups: usize) {
        let Some([across, down]) = folded(groups as u32) else { return };
        let bind_group = self.gpu.bind_group(pass, buffers);
        let recorded = self.compute_pass(pass);
        recorded.set_pipeline(&pass.pipeline);
        recorded.set_bind_group(0, &bind_group, &[]);
        recorded.dispatch_workgroups(across, down, 1);
    }

    /// The open compute pass, or a new one.
    #[cfg(not(feature = "gpu-timestamps"))]
    fn compute_pass(&mut self, _: &Pass) -> &mut wgpu::ComputePass<'static> {
        let begin = || self.encoder.begin_compute_pass(&Default::default()).forget_lifetime();
        self.open.get_or_insert_with(begin)
    }

    /// A new compute pass, since timestamps are taken at the ends of compute passes.
    #[cfg(feature = "gpu-timestamps")]
    fn compute_pass(&mut self, pass: &Pass) -> &mut wgpu::ComputePass<'static> {
        self.open = None;
        let timed = self.gpu.timestamps.as_ref().and_then(|timestamps| timestamps.start(pass.name));
        let descriptor = wgpu::ComputePassDescriptor {
            label: Some(pass.name),
            timestamp_writes: timed.as_ref().map(|timed| timed.writes()),
        };
        self.open.insert(self.encoder.begin_compute_pass(&descriptor).forget_lifetime())
    }

    /// Records setting a buffer to zero.
    pub(super) fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.open = None;
        self.encoder.clear_buffer(buffer, 0, None);
    }

    pub(super) fn submit(mut self) {
        self.open = None;
        self.gpu.queue.submit([self.encoder.finish()]);
    }
}

/// Numbers of workgroups along two axes, at least `groups` in total; `None` for 0. The function `group_index` in
/// `types.wgsl` computes the index of a workgroup from its place on the two axes.
fn folded(groups: u32) -> Option<[u32; 2]> {
    match groups {
        0 => None,
        1..=GROUPS_MAX => Some([groups, 1]),
        _ => Some([GROUPS_MAX, groups.div_ceil(GROUPS_MAX)]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_dispatches_are_folded() {
        assert_eq!(folded(0), None);
        assert_eq!(folded(GROUPS_MAX), Some([GROUPS_MAX, 1]));
        for groups in [GROUPS_MAX + 1, 262_144, u32::MAX / 1024] {
            let [across, down] = folded(groups).expect("groups");
            assert!(across <= GROUPS_MAX && down <= GROUPS_MAX);
            assert!(u64::from(across) * u64::from(down) >= u64::from(groups));
        }
    }
}
