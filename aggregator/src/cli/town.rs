//! `town`: writes the built-in city as a dataset, or as a drone's memory card has it.

use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, bail};
use clap::Args;
use cosurf_aggregator::Meter;
use cosurf_city::{City, CitySettings, RawSettings};
use cosurf_contract::counted;

use super::host::display;

/// Write the synthetic city: pictures with poses, or the photographs of a drone.
///
/// Without --raw, OUT becomes a dataset as the built-in mission has it: images, sparse/0, and the true surface in gt. With
/// --raw, OUT has photographs with GPS in their EXIF, taken through a distorting lens with changing exposure, and
/// gcp_list.txt with targets on the ground that were measured exactly and marked by hand. The true poses, the true surface and
/// the true place are in gt, so that all that is made of the photographs can be compared with them.
#[derive(Args)]
pub(crate) struct TownArgs {
    /// Folder to write to; it must be empty or absent
    out: PathBuf,
    /// Write photographs without poses, as they come from a drone
    #[arg(long)]
    raw: bool,
    /// Standard deviation of the photographs' GPS along each axis, metres
    #[arg(long, value_name = "M", default_value_t = 2.0, value_parser = parse_error, requires = "raw")]
    gps_noise: f64,
    /// Length of the error that the GPS of all photographs has in common, metres
    #[arg(long, value_name = "M", default_value_t = 3.0, value_parser = parse_error, requires = "raw")]
    gps_bias: f64,
    /// Number of targets on the ground
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u32).range(..=400), requires = "raw")]
    targets: u32,
    /// Side of the flown square, metres, 10 to 1000
    #[arg(long, value_name = "M", default_value_t = CitySettings::default().extent_m)]
    extent: f64,
    /// Number of pictures, 3 to 9999
    #[arg(long, value_name = "N", default_value_t = CitySettings::default().views)]
    views: u32,
    /// Width of the pictures in pixels, 16 to 8192; their height is three quarters of it
    #[arg(long, value_name = "PX", default_value_t = CitySettings::default().size_px[0])]
    size: u32,
    /// Seed of the city and of all errors; the same seed gives the same photographs
    #[arg(long, value_name = "S", default_value_t = CitySettings::default().seed)]
    seed: u64,
    /// Print progress and result as lines of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &TownArgs) -> Result<()> {
    if args.out.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
        bail!("{} is not empty: name a new folder", args.out.display());
    }
    let TownArgs { extent: extent_m, views, size, seed, .. } = *args;
    let city = City::build(&CitySettings { seed, extent_m, views, size_px: [size, size / 4 * 3] })?;
    let begun = Instant::now();
    let mut meter = Meter::new(display(args.json));
    let progress = |done, of| meter.show("taking pictures", done, of, begun.elapsed().as_secs_f64());
    match args.raw {
        true => {
            let (gps_noise_m, gps_bias_m) = (args.gps_noise, args.gps_bias);
            let targets = args.targets as usize;
            let settings = RawSettings { gps_noise_m, gps_bias_m, targets, ..RawSettings::default() };
            city.write_raw(&settings, &args.out, progress)?;
        }
        false => _ = city.write(&args.out, progress)?,
    }
    meter.finish();
    let mut stdout = io::stdout().lock();
    let out = args.out.display();
    if args.json {
        let line = serde_json::json!({"event": "town", "out": out.to_string(), "views": views});
        writeln!(stdout, "{line}")?;
    } else {
        writeln!(stdout, "{} in {out}", counted(views as usize, "picture"))?;
    }
    Ok(())
}

/// An error of a measurement, metres.
fn parse_error(text: &str) -> Result<f64, String> {
    let error: Option<f64> = text.parse().ok().filter(|m: &f64| (0.0..=1000.0).contains(m));
    error.ok_or_else(|| format!("{text:?} is no error of a measurement: give 0 to 1000 metres"))
}
