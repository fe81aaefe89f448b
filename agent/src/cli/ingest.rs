//! `ingest`: makes a dataset of photographs.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use cosurf_agent::ingest::{IngestPlan, Ingested, ingest};
use cosurf_contract::counted;
use cosurf_geo::{Geodetic, Georeference, PointResidual};
use cosurf_scene::Dataset;

use super::progress::Progress;

/// Make a dataset for `train` of drone photographs: find their poses with COLMAP, undistort them, and put them in their
/// place on the earth by their GPS.
///
/// Writes DATA/images, DATA/sparse/0 (x east, y north, z up, metres about the site's origin) and DATA/geo.json. Reads EXIF
/// and XMP, and `geo.txt` and `gcp_list.txt` in the formats of ODM if they lie beside the photographs. Without GPS and
/// control points, scale and place stay unknown, and there is no geo.json. If PHOTOS has poses already (COLMAP,
/// transforms.json, cameras of Metashape or RealityCapture), they are kept, and the pictures are only undistorted. To
/// resume after a stop or a kill, run the same command again.
/// COLMAP's work lies in DATA/.ingest, which may be deleted afterwards: then the same command begins from the start.
#[derive(Args, Debug)]
pub(super) struct IngestArgs {
    /// The folder of the photographs, JPEG or PNG, or one that has them in `images`
    photos: PathBuf,
    /// The folder to write the dataset to
    #[arg(long, value_name = "DATA")]
    out: PathBuf,
    /// Origin of the site, latitude and longitude in degrees and height in metres. Give the same to all drones of a site
    /// [default: the median of the photographs, rounded to 0.0001 degrees and whole metres]
    #[arg(long, value_name = "LAT,LON,HEIGHT", allow_hyphen_values = true)]
    origin: Option<Geodetic>,
    /// Grid of the geoid that the heights in gcp_list.txt and geo.txt are above: a GeoTIFF of PROJ (us_nga_egm96_15.tif) or a
    /// .gtx file [default: they are above the ellipsoid of WGS 84]
    #[arg(long, value_name = "FILE")]
    geoid: Option<PathBuf>,
    /// Shrink pictures until their long side is at most this many pixels
    #[arg(long, value_name = "PX", default_value_t = 1920, value_parser = clap::value_parser!(u32).range(16..))]
    max_size: u32,
    /// The program of COLMAP, 3.6 or newer
    #[arg(long, value_name = "PROGRAM", default_value = "colmap")]
    colmap: PathBuf,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &IngestArgs) -> Result<()> {
    let plan = IngestPlan {
        photographs: args.photos.clone(),
        out: args.out.clone(),
        colmap: args.colmap.clone(),
        origin: args.origin,
        geoid: args.geoid.clone(),
        max_size_px: args.max_size,
    };
    let mut progress = Progress::new(args.json);
    let ingested = ingest(&plan, &mut |event| progress.ingesting(&event))?;
    if args.json { Ok(()) } else { print(&ingested, args) }
}

fn print(ingested: &Ingested, args: &IngestArgs) -> Result<()> {
    let mut stdout = io::stdout().lock();
    let report = &ingested.report;
    let points = counted(report.points as u64, "point");
    writeln!(stdout, "{} of {} photographs, {points}", report.posed, report.photographs)?;
    match &ingested.georeference {
        Some(georeference) => print_place(&mut stdout, georeference)?,
        None if Dataset::has_poses(&args.photos) => {
            writeln!(stdout, "the world is that of the poses in {}", args.photos.display())?
        }
        None => writeln!(
            stdout,
            "scale and place are unknown, only z is up: put a geo.txt or a gcp_list.txt beside the photographs, or mend the one that is there"
        )?,
    }
    writeln!(stdout, "{}", args.out.display())?;
    Ok(())
}

fn print_place(out: &mut impl Write, its: &Georeference) -> io::Result<()> {
    let Geodetic { latitude_deg, longitude_deg, height_m } = its.origin;
    writeln!(out, "origin {latitude_deg},{longitude_deg},{height_m}, maps in EPSG:{}", its.epsg)?;
    if let Some(gps) = &its.residuals.gps {
        writeln!(
            out,
            "GPS of {} of {} agrees with the poses, to {:.2} m horizontally and {:.2} m vertically",
            gps.agreeing, gps.photographs, gps.horizontal_rms_m, gps.vertical_rms_m
        )?;
        if gps.with_accuracy > 0 {
            writeln!(out, "{} of {} tell how accurate their place is", gps.with_accuracy, gps.photographs)?;
        }
    }
    if let Some(known) = &its.residuals.uncertainty {
        writeln!(
            out,
            "known to {:.1}° of tilt, {:.1}° of heading, {:.1} % of length, {:.2} m horizontally, {:.2} m vertically",
            known.tilt_deg,
            known.heading_deg,
            100.0 * known.scale_share,
            known.horizontal_m,
            known.vertical_m
        )?;
    }
    for (noun, points) in [("control point", &its.residuals.control), ("check point", &its.residuals.check)] {
        if !points.is_empty() {
            let [east, north, up] = PointResidual::rms_m(points);
            let count = counted(points.len() as u64, noun);
            writeln!(
                out,
                "{count}: off by {east:.3} m east, {north:.3} m north, {up:.3} m up (root mean square)"
            )?;
        }
    }
    Ok(())
}
