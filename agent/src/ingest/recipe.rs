//! Which commands of COLMAP make a reconstruction of photographs, and where in the work folder their files lie.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use cosurf_contract::IngestStage;
use cosurf_scene::{SceneError, atomic, files};

use super::colmap::Colmap;
use super::error::IngestError;
use super::masks;
use super::pairs::{NEIGHBOURS, pairs};
use super::photographs::Photographs;
use super::reconstruction::Reconstruction;
use super::stages::{Stage, remove};

/// Long side of a photograph in which features are sought, pixels. Larger ones cost time and bring little.
const FEATURES_PX: u32 = 2400;
/// Features of a photograph, the largest of those that are found; each pair is compared with each other. COLMAP's default,
/// 8192, takes four times as long for the matches of large photographs.
const FEATURES_MAX: u32 = 4096;
/// Up to so many photographs without GPS, each is matched with each.
const EXHAUSTIVE_MAX: usize = 100;
/// Photographs in a block that is matched with another block; COLMAP tells its progress by blocks.
const BLOCK: usize = 10;
/// Bundle adjustment ends when a step improves the residuals by less than this share. COLMAP's default, 0, takes up to three
/// times as long for no visible difference.
const ADJUSTMENT_TOLERANCE: &str = "0.000001";

/// An option: its names, of old and new versions, and its value.
type Choice<'a> = (&'a [&'a str], OsString);

/// The commands for some photographs.
pub(super) struct Recipe<'a> {
    colmap: &'a Colmap,
    photographs: &'a Photographs,
    folder: PathBuf,
    work: PathBuf,
    max_size_px: u32,
}

impl<'a> Recipe<'a> {
    pub(super) fn new(
        colmap: &'a Colmap,
        photographs: &'a Photographs,
        work: &Path,
        max_size_px: u32,
    ) -> Result<Self, IngestError> {
        // Stages are the same ones for a later run from another folder.
        let absolute = |path: &Path| fs::canonicalize(path).map_err(|cause| SceneError::io(path, cause));
        let (folder, work) = (absolute(&photographs.folder)?, absolute(work)?);
        Ok(Self { colmap, photographs, folder, work, max_size_px })
    }

    /// Hash of all photographs and their places.
    pub(super) fn key(&self) -> blake3::Hash {
        let mut hasher = blake3::Hasher::new();
        for photograph in &self.photographs.usable {
            hasher.update(format!("{photograph:?}\n").as_bytes());
        }
        hasher.finalize()
    }

    /// Finds features, with one camera for all photographs of a lens.
    pub(super) fn features(&self) -> Result<Stage, IngestError> {
        let mut commands = Vec::new();
        for (i, lens) in self.photographs.by_lens().into_iter().enumerate() {
            let list = self.work.join(format!("lens-{i}.txt"));
            let names: String = lens.iter().map(|photograph| format!("{}\n", photograph.name)).collect();
            atomic::write_bytes(&list, names.as_bytes())?;
            let mut options = vec![
                self.database(),
                self.images(),
                (&["image_list_path"][..], list.into()),
                (&["ImageReader.camera_model"], "OPENCV".into()),
                (&["ImageReader.single_camera"], "1".into()),
                (&["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"], "0".into()),
                (
                    &["FeatureExtraction.max_image_size", "SiftExtraction.max_image_size"],
                    FEATURES_PX.to_string().into(),
                ),
                (&["SiftExtraction.max_num_features"], FEATURES_MAX.to_string().into()),
            ];
            if self.is_masked() {
                options.push((&["ImageReader.mask_path"], masks::folder(&self.work).into()));
            }
            commands.push((self.colmap.command("feature_extractor", &options)?, lens.len()));
        }
        let database = self.work.join("database.db");
        let removed = ["", "-wal", "-shm"].map(|end| {
            let mut path = database.clone().into_os_string();
            path.push(end);
            path.into()
        });
        let removed = removed.to_vec();
        Ok(Stage { kind: IngestStage::Features, commands, inputs: Vec::new(), removed, folders: Vec::new() })
    }

    /// Matches neighbours, or all if nothing tells the neighbours.
    pub(super) fn matches(&self) -> Result<Stage, IngestError> {
        let usable = &self.photographs.usable;
        let gpu: Choice = (&["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], "0".into());
        // COLMAP's lists of pairs separate names by spaces.
        let can_list = usable.iter().all(|photograph| !photograph.name.contains(char::is_whitespace));
        let command = if usable.iter().all(|photograph| photograph.has_exif_gps) {
            let options = [
                self.database(),
                gpu,
                (&["SpatialMatching.is_gps"][..], "1".into()),
                (&["SpatialMatching.max_num_neighbors"], NEIGHBOURS.to_string().into()),
            ];
            self.colmap.command("spatial_matcher", &options)?
        } else if self.photographs.with_gps() >= 3 && can_list {
            let list = self.work.join("pairs.txt");
            atomic::write_bytes(&list, pairs(usable).as_bytes())?;
            self.colmap
                .command("matches_importer", &[self.database(), gpu, (&["match_list_path"], list.into())])?
        } else if usable.len() <= EXHAUSTIVE_MAX {
            let block = (&["ExhaustiveMatching.block_size"][..], BLOCK.to_string().into());
            self.colmap.command("exhaustive_matcher", &[self.database(), gpu, block])?
        } else {
            self.colmap.command("sequential_matcher", &[self.database(), gpu])?
        };
        let commands = vec![(command, usable.len())];
        let none = Vec::new;
        Ok(Stage { kind: IngestStage::Matches, commands, inputs: none(), removed: none(), folders: none() })
    }

    /// Finds poses, with this seed of COLMAP's draws.
    pub(super) fn poses(&self, seed: u32) -> Result<Stage, IngestError> {
        let options = [
            (&["random_seed", "Mapper.random_seed", "default_random_seed"][..], seed.to_string().into()),
            self.database(),
            self.images(),
            (&["output_path"], self.work.join("sparse").into()),
            (&["Mapper.ba_global_function_tolerance"], ADJUSTMENT_TOLERANCE.into()),
        ];
        let commands = vec![(self.colmap.command("mapper", &options)?, self.photographs.usable.len())];
        let folder = vec![self.work.join("sparse")];
        let inputs = Vec::new();
        Ok(Stage { kind: IngestStage::Poses, commands, inputs, removed: folder.clone(), folders: folder })
    }

    /// The reconstructions that were found, at least one. What COLMAP prints goes to `log`.
    pub(super) fn reconstructions(&self, log: &Path) -> Result<Vec<Reconstruction>, IngestError> {
        let sparse = self.work.join("sparse");
        let failed = |cause| SceneError::io(&sparse, cause);
        let mut folders = Vec::new();
        for entry in fs::read_dir(&sparse).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.join("images.bin").is_file() {
                folders.push(path);
            }
        }
        folders.sort_unstable();
        let text = self.work.join("text");
        let read = |folder: &PathBuf| {
            remove(&text)?;
            files::create_folder(&text)?;
            let options = [
                (&["input_path"][..], folder.into()),
                (&["output_path"], (&text).into()),
                (&["output_type"], "TXT".into()),
            ];
            self.colmap.run(&self.colmap.command("model_converter", &options)?, log, &mut |_| {})?;
            Reconstruction::read(&text)
        };
        let found: Vec<Reconstruction> = folders.iter().map(read).collect::<Result<_, IngestError>>()?;
        if found.is_empty() {
            let photographs = self.photographs.usable.len();
            return Err(IngestError::NoPoses { posed: 0, photographs, log: log.to_owned() });
        }
        Ok(found)
    }

    /// Removes the distortion from the photographs of a reconstruction, and shrinks them.
    pub(super) fn undistorting(&self, its: &Reconstruction) -> Result<Stage, IngestError> {
        let (adjusted, folder) = (self.work.join("adjusted"), self.undistorted());
        its.write(&adjusted)?;
        let undistort = |pictures: &Path, folder: &Path| {
            let options = [
                (&["image_path"][..], pictures.into()),
                (&["input_path"], (&adjusted).into()),
                (&["output_path"], folder.into()),
                (&["output_type"], "COLMAP".into()),
                (&["max_image_size"], self.max_size_px.to_string().into()),
            ];
            Ok::<_, IngestError>((self.colmap.command("image_undistorter", &options)?, its.posed.len()))
        };
        let (mut commands, mut folders) = (vec![undistort(&self.folder, &folder)?], vec![folder]);
        if self.is_masked() {
            let folder = masks::undistorted(&self.work);
            commands.push(undistort(&masks::as_pictures(&self.work), &folder)?);
            folders.push(folder);
        }
        let inputs = vec![adjusted.join("cameras.bin"), adjusted.join("images.bin")];
        let removed = folders.clone();
        Ok(Stage { kind: IngestStage::Undistorting, commands, inputs, removed, folders })
    }

    fn is_masked(&self) -> bool {
        self.photographs.usable.iter().any(|photograph| photograph.mask.is_some())
    }

    /// The folder of the undistorted dataset.
    pub(super) fn undistorted(&self) -> PathBuf {
        self.work.join("undistorted")
    }

    fn database(&self) -> Choice<'static> {
        (&["database_path"], self.work.join("database.db").into())
    }

    fn images(&self) -> Choice<'static> {
        (&["image_path"], (&self.folder).into())
    }
}
