//! A compiled pass.

use cosurf_shaders::Shader;

/// Values of a shader's `override` constants.
pub(super) type Constants = &'static [(&'static str, f64)];

/// A compute pipeline with the name of its shader, the constants that it was compiled with, and the layout of its
/// bindings.
#[derive(Clone, Debug)]
pub(super) struct Pass {
    pub(super) name: &'static str,
    pub(super) constants: Constants,
    pub(super) pipeline: wgpu::ComputePipeline,
    pub(super) layout: wgpu::BindGroupLayout,
}

impl Pass {
    pub(super) fn compile(device: &wgpu::Device, shader: Shader, constants: Constants) -> Self {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(shader.name),
            source: wgpu::ShaderSource::Wgsl(shader.source.into()),
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(shader.name),
            layout: None,
            module: &module,
            entry_point: Some(shader.name),
            // Every pass writes its workgroup memory before reading it, so wgpu need not fill it with zeros.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                constants,
            },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Self { name: shader.name, constants, pipeline, layout }
    }
}
