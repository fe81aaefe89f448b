//! Arguments that several commands take.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use clap::Args;
use cosurf_aggregator::service::AggregatorConfig;

/// The option that names the configuration file of a service.
#[derive(Args)]
pub(crate) struct ConfigArgs {
    /// Configuration file; it must set site, out, and either bind or broker
    #[arg(long, value_name = "FILE", default_value = "aggregator.toml")]
    config: PathBuf,
}

impl ConfigArgs {
    /// Path of the file.
    pub(crate) fn path(&self) -> &Path {
        &self.config
    }

    /// Reads the file.
    pub(crate) fn read(&self) -> Result<AggregatorConfig> {
        let is_there = self.config.exists();
        ensure!(is_there, "{}: there is no such file; name another with --config", self.config.display());
        Ok(AggregatorConfig::read(&self.config)?)
    }
}

/// Parses a length in metres: a finite number above zero.
pub(super) fn parse_length(text: &str) -> Result<f64, String> {
    let length: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
    length.ok_or_else(|| format!("'{text}' is not a positive length in metres; write for example 0.25"))
}
