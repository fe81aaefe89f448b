//! Opens datasets: recognises their layout, and checks that every picture exists and has the size of
//! its camera.

#[cfg(test)]
mod tests;

use std::path::{Component, Path, PathBuf};

use crate::layout::Layout;
use crate::sieve::Sieve;
use crate::{
    Camera, Dataset, Picture, SceneError, Shot, View, advice, camera_list, colmap, files, leftovers,
    mask_files, metashape, opensfm, realitycapture, tie_points, transforms,
};

/// Reason in the error for a dataset without views.
const NO_VIEWS: &str = "has no pictures with poses";

/// Most that the sparse points take that masks are compared with, bytes.
const NOTES_POINTS_BYTES: usize = 4 << 20;

/// An opened dataset, and what of it is not used.
#[derive(Clone, Debug)]
pub struct Opened {
    /// The dataset.
    pub dataset: Dataset,
    /// Of so many sparse points in a row, one was kept.
    pub stride: usize,
    /// A line for each picture that is damaged, whose view is left out.
    pub damaged: Vec<String>,
}

impl Dataset {
    /// Opens a COLMAP model, a `transforms.json`, a `reconstruction.json` of OpenSfM, or the cameras of Metashape (XML) or
    /// RealityCapture (CSV or XMP). For all but COLMAP's, `path` is the file or its folder. For a COLMAP model, `path` is the
    /// model's folder, or a folder with the model in `sparse/0`, `sparse` or `0`. COLMAP's pictures are in `path/images`, in
    /// a folder `images` beside the model's folder or one level further up, or in `path` itself.
    ///
    /// Reads the header of every picture. If a picture has another size than its camera but the same
    /// aspect ratio, the camera is rescaled. Errors: a dataset that cannot be read or has no pictures;
    /// invalid or repeated names; pictures that are missing, damaged in their header or of another
    /// aspect ratio.
    pub fn open(path: &Path) -> Result<Self, SceneError> {
        Ok(Self::open_within(path, usize::MAX)?.dataset)
    }

    /// As [`Self::open`], with points that take at most about `points_bytes_max`. If there are more, every second one is
    /// left out, or three of four, and so on. Views whose pictures are damaged (cut short, empty, or no pictures) are left out,
    /// unless these are more than half of all.
    pub fn open_within(path: &Path, points_bytes_max: usize) -> Result<Opened, SceneError> {
        let (mut dataset, stride) = read(path, points_bytes_max)?;
        if dataset.views.iter().any(|view| view.path.as_os_str().is_empty()) {
            let reason = "holds the cameras of a model, but no pictures; name the dataset that has them";
            return Err(SceneError::malformed(path, reason));
        }
        order(path, &mut dataset)?;
        refuse_missing(&dataset.views)?;
        let damaged = leave_out_damaged(&mut dataset)?;
        mask_files::refuse_missing(&dataset.views)?;
        dataset.views.iter_mut().try_for_each(fit_camera)?;
        Ok(Opened { dataset, stride, damaged })
    }

    /// The views of a dataset or of a model's folder, in which `cameras.json` has the cameras, without sparse points. The
    /// pictures may be missing.
    pub fn posed(path: &Path) -> Result<Self, SceneError> {
        let (mut dataset, _) = read(path, 0)?;
        dataset.points.clear();
        order(path, &mut dataset)?;
        dataset.views.iter_mut().filter(|view| view.path.is_file()).try_for_each(fit_camera)?;
        Ok(dataset)
    }

    /// The cameras of a dataset or of a model's folder, as [`Self::posed`] reads them, in the file's order. The pictures may
    /// be missing, unless a `transforms.json` does not give their sizes.
    pub fn cameras(path: &Path) -> Result<Vec<Camera>, SceneError> {
        let (dataset, _) = read(path, 0)?;
        let cameras: Vec<Camera> = dataset.views.iter().map(|view| view.camera).collect();
        if cameras.is_empty() {
            return Err(SceneError::malformed(path, NO_VIEWS));
        }
        Ok(cameras)
    }

    /// What is in a dataset and is not used, or may not be as the user thinks, a line for each. Nothing if the dataset cannot
    /// be read: opening it tells why.
    pub fn notes(path: &Path) -> Vec<String> {
        let dataset = read(path, NOTES_POINTS_BYTES).ok().map(|(dataset, _)| dataset);
        let mut notes = leftovers::of(path, dataset.as_ref().and_then(|dataset| dataset.views.first()));
        notes.extend(dataset.iter().flat_map(mask_files::notes));
        notes.extend(tie_points::note(path));
        notes
    }

    /// Takes the pictures from a folder beside theirs that has smaller ones, `images_2`, `images_4` or `images_8`, if it has
    /// all of them, and they are at least as large as pictures with a long side of `long_side_px`. Returns the folder.
    pub fn take_smaller_pictures(&mut self, long_side_px: u32) -> Option<PathBuf> {
        let (views, folder) = smaller_pictures(&self.views, long_side_px)?;
        self.views = views;
        Some(folder)
    }

    /// Whether a folder has poses in a layout that [`Self::open`] knows. Whether they can be read is another question.
    pub fn has_poses(folder: &Path) -> bool {
        Layout::of_folder(folder).is_some()
    }

    /// Whether a path is a folder of photographs, directly or in `images`, without any file of poses.
    pub fn is_without_poses(path: &Path) -> bool {
        !Self::has_poses(path) && (advice::has_pictures(path) || advice::has_pictures(&path.join("images")))
    }
}

/// The views in the file's order, the points, and of how many points in a row one was kept.
fn read(path: &Path, points_bytes_max: usize) -> Result<(Dataset, usize), SceneError> {
    let mut sieve = Sieve::new(points_bytes_max);
    let mut views = read_into(&mut sieve, path)?;
    mask_files::attach(files::folder_of(path), &mut views);
    let (points, stride) = sieve.end();
    Ok((Dataset { views, points }, stride))
}

/// Checks the names of the views, and sorts the views by them.
fn order(path: &Path, dataset: &mut Dataset) -> Result<(), SceneError> {
    if dataset.views.is_empty() {
        return Err(SceneError::malformed(path, NO_VIEWS));
    }
    for view in &mut dataset.views {
        view.name = inner_name(&view.name).ok_or_else(|| {
            SceneError::malformed(path, format!("'{}' is not a valid picture name", view.name))
        })?;
    }
    sort(dataset);
    match dataset.views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        Some(pair) => {
            let reason = format!("two pictures are called {}; rename one of them", pair[0].name);
            Err(SceneError::malformed(path, reason))
        }
        None => Ok(()),
    }
}

fn read_into(sieve: &mut Sieve, path: &Path) -> Result<Vec<View>, SceneError> {
    match Layout::of(path)? {
        Layout::Colmap(model) => colmap::read(path, &model, sieve),
        Layout::Transforms(file) => transforms::read(&file, sieve),
        Layout::OpenSfm(file) => opensfm::read(&file, sieve),
        Layout::CameraList(file) => camera_list::read_views(&file),
        Layout::Metashape(file) => {
            let cameras = metashape::read(&file)?;
            // `notes` tells of points that are not used.
            tie_points::read_into(sieve, &file, &cameras);
            views(cameras.shots, &file)
        }
        Layout::RealityCaptureCsv(file) => views(realitycapture::read_csv(&file)?, &file),
        Layout::RealityCaptureXmp(files) => views(realitycapture::read_xmp(&files)?, path),
    }
}

/// The views of an export, unless a lens is distorted.
fn views(shots: Vec<Shot>, file: &Path) -> Result<Vec<View>, SceneError> {
    shots.into_iter().map(|shot| shot.into_view(file)).collect()
}

/// Removes components such as `..` from a picture's name, so that a result file named after the
/// picture stays inside its folder. `None` if nothing remains or the name has control characters.
pub(crate) fn inner_name(name: &str) -> Option<String> {
    let parts = Path::new(name).components().filter_map(|component| match component {
        Component::Normal(part) => part.to_str(),
        _ => None,
    });
    let inner = parts.collect::<Vec<_>>().join("/");
    (!inner.is_empty() && !inner.contains(|c: char| c.is_control())).then_some(inner)
}

/// Sorts the views by name, and renumbers the tracks of the points accordingly.
fn sort(dataset: &mut Dataset) {
    let mut order: Vec<usize> = (0..dataset.views.len()).collect();
    order.sort_by(|&a, &b| dataset.views[a].name.cmp(&dataset.views[b].name));
    let mut new_of_old = vec![0; order.len()];
    for (new, &old) in order.iter().enumerate() {
        new_of_old[old] = new as u32;
    }
    dataset.views.sort_by(|a, b| a.name.cmp(&b.name));
    for point in &mut dataset.points {
        point.views.iter_mut().for_each(|view| *view = new_of_old[*view as usize]);
        point.views.sort_unstable();
    }
}

/// Factors of the folders of smaller pictures, as 3DGS datasets name them.
const SHRUNK: [u32; 3] = [8, 4, 2];

/// The views with the smallest pictures that suffice, and the folder of these pictures; `None` if there are no smaller ones.
fn smaller_pictures(views: &[View], long_side_px: u32) -> Option<(Vec<View>, PathBuf)> {
    let long = |camera: &Camera| camera.size_px[0].max(camera.size_px[1]);
    SHRUNK.into_iter().find_map(|factor| {
        let mut folder = None;
        let shrunk = views.iter().map(|view| {
            let path = in_shrunk_folder(view, factor)?;
            let wanted = long(&view.camera).min(long_side_px);
            let mut view = View { path, ..view.clone() };
            fit_camera(&mut view).ok()?;
            folder.get_or_insert_with(|| view.path.parent().unwrap_or(Path::new("")).to_owned());
            (long(&view.camera) >= wanted).then_some(view)
        });
        Some((shrunk.collect::<Option<Vec<View>>>()?, folder?))
    })
}

/// The picture of a view in the folder `images_N`; `None` if it is not there.
fn in_shrunk_folder(view: &View, factor: u32) -> Option<PathBuf> {
    let images = view.path.ancestors().find(|folder| folder.ends_with("images"))?;
    let inner = view.path.strip_prefix(images).ok()?;
    let path = images.with_file_name(format!("images_{factor}")).join(inner);
    let path = files::in_any_case(path);
    // Tools that shrink pictures often write them as PNG.
    let png = path.with_extension("png");
    [path, png].into_iter().find(|path| path.is_file())
}

pub(crate) fn refuse_missing(views: &[View]) -> Result<(), SceneError> {
    let mut missing = views.iter().filter(|view| !view.path.is_file());
    let Some(first) = missing.next() else { return Ok(()) };
    if first.path.exists() {
        return files::open(&first.path).map(drop); // tells what is there
    }
    let others = missing.count();
    let reason = format!(
        "this picture is missing, and {others} more of the dataset's {}; add them, or remove them from the dataset",
        views.len()
    );
    Err(SceneError::malformed(&first.path, reason))
}

/// Leaves out views whose pictures are damaged, and returns a line for each: a disk that was full, or a card that was
/// pulled out, damages the last one. If more than half are damaged, something else is wrong. Pixels are not decoded.
fn leave_out_damaged(dataset: &mut Dataset) -> Result<Vec<String>, SceneError> {
    let (mut whole, mut damaged) = (Vec::new(), Vec::new());
    for (i, view) in dataset.views.iter().enumerate() {
        match Picture::size_of_whole(&view.path) {
            Ok(_) => whole.push(i),
            Err(error) => damaged.push(error),
        }
    }
    if damaged.len() > whole.len() {
        return Err(damaged.swap_remove(0));
    }
    if !damaged.is_empty() {
        *dataset = dataset.subset(&whole);
    }
    Ok(damaged.iter().map(SceneError::to_string).collect())
}

/// Rescales the view's camera to the size of its picture on disk. Fails if the size cannot be read, or if the picture's
/// aspect ratio differs from the camera's.
pub(crate) fn fit_camera(view: &mut View) -> Result<(), SceneError> {
    let found = Picture::size_of(&view.path)?;
    let [width, height] = view.camera.size_px.map(f64::from);
    let ([w, h], [found_width, found_height]) = (found.map(f64::from), found);
    // The tool that resized the picture had to round one side to whole pixels, so one pixel of
    // difference is allowed.
    let same_aspect = (w * height / width - h).abs() <= 1.0 || (h * width / height - w).abs() <= 1.0;
    if !same_aspect {
        let [width, height] = view.camera.size_px;
        let remedy = match Picture::orientation(&view.path) {
            Some(5..=8) => {
                "its EXIF orientation turns it on its side, which is not applied: turn the file, for example with `mogrify -auto-orient`"
            }
            _ => "use the picture that belongs to the camera",
        };
        let reason = format!(
            "has {found_width} × {found_height} pixels, but its camera has {width} × {height}, another aspect ratio; {remedy}"
        );
        return Err(SceneError::malformed(&view.path, reason));
    }
    if found != view.camera.size_px {
        view.camera = view.camera.resized(found);
    }
    Ok(())
}
