//! `restore`: makes an older revision of the global model the newest one again.

use std::io::{self, Write};

use anyhow::Result;
use clap::Args;
use cosurf_aggregator::service::{
    OldRevision, ask_to_release, ask_to_restore, lost_revisions, old_revisions,
};
use cosurf_contract::counted;
use time::OffsetDateTime;

use super::arguments::ConfigArgs;

/// Restore an older revision: the global model becomes again what it was. Without a number, list the revisions.
///
/// The restored model gets a new number, so that devices take it, and stays until a merge is asked for (*Merge now* in the
/// page, or `restore --release`) or a device that it was merged from is forgotten. Models that arrive meanwhile are stored.
/// A running service notices within about a second, a stopped one when it starts.
#[derive(Args)]
pub(crate) struct RestoreArgs {
    /// Number of the revision
    revision: Option<u64>,
    #[command(flatten)]
    config: ConfigArgs,
    /// Merge all models now, so that a restored revision no longer stays
    #[arg(long, conflicts_with = "revision")]
    release: bool,
}

pub(crate) fn run(args: &RestoreArgs) -> Result<()> {
    let folder = args.config.read()?.out;
    let mut out = io::stdout().lock();
    if let Some(revision) = args.revision {
        ask_to_restore(&folder, revision)?;
        writeln!(out, "revision {revision} is to be restored in {}", folder.display())?;
        return Ok(());
    }
    if args.release {
        ask_to_release(&folder)?;
        writeln!(out, "all models are to be merged in {}", folder.display())?;
        return Ok(());
    }
    let revisions = old_revisions(&folder)?;
    if revisions.is_empty() {
        writeln!(out, "there is no older revision to restore in {}", folder.display())?;
    }
    for OldRevision { revision, made_s, splats, models, restored_from } in revisions {
        let made =
            made_s.and_then(|seconds| OffsetDateTime::from_unix_timestamp(i64::try_from(seconds).ok()?).ok());
        let made = made.map_or_else(String::new, |time| {
            let (date, hour, minute) = (time.date(), time.hour(), time.minute());
            format!(", made {date} {hour:02}:{minute:02} UTC")
        });
        let repeats = restored_from.map_or_else(String::new, |from| format!(", repeats revision {from}"));
        let (splats, models) = (counted(splats, "splat"), counted(models, "model"));
        writeln!(out, "{revision}: {splats} of {models}{made}{repeats}")?;
    }
    for (revision, fault) in lost_revisions(&folder)? {
        writeln!(out, "{revision}: cannot be restored: {fault}")?;
    }
    Ok(())
}
