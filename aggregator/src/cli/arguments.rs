//! Arguments that several commands take.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, ensure};
use clap::Args;
use cosurf_aggregator::service::{AggregatorConfig, ask_to_release, ask_to_restore, revoke, withdraw};
use cosurf_aggregator::station::{Act, Action, Board, Server, Token, serve_site};

use super::address::{parse_address, urls};

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

/// The options of the ground station in a browser.
#[derive(Args)]
pub(crate) struct HttpArgs {
    /// Show devices, map, log and model in a browser at this address and port, for example 127.0.0.1:8080. Other
    /// computers need the token that is printed. The page takes up to 160 MiB
    #[arg(long, value_name = "ADDRESS", value_parser = parse_address)]
    http: Option<SocketAddr>,
    /// File whose first line is the token [default: a random one]
    #[arg(long, value_name = "FILE", requires = "http")]
    http_token_file: Option<PathBuf>,
}

/// A ground station that is served while this value lives.
pub(crate) struct ServedSite {
    pub(crate) board: Board,
    _server: Server,
}

impl HttpArgs {
    /// Whether an address is given.
    pub(crate) fn is_served(&self) -> bool {
        self.http.is_some()
    }

    /// Serves the service or mission in a folder, if an address is given, and prints its addresses to standard error. `acts`
    /// tells whether it is a service, on which the operator can act.
    pub(crate) fn serve(&self, folder: &Path, acts: bool) -> Result<Option<ServedSite>> {
        let Some(address) = self.http else { return Ok(None) };
        let token = self.http_token_file.as_deref().map_or_else(Token::random, Token::read)?;
        let board = Board::new(folder);
        let act = acts.then(|| act_on(folder.to_owned()));
        let server = serve_site(address, &token, board.clone(), act)?;
        eprint!("{}", urls(server.address(), Some(&token)));
        Ok(Some(ServedSite { board, _server: server }))
    }
}

/// Does the operator's actions on the service in a folder. What is asked for is on the disk before it is answered, so it
/// outlasts a kill, and commands that are asked for later are done later.
fn act_on(folder: PathBuf) -> Act {
    Arc::new(move |action| match action {
        Action::Forget(device) => withdraw(&folder, device).map_err(|error| error.to_string()),
        Action::Revoke { device, forget } => {
            let done = revoke(&folder, device);
            let done = if *forget { done.and_then(|()| withdraw(&folder, device)) } else { done };
            done.map_err(|error| error.to_string())
        }
        Action::Restore(revision) => ask_to_restore(&folder, *revision).map_err(|error| error.to_string()),
        Action::Merge => ask_to_release(&folder).map_err(|error| error.to_string()),
    })
}

/// Parses a length in metres: a finite number above zero.
pub(super) fn parse_length(text: &str) -> Result<f64, String> {
    let length: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
    length.ok_or_else(|| format!("'{text}' is not a positive length in metres; write for example 0.25"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn what_the_page_asks_for_is_on_the_disk_and_in_its_place_once_it_is_answered() {
        let folder = tempfile::tempdir().unwrap();
        let act = act_on(folder.path().to_owned());
        let wishes = || std::fs::read_to_string(folder.path().join("restore")).unwrap_or_default();
        act(&Action::Merge).unwrap();
        assert_eq!(wishes(), "release");
        std::fs::write(folder.path().join("restore"), "merging\n7").unwrap();
        act(&Action::Merge).unwrap();
        assert_eq!(wishes(), "merging\n7\nrelease", "behind what was asked for before");
        act(&Action::Merge).unwrap();
        assert_eq!(wishes(), "merging\n7\nrelease", "asked for twice");
        std::fs::write(folder.path().join("restore"), "7\n8\n".repeat(8)).unwrap();
        assert!(act(&Action::Merge).unwrap_err().contains("still wait"));
    }
}
