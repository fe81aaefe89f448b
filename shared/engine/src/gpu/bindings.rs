//! Keeps the bind groups of passes, because to make one takes longer than to record its dispatch.

use std::collections::HashMap;

use super::pass::Pass;

/// The bind groups made so far. They keep their buffers alive, so whoever replaces a buffer must forget them.
#[derive(Debug, Default)]
pub(super) struct Bindings(HashMap<(wgpu::BindGroupLayout, Vec<wgpu::Buffer>), wgpu::BindGroup>);

impl Bindings {
    /// The bind group with which `buffers[i]` is binding `i` of `pass`.
    pub(super) fn get(
        &mut self,
        device: &wgpu::Device,
        pass: &Pass,
        buffers: &[&wgpu::Buffer],
    ) -> wgpu::BindGroup {
        let key = (pass.layout.clone(), buffers.iter().copied().cloned().collect());
        self.0.entry(key).or_insert_with(|| make(device, pass, buffers)).clone()
    }

    pub(super) fn forget(&mut self) {
        self.0.clear();
    }
}

/// Makes a bind group.
pub(super) fn make(device: &wgpu::Device, pass: &Pass, buffers: &[&wgpu::Buffer]) -> wgpu::BindGroup {
    let entries: Vec<_> = (0..)
        .zip(buffers)
        .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
        .collect();
    let label = Some(pass.name);
    device.create_bind_group(&wgpu::BindGroupDescriptor { label, layout: &pass.layout, entries: &entries })
}
