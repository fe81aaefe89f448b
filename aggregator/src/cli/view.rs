//! `view`: shows a model in a browser.

use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc;

use anyhow::{Context, Result};
use clap::Args;
use cosurf_aggregator::service::contributions;
use cosurf_aggregator::station::{Token, serve_model};
use cosurf_aggregator::viewer::{FIRST_SPLATS, Room, Walkable};
use cosurf_contract::counted;
use cosurf_scene::{model, ply};

use super::address::{parse_address, urls};

/// Show a model in a browser: walk through it, measure, and read coordinates.
///
/// Serves the model until it is stopped with Ctrl-C, and prints the address. The browser needs WebGL 2 and no internet.
/// Addresses that other computers reach are printed with a token, which they need.
#[derive(Args)]
pub(crate) struct ViewArgs {
    /// The model: a PLY or SPZ file, or the folder of a training, a merge or a mission
    model: PathBuf,
    /// Address and port to serve on; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:0", value_parser = parse_address)]
    http: SocketAddr,
    /// File whose first line is the token [default: a random one]
    #[arg(long, value_name = "FILE")]
    http_token_file: Option<PathBuf>,
}

pub(crate) fn run(args: &ViewArgs) -> Result<()> {
    let token = args.http_token_file.as_deref().map_or_else(Token::random, Token::read)?;
    let file = ply::of_model(&args.model)?;
    if let Some(note) = model::unusable_note(&file) {
        eprintln!("{note}");
    }
    let room = Room { first_splats: Some(FIRST_SPLATS), ..Room::UNLIMITED };
    let devices = contributions(file.parent().unwrap_or(Path::new("")));
    let model = Walkable::read(&args.model, room)?.with_devices(devices);
    let [splats, _] = model.shown();
    let (stop, stopped) = mpsc::channel();
    ctrlc::set_handler(move || {
        let _ = stop.send(()); // fails only if the program has already ended
    })
    .context("cannot install the Ctrl-C handler")?;
    let server = serve_model(args.http, &token, model)?;
    let address = server.address();
    let needed = (!address.ip().is_loopback()).then_some(&token);
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{}", counted(splats, "splat"))?;
    write!(stdout, "{}", urls(address, needed))?;
    stdout.flush()?;
    let _ = stopped.recv();
    Ok(())
}
