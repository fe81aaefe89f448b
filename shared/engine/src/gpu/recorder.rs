//! Records dispatches of passes for one submission to the GPU.

use super::context::Gpu;
use super::pass::Pass;

/// Largest number of workgroups along one axis of a dispatch, as `GROUPS_ACROSS` in `types.wgsl`.
pub(super) const GROUPS_MAX: u32 = 65_535;

/// Records passes. They run in the order in which they are recorded.
#[derive(Debug)]
pub(super) struct Recorder<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
}

impl<'a> Recorder<'a> {
    pub(super) fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self { gpu, encoder }
    }

    /// Records a pass with at least `groups` workgroups, none if `groups` is 0. `buffers[i]` is its binding `i`.
    pub(super) fn run(&mut self, pass: &Pass, buffers: &[&wgpu::Buffer], groups: usize) {
        let Some([across, down]) = folded(groups as u32) else { return };
        let entries: Vec<_> = (0..)
            .zip(buffers)
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let bind_group = self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(pass.name),
            layout: &pass.layout,
            entries: &entries,
        });
        #[cfg(feature = "gpu-timestamps")]
        let timed = self.gpu.timestamps.as_ref().and_then(|timestamps| timestamps.start(pass.name));
        let descriptor = wgpu::ComputePassDescriptor {
            label: Some(pass.name),
            #[cfg(feature = "gpu-timestamps")]
            timestamp_writes: timed.as_ref().map(|timed| timed.writes()),
            #[cfg(not(feature = "gpu-timestamps"))]
            timestamp_writes: None,
        };
        let mut recorded = self.encoder.begin_compute_pass(&descriptor);
        recorded.set_pipeline(&pass.pipeline);
        recorded.set_bind_group(0, &bind_group, &[]);
        recorded.dispatch_workgroups(across, down, 1);
    }

    /// Records setting a buffer to zero.
    pub(super) fn clear(&mut self, buffer: &wgpu::Buffer) {
        self.encoder.clear_buffer(buffer, 0, None);
    }

    pub(super) fn submit(self) {
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
