//! The photographs of a folder, and what their EXIF, their XMP and the lists beside them tell.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use cosurf_geo::{ControlPoint, Gps, PhotoInfo, read_gcp_list, read_geo_txt};
use cosurf_scene::{FRAMES_COMMAND, Mask, Picture, SceneError, is_of_masks, is_video, mask_of};

use super::error::IngestError;
use super::gps::{a_few, apart_m, list_elsewhere};

/// Most photographs of a dataset.
const PHOTOGRAPHS_MAX: usize = 100_000;
/// Depth of folders, as cameras make them (`DCIM/100MEDIA`).
const DEPTH_MAX: usize = 4;
/// Longest accepted name, bytes.
const NAME_BYTES_MAX: usize = 1000;

/// Extensions of pictures that are not read.
const PICTURES: [&str; 14] =
    ["dng", "cr2", "cr3", "nef", "arw", "raf", "rw2", "orf", "heic", "heif", "tif", "tiff", "webp", "bmp"];

/// A usable photograph.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Photograph {
    /// Path below the folder, with `/` between its parts.
    pub(super) name: String,
    /// The stored size, pixels.
    pub(super) size_px: [u32; 2],
    /// The camera, as EXIF names it.
    pub(super) camera: String,
    pub(super) gps: Option<Gps>,
    /// Whether EXIF has the same place, so that COLMAP finds it too.
    pub(super) has_exif_gps: bool,
    /// Whether the place is that of `geo.txt`.
    pub(super) is_listed: bool,
    /// Size and time of the file, which tell whether it is the same as in an earlier run.
    pub(super) state: [u64; 2],
    /// The mask, and the same of its file.
    pub(super) mask: Option<(Mask, [u64; 2])>,
}

/// Usable photographs, in the order of their names.
pub(super) struct Photographs {
    /// The folder that their names begin at.
    pub(super) folder: PathBuf,
    pub(super) usable: Vec<Photograph>,
    /// Names and reasons of those that are left out.
    pub(super) left_out: Vec<(String, String)>,
    /// What else is not used: names and reasons.
    pub(super) notes: Vec<(String, String)>,
    pub(super) control: Vec<ControlPoint>,
}

impl Photographs {
    /// Reads a folder, or its folder `images`, with `geo.txt` and `gcp_list.txt` beside the photographs or above that folder.
    pub(super) fn read(root: &Path) -> Result<Self, IngestError> {
        let below = root.join("images");
        let folder = if below.is_dir() { below } else { root.to_owned() };
        let mut names = Vec::new();
        let mut others = Others::default();
        collect(&folder, "", DEPTH_MAX, &mut names, &mut others)?;
        names.sort_unstable();
        let list = |name| [&folder, root].map(|at| at.join(name)).into_iter().find(|path| path.is_file());
        let mut places: HashMap<String, Gps> = match list("geo.txt") {
            Some(path) => read_geo_txt(&path)?.into_iter().map(|place| (place.name, place.gps)).collect(),
            None => HashMap::new(),
        };
        let unused = places_of_others(&places, &names);
        let of_several: Vec<String> =
            repeated(&names).into_iter().filter(|name| places.remove(name).is_some()).collect();
        let control = list("gcp_list.txt").map(|path| read_gcp_list(&path)).transpose()?.unwrap_or_default();
        let mut notes: Vec<(String, String)> = unused.into_iter().chain(others.told()).collect();
        let reason =
            "is the name of several photographs, so its place does not count; write their folders too";
        notes.extend(of_several.into_iter().map(|name| (format!("{name} of geo.txt"), reason.into())));
        let mut all = Self { folder, usable: Vec::new(), left_out: Vec::new(), notes, control };
        let mut off_m = Vec::new();
        for name in names {
            match read(&all.folder, &name, &places, root) {
                Ok((photograph, exif)) => {
                    off_m.extend(photograph.gps.zip(exif).map(|(gps, exif)| apart_m(&gps, &exif)));
                    all.usable.push(photograph);
                }
                Err(reason) => all.left_out.push((name, reason)),
            }
        }
        all.notes.extend(list_elsewhere(off_m));
        all.leave_out_copies()?;
        all.enough()
    }

    /// Of files with the same content, leaves the first. They would count as views that agree.
    fn leave_out_copies(&mut self) -> Result<(), IngestError> {
        let mut lengths: HashMap<u64, usize> = HashMap::new();
        self.usable.iter().for_each(|its| *lengths.entry(its.state[0]).or_default() += 1);
        let mut first: HashMap<blake3::Hash, String> = HashMap::new();
        let mut copies = Vec::new();
        for its in self.usable.iter().filter(|its| lengths[&its.state[0]] > 1) {
            let path = self.folder.join(&its.name);
            let mut hasher = blake3::Hasher::new();
            let read = fs::File::open(&path).and_then(|file| hasher.update_reader(file).map(drop));
            read.map_err(|cause| SceneError::io(&path, cause))?;
            match first.entry(hasher.finalize()) {
                Entry::Occupied(of) => copies.push((its.name.clone(), format!("is a copy of {}", of.get()))),
                Entry::Vacant(place) => drop(place.insert(its.name.clone())),
            }
        }
        self.usable.retain(|its| copies.binary_search_by(|(name, _)| name.cmp(&its.name)).is_err());
        self.left_out.extend(copies);
        Ok(())
    }

    /// An error if there are too few.
    pub(super) fn enough(self) -> Result<Self, IngestError> {
        let found = self.usable.len();
        if found >= 3 {
            return Ok(self);
        }
        let Self { folder, left_out, notes, .. } = self;
        // Names may have line breaks.
        let unusable = left_out
            .iter()
            .chain(&notes)
            .next()
            .map(|(name, reason)| format!("; {}: {reason}", name.escape_debug()));
        Err(IngestError::TooFew { folder, found, unusable: unusable.unwrap_or_default() })
    }

    /// Number of usable photographs with GPS.
    pub(super) fn with_gps(&self) -> usize {
        self.usable.iter().filter(|photograph| photograph.gps.is_some()).count()
    }

    /// The photographs of each lens: those of one camera, focal length and size.
    pub(super) fn by_lens(&self) -> Vec<Vec<&Photograph>> {
        let mut lenses: BTreeMap<_, Vec<&Photograph>> = BTreeMap::new();
        for photograph in &self.usable {
            lenses.entry((&photograph.camera, photograph.size_px)).or_default().push(photograph);
        }
        lenses.into_values().collect()
    }
}

/// Files that could be photographs or videos, and are not used.
#[derive(Debug, Default)]
struct Others {
    videos: Vec<String>,
    pictures: Vec<String>,
}

impl Others {
    /// Notes a file if it is one.
    fn add(&mut self, path: &Path, name: &str) {
        let end = path.extension().unwrap_or_default();
        let is_picture = PICTURES.iter().any(|known| end.eq_ignore_ascii_case(known));
        if is_video(path) {
            self.videos.push(name.to_owned());
        } else if is_picture || path.is_symlink() {
            self.pictures.push(name.to_owned());
        }
    }

    /// Names and reasons, for each kind.
    fn told(&self) -> impl Iterator<Item = (String, String)> {
        let kinds = [
            (
                &self.videos,
                format!("no photographs; extract some with `{FRAMES_COMMAND}`, and add their places"),
            ),
            (&self.pictures, "no JPEG or PNG that can be read; convert them, with their EXIF".to_owned()),
        ];
        kinds.into_iter().filter(|(files, _)| !files.is_empty()).map(|(files, reason)| {
            let names = a_few(files.iter().map(String::as_str));
            (names, format!("{} in all, {reason}", files.len()))
        })
    }
}

/// What is told of places in `geo.txt` whose photographs are not there.
fn places_of_others(places: &HashMap<String, Gps>, names: &[String]) -> Option<(String, String)> {
    let lasts = names.iter().map(|name| name.rsplit('/').next().unwrap_or(name));
    let here: HashSet<&str> = names.iter().map(String::as_str).chain(lasts).collect();
    let missing: Vec<&str> = places.keys().map(String::as_str).filter(|name| !here.contains(name)).collect();
    let told = || {
        format!(
            "{} of its places are of photographs that are not here ({})",
            missing.len(),
            a_few(missing.iter().copied())
        )
    };
    (!missing.is_empty()).then(|| ("geo.txt".to_owned(), told()))
}

/// Names of files that several folders have, in their order.
fn repeated(names: &[String]) -> BTreeSet<String> {
    let mut seen = HashSet::new();
    let lasts = names.iter().map(|name| name.rsplit('/').next().unwrap_or(name));
    lasts.filter(|last| !seen.insert(*last)).map(str::to_owned).collect()
}

/// Adds the names of all pictures of a folder and of the folders below.
fn collect(
    folder: &Path,
    prefix: &str,
    depth: usize,
    names: &mut Vec<String>,
    others: &mut Others,
) -> Result<(), IngestError> {
    let failed = |cause| SceneError::io(folder, cause);
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let is_picture = Path::new(&name).extension().is_some_and(|extension| {
            ["jpg", "jpeg", "png"].iter().any(|known| extension.eq_ignore_ascii_case(known))
        });
        let name = format!("{prefix}{}", name.to_string_lossy());
        let path = entry.path();
        let last = entry.file_name();
        let last = last.to_string_lossy();
        let is_left_out = last.starts_with('.') || prefix.is_empty() && is_of_masks(&last);
        if path.is_dir() && depth > 0 && !is_left_out {
            collect(&path, &format!("{name}/"), depth - 1, names, others)?;
        } else if is_picture && path.is_file() {
            names.push(name);
        } else {
            others.add(&path, &name);
        }
        if names.len() > PHOTOGRAPHS_MAX {
            let reason = "has more than 100,000 photographs; give folders of single flights";
            return Err(SceneError::malformed(folder, reason).into());
        }
    }
    Ok(())
}

/// A photograph, and the place that its EXIF tells; the reason in words if it cannot be used.
fn read(
    folder: &Path,
    name: &str,
    places: &HashMap<String, Gps>,
    masks_beside: &Path,
) -> Result<(Photograph, Option<Gps>), String> {
    // COLMAP reads names from lists with a line for each.
    if name.contains(|c: char| c.is_control() || c == char::REPLACEMENT_CHARACTER)
        || name.len() > NAME_BYTES_MAX
    {
        return Err("has a name that COLMAP cannot read; rename it".into());
    }
    let path = folder.join(name);
    let size_px = Picture::size_of_whole(&path).map_err(|error| reason(&error))?;
    let info = PhotoInfo::read(&path).map_err(|error| error.to_string())?;
    let mask = mask_of(masks_beside, Path::new(name));
    let mask = mask.map(|mask| state(&mask.path).map(|state| (mask, state))).transpose()?;
    let listed = places.get(name).or_else(|| places.get(name.rsplit('/').next().unwrap_or(name))).copied();
    let photograph = Photograph {
        name: name.to_owned(),
        size_px,
        camera: info.camera,
        gps: listed.or(info.gps),
        has_exif_gps: info.has_exif_gps && listed.is_none(),
        is_listed: listed.is_some(),
        state: state(&path)?,
        mask,
    };
    Ok((photograph, info.gps))
}

/// Size and time of a file.
fn state(path: &Path) -> Result<[u64; 2], String> {
    let file = fs::metadata(path).map_err(|error| error.to_string())?;
    let time = file.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    Ok([file.len(), time.map_or(0, |time| time.as_nanos() as u64)])
}

/// The reason of an error, without the path, which is told beside it.
pub(super) fn reason(error: &SceneError) -> String {
    match error {
        SceneError::Malformed { reason, .. } => reason.clone(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::{Seek, SeekFrom, Write};

    use super::*;

    /// Writes a picture that depends on its path.
    fn photograph(path: &Path, size_px: [u32; 2]) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let bytes = size_px[0] * size_px[1] * 3;
        // All 32 bytes: of three pictures that depend on one byte, two are equal in one run of a hundred.
        let name = blake3::hash(path.as_os_str().as_encoded_bytes());
        let value = |i: u32| (i % 199) as u8 ^ name.as_bytes()[i as usize % 32];
        let picture = Picture::new(size_px, (0..bytes).map(value).collect());
        picture.write_jpeg(path, 90).unwrap();
    }

    #[test]
    fn names_of_all_kinds_are_found_and_bad_files_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["B.JPG", "a b ü.jpeg", "100MEDIA/B.JPG", "100MEDIA/D.JPG", ".hidden/c.jpg"] {
            photograph(&at(name), [32, 24]);
        }
        photograph(&at("portrait.jpg"), [24, 32]);
        photograph(&at("two\nlines.jpg"), [32, 24]);
        fs::write(at("empty.jpg"), "").unwrap();
        let whole = fs::read(at("B.JPG")).unwrap();
        fs::write(at("short.JPG"), &whole[..whole.len() - 50]).unwrap();
        photograph(&at("masks/B.JPG.png"), [32, 24]);
        fs::write(at("notes.txt"), "no picture").unwrap();
        for name in ["film.MP4", "raw.DNG", "raw.dng"] {
            fs::write(at(name), "not read").unwrap();
        }
        let places =
            "EPSG:4326\nB.JPG 16.5 53.0 70\nD.JPG 16.5 53.0 70\nportrait.jpg 16.5 53.0 70\nE.JPG 16.5 53.0\n";
        fs::write(at("geo.txt"), places).unwrap();
        let found = Photographs::read(folder.path()).unwrap();
        let names: Vec<&str> = found.usable.iter().map(|photograph| &*photograph.name).collect();
        assert_eq!(names, ["100MEDIA/B.JPG", "100MEDIA/D.JPG", "B.JPG", "a b ü.jpeg", "portrait.jpg"]);
        let masked: Vec<&str> =
            found.usable.iter().filter(|its| its.mask.is_some()).map(|its| &*its.name).collect();
        assert_eq!(masked, ["B.JPG"]);
        assert_eq!(found.with_gps(), 2, "geo.txt of ODM names files without folders");
        assert_eq!(found.by_lens().iter().map(Vec::len).collect::<Vec<_>>(), [1, 4]);
        let left_out: Vec<&str> = found.left_out.iter().map(|(name, _)| &**name).collect();
        assert_eq!(left_out, ["empty.jpg", "short.JPG", "two\nlines.jpg"]);
        assert!(found.left_out[2].1.contains("rename it"), "{:?}", found.left_out);
        assert!(found.left_out[1].1.contains("cut short"), "{:?}", found.left_out);
        let notes: Vec<&str> = found.notes.iter().map(|(name, _)| &**name).collect();
        assert_eq!(notes, ["geo.txt", "film.MP4", "raw.DNG, raw.dng", "B.JPG of geo.txt"]);
        let told = |index: usize| found.notes[index].1.as_str();
        assert_eq!(told(0), "1 of its places are of photographs that are not here (E.JPG)");
        assert!(told(1).starts_with("1 in all, no photographs; extract some with `ffmpeg"), "{}", told(1));
    }

    /// They would count as views that agree.
    #[test]
    fn copies_of_a_photograph_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["a.jpg", "b.jpg", "c.jpg"] {
            photograph(&at(name), [32, 24]);
        }
        fs::create_dir(at("card")).unwrap();
        for name in ["d.jpg", "card/b.jpg"] {
            fs::copy(at("b.jpg"), at(name)).unwrap();
        }
        let found = Photographs::read(folder.path()).unwrap();
        let names: Vec<&str> = found.usable.iter().map(|photograph| &*photograph.name).collect();
        assert_eq!(names, ["a.jpg", "b.jpg", "c.jpg"]);
        let told = |name: &str| (name.to_owned(), "is a copy of b.jpg".to_owned());
        assert_eq!(found.left_out, ["card/b.jpg", "d.jpg"].map(told));
    }

    /// A file in which 1 GiB of zeros, which take no space on the disk, follow the first `begin` bytes of a picture.
    fn with_gap(path: &Path, picture: &[u8], begin: usize, header: &[u8]) {
        const GAP_BYTES: u64 = 1 << 30;
        let mut file = fs::File::create(path).unwrap();
        file.write_all(&picture[..begin]).unwrap();
        file.write_all(header).unwrap();
        file.seek(SeekFrom::Current(GAP_BYTES as i64)).unwrap();
        file.write_all(&picture[begin..]).unwrap();
        assert!(file.metadata().unwrap().len() > GAP_BYTES);
    }

    #[test]
    fn a_gigabyte_of_exif_takes_neither_time_nor_memory() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        photograph(&at("a.jpg"), [32, 24]);
        photograph(&at("b.jpg"), [32, 24]);
        photograph(&at("c.jpg"), [32, 24]);
        let jpeg = fs::read(at("a.jpg")).unwrap();
        // EXIF that claims 64 KiB, the most of a segment, and is far longer.
        with_gap(&at("long.jpg"), &jpeg, 2, b"\xff\xe1\xff\xffExif\0\0II*\0\x08\0\0\0");
        Picture::new([32, 24], vec![9; 32 * 24 * 3]).write_png(&at("small.png")).unwrap();
        let png = fs::read(at("small.png")).unwrap();
        fs::remove_file(at("small.png")).unwrap();
        // A chunk that does have 1 GiB, behind the header of 33 bytes.
        let chunk = [&(1_u32 << 30).to_be_bytes()[..], b"eXIf"].concat();
        with_gap(&at("long.png"), &[&png[..33], &[0; 4], &png[33..]].concat(), 33, &chunk);
        let begun = std::time::Instant::now();
        let found = Photographs::read(folder.path()).unwrap();
        let names: Vec<&str> = found.usable.iter().map(|photograph| &*photograph.name).collect();
        // A chunk of a PNG may be as long as it likes; what it tells is not read.
        assert_eq!(names, ["a.jpg", "b.jpg", "c.jpg", "long.png"], "{:?}", found.left_out);
        assert_eq!((found.usable[3].gps, found.left_out.len()), (None, 1), "{:?}", found.left_out);
        assert!(found.left_out[0].1.contains("damaged"), "{:?}", found.left_out);
        assert!(begun.elapsed().as_secs() < 20, "{:?}", begun.elapsed());
    }

    #[test]
    fn too_few_photographs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("images")).unwrap();
        for (name, count) in [("notes.txt", 0), ("a.jpg", 1), ("b.jpg", 2)] {
            photograph(&folder.path().join("images").join(name), [32, 24]);
            let error = Photographs::read(folder.path()).err().unwrap().to_string();
            assert!(error.contains(&format!("images: has {count} usable photographs")), "{error}");
            assert!(error.ends_with("overlap"), "{error}");
        }
        photograph(&folder.path().join("images/two\nlines.jpg"), [32, 24]);
        let error = Photographs::read(folder.path()).err().unwrap().to_string();
        assert!(error.contains(r"overlap; two\nlines.jpg: ") && error.contains("rename it"), "{error}");
    }
}
