//! `devices`: lists the GPUs.

use std::io::{self, Write};

use anyhow::Result;
use clap::Args;
use cosurf_engine::gpu::{AdapterSummary, adapters};

/// List the GPUs with their capabilities, numbered as in `--compute gpu:N`.
#[derive(Args, Debug)]
pub(super) struct DevicesArgs {
    /// Print JSON instead of text, one GPU per line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &DevicesArgs) -> Result<()> {
    let (adapters, mut stdout) = (adapters(), io::stdout().lock());
    for (index, adapter) in adapters.iter().enumerate() {
        let AdapterSummary { name, api, driver, is_software, binding_bytes_max, subgroup_size } = adapter;
        if args.json {
            writeln!(
                stdout,
                "{}",
                serde_json::json!({
                    "device": format!("gpu:{index}"),
                    "name": name,
                    "api": api,
                    "driver": driver,
                    "is_software": is_software,
                    "binding_bytes_max": binding_bytes_max,
                    "subgroup_size": subgroup_size,
                })
            )?;
            continue;
        }
        let kind = if *is_software { ", software driver: slower than --compute cpu" } else { "" };
        let subgroups = subgroup_size.map_or_else(String::new, |size| format!(", subgroups of {size}"));
        let binding_mib = binding_bytes_max >> 20;
        writeln!(
            stdout,
            "gpu:{index}  {name} ({api}, {driver}){kind}; buffers up to {binding_mib} MiB{subgroups}"
        )?;
    }
    if adapters.is_empty() && !args.json {
        writeln!(
            stdout,
            "no GPU with a Vulkan, Metal or DirectX 12 driver; only --compute cpu is available"
        )?;
    }
    Ok(())
}
