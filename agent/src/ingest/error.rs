//! Why no dataset can be made of photographs.

use std::io;
use std::path::{Path, PathBuf};

use cosurf_geo::GeoError;
use cosurf_scene::SceneError;

/// What COLMAP's mapper says if it finds no poses.
const NO_MODEL: &str = "failed to create sparse model";

/// Why no dataset can be made. Each is one line, with the remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IngestError {
    /// A folder holds too few photographs.
    #[error("{}: has {found} usable photographs, JPEG or PNG; a dataset takes at least 3 that overlap{unusable}", folder.display())]
    TooFew {
        /// The folder.
        folder: PathBuf,
        /// Number of usable photographs.
        found: usize,
        /// The first unusable photograph and the reason, after a semicolon; empty if there is none.
        unusable: String,
    },
    /// The folder to write to holds what is not ours.
    #[error("{}: is not empty, and has neither .ingest nor ingest.json of an earlier run; name another folder with --out", folder.display())]
    Occupied {
        /// The folder.
        folder: PathBuf,
    },
    /// The photographs are the pictures of the dataset that is to be written.
    #[error("{}: are the pictures of {} itself; name another folder with --out", photographs.display(), out.display())]
    OwnPictures {
        /// The folder of the photographs.
        photographs: PathBuf,
        /// The folder of the dataset.
        out: PathBuf,
    },
    /// COLMAP is not there.
    #[error(
        "{}: COLMAP cannot be started ({cause}); install it (on Debian and Ubuntu `apt-get install colmap`), or name it with --colmap",
        program.display()
    )]
    NoColmap {
        /// The program.
        program: PathBuf,
        /// The error of the system.
        cause: io::Error,
    },
    /// A program is not COLMAP, or does not run.
    #[error("{}: is not COLMAP 3.6 or newer, or does not run ({said}); name another program with --colmap", program.display())]
    NotColmap {
        /// The program.
        program: PathBuf,
        /// The first line that it prints, if it prints any.
        said: String,
    },
    /// A version of COLMAP has other options.
    #[error(
        "{}: COLMAP's {command} has no option --{option}, so this version is too old or too new; name another program, of version 3.6 to 4.2, with --colmap",
        program.display()
    )]
    UnknownColmap {
        /// The program.
        program: PathBuf,
        /// The command of COLMAP.
        command: String,
        /// The option that is missing.
        option: String,
    },
    /// COLMAP failed.
    #[error("COLMAP's {command} failed: {reason}; {} has its output", log.display())]
    Failed {
        /// The command of COLMAP.
        command: String,
        /// Its last line about an error.
        reason: String,
        /// What it printed.
        log: PathBuf,
    },
    /// COLMAP found no poses.
    #[error(
        "COLMAP found the places of {posed} of {photographs} photographs, fewer than 3; they overlap too little, are blurred, show different things or were taken from one place; {} has its output",
        log.display()
    )]
    NoPoses {
        /// Number of photographs with a pose.
        posed: usize,
        /// Number of all photographs.
        photographs: usize,
        /// What COLMAP printed.
        log: PathBuf,
    },
    /// A file cannot be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A place or a list of places cannot be used.
    #[error(transparent)]
    Geo(#[from] GeoError),
}

impl IngestError {
    /// The same error; or, if COLMAP fails because it found no poses, the one that says what this means for the photographs.
    pub(super) fn or_no_poses(self, photographs: usize, log: &Path) -> Self {
        match self {
            Self::Failed { reason, .. } if reason.contains(NO_MODEL) => {
                Self::NoPoses { posed: 0, photographs, log: log.to_owned() }
            }
            other => other,
        }
    }
}
