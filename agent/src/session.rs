//! A training session: turns a plan into a trained model within the plan's memory limit. A session can resume from
//! every checkpoint of the same training.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use cosurf_contract::counted;
use cosurf_engine::backend::{Channels, TargetRgb};
use cosurf_engine::budget::{Budget, BudgetError, DRIVER_BYTES, Wish};
use cosurf_engine::init::{Form, splats_from_points};
use cosurf_engine::train::StepOutcome;
use cosurf_engine::{
    AnyBackend, Backend, Device, DeviceChoice, DeviceLost, Example, Neighbours, PoseChoice, PruneSettings,
    Schedule, SurfaceSettings, TrainSettings, Trainer, TrainingViews, typical_depth,
};
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::cache::Source;
use cosurf_scene::{
    Camera, Dataset, LocalFrame, ORIGIN_MAX, Opened, PictureCache, SCENE_SIZES, Shrinking, SparsePoint,
    Splats, View, mask,
};
use glam::DVec3;
use tracing::info_span;

use crate::checkpoint::{Checkpoint, Fingerprint};
use crate::training_frame::TrainingFrame;
use crate::warm_start::{VisibleSplats, read_visible_splats};
use crate::{random_start, training_frame};

/// Degree of the spherical harmonics that the model stores for its colours.
pub const SH_DEGREE: u32 = 3;

/// Smallest number of training views. The surface losses compare two views; a third makes it likely that some ground is in
/// two of them.
pub(crate) const VIEWS_MIN: usize = 3;

/// The sparse points take at most one part in so many of the memory. There are two copies of them for a while: all, and
/// those of the training views.
const POINTS_PER_MEMORY: u64 = 8;

/// Limits the model to one splat for this many pixels of all training pictures together, or to one splat for each
/// sparse point if that is more. Too little memory lowers the limit. With more splats, each would be observed in too
/// few pixels to be told from noise; with fewer, the model loses detail.
const PIXELS_PER_SPLAT: u64 = 24;
/// Like [`PIXELS_PER_SPLAT`], for a model that will be merged. Only a few of the agent's pictures show the ground
/// beyond the agent's own cell, so with more pixels per splat that ground would get too few splats. The merged model
/// does not keep all these splats, because the merge gives each area one owner.
const PIXELS_PER_SPLAT_OF_MANY: u64 = 16;

/// Long sides of the training pictures, as shares of the long side that the plan asks for. They are tried in this order
/// until the training fits into the memory.
const SIZE_STEPS: [f64; 10] = [1.0, 0.8, 0.63, 0.5, 0.35, 0.25, 0.18, 0.125, 0.09, 0.0625];
/// Pictures are not shrunk below this long side, px, and below a quarter.
const SHRUNK_PX_MIN: u32 = 320;

/// What to train.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainPlan {
    /// The dataset's folder.
    pub data: PathBuf,
    /// How the views are divided into training views and held-out views.
    pub split: Split,
    /// Number of training steps, at least 1.
    pub steps: u32,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Limit on the process's resident memory, bytes.
    pub memory_bytes: u64,
    /// Limit on the long side of the training pictures, px; larger pictures are shrunk.
    pub max_size_px: u32,
    /// The device to train on.
    pub device: DeviceChoice,
    /// Number of CPU threads, at least 1.
    pub threads: usize,
    /// The surface losses; `None` trains colour only.
    pub surface: Option<SurfaceSettings>,
    /// Settings of pruning; `None` for no pruning.
    pub prune: Option<PruneSettings>,
    /// Whether to learn an exposure for each picture.
    pub exposure: bool,
    /// Whether to learn the poses of the pictures. With [`PoseChoice::Auto`] they are taken as exact without the surface
    /// losses, and if the memory is too small.
    pub poses: PoseChoice,
    /// A file of splats, PLY or SPZ, to start from, for example an earlier model of the ground in the pictures; `None`
    /// starts from the sparse points of the dataset, or from random ones. If the dataset has no sparse points, the centres
    /// of these splats stand in for them.
    pub init: Option<PathBuf>,
    /// Whether the model will be merged with other models. If so, it gets more splats, and keeps splats that only one
    /// view observes.
    pub one_of_many: bool,
}

/// How the views of a dataset are divided into training views and held-out views.
#[derive(Clone, Debug, PartialEq)]
pub enum Split {
    /// Every n-th view by sorted name is held out; 0 holds out none.
    Every(u32),
    /// The views of both kinds are given by name; views that are not named are not used.
    Named {
        /// Names of the training views.
        train: Vec<String>,
        /// Names of the held-out views.
        held_out: Vec<String>,
    },
}

/// Opens the plan's dataset, with as many sparse points as the plan's memory has room for. Also returns of how many points
/// in a row one was kept.
pub fn open_dataset(plan: &TrainPlan) -> Result<Opened> {
    let points_bytes_max = (plan.memory_bytes / POINTS_PER_MEMORY) as usize;
    Ok(Dataset::open_within(&plan.data, points_bytes_max)?)
}

/// The world cameras of the plan's training views, for pictures of at most the plan's size.
pub fn flight(plan: &TrainPlan) -> Result<Vec<Camera>> {
    let Opened { dataset, .. } = Dataset::open_within(&plan.data, 0)?;
    let (train, _) = split(&dataset, &plan.split)?;
    let shrunk = |camera: &Camera| {
        let long_side_px = camera.size_px[0].max(camera.size_px[1]).min(plan.max_size_px);
        camera.fitted(long_side_px)
    };
    Ok(train.into_iter().map(|i| shrunk(&dataset.views[i].camera)).collect())
}

/// A training in progress. The trainer computes in a frame of its own. What the session returns is in [`Self::frame`], unless
/// its documentation names another frame.
pub struct Session {
    frame: LocalFrame,
    training_frame: TrainingFrame,
    /// The training cameras as the dataset gives them, in `frame`.
    given_cameras: Vec<Camera>,
    trainer: Trainer<AnyBackend>,
    cache: PictureCache,
    /// In the frame of the training.
    held_out: Vec<View>,
    /// Largest width and largest height of the training pictures, px.
    size_px: [u32; 2],
    /// When pictures are shrunk.
    shrinking: Shrinking,
    given_up: Vec<String>,
    notes: Vec<String>,
    fingerprint: Fingerprint,
    dropped_pairs: u64,
}

impl Session {
    /// Opens the dataset, plans the memory and allocates it. Training starts from `checkpoint` if there is one,
    /// otherwise from [`TrainPlan::init`]. Fails if a file cannot be read, there is no training view, there is nothing to
    /// start from (neither a sparse point nor a splat, and too little common ground for random points), the memory is too
    /// small, the device cannot be opened, or the checkpoint is damaged or belongs to another training.
    pub fn start(plan: &TrainPlan, checkpoint: Option<Checkpoint>) -> Result<Self> {
        let _span = info_span!("prepare").entered();
        let Opened { mut dataset, stride, damaged } = open_dataset(plan)?;
        let mut notes: Vec<String> = dataset
            .take_smaller_pictures(plan.max_size_px)
            .map(|folder| format!("{}: its smaller pictures suffice and are used", folder.display()))
            .into_iter()
            .collect();
        notes.extend(damaged.iter().map(|line| format!("left out: {line}")));
        let (train, held_out) = split(&dataset, &plan.split)?;
        let data = dataset.subset(&train);
        let frame = LocalFrame::of(data.cameras_of_views());
        check_origin(plan, &frame)?;
        let mut data = data.into_frame(&frame);
        let in_frame = |view: &View| View { camera: frame.local_camera(&view.camera), ..view.clone() };
        let mut held_out: Vec<View> = held_out.into_iter().map(|i| in_frame(&dataset.views[i])).collect();
        drop(dataset);
        if data.views.len() < VIEWS_MIN {
            bail!(
                "{}: {} to train on, but a surface needs at least {VIEWS_MIN}; add pictures of the same ground, or hold \
                 out fewer",
                plan.data.display(),
                counted(data.views.len() as u64, "view")
            );
        }
        if data.points.is_empty() && plan.init.is_none() {
            let cameras: Vec<Camera> = data.cameras_of_views().copied().collect();
            data.points = random_start::points(&cameras, plan.seed);
            if data.points.is_empty() {
                bail!(
                    "{}: the training views see no sparse point, and too little of the same ground for random ones; add the \
                     sparse cloud of COLMAP or `ply_file_path`, or a model to start from (`init`)",
                    plan.data.display()
                );
            }
            notes.push(format!(
                "{}: no sparse points, so training starts from {} random ones",
                plan.data.display(),
                data.points.len()
            ));
        }
        let (mut sizes, mut backend) =
            prepare(plan, &data).map_err(|error| match error.downcast::<TooLittleMemory>() {
                Ok(error) => error.with_more_points(&data, stride).into(),
                Err(error) => error,
            })?;
        check_pictures(&held_out, &sizes)?;
        let mut given_up = std::mem::take(&mut sizes.budget.given_up);
        if stride > 1 {
            given_up.push(format!("of the sparse points, one of {stride} is used"));
        }
        let cameras: Vec<Camera> = data
            .views
            .iter()
            .zip(&sizes.sources)
            .map(|(view, source)| view.camera.resized(source.size_px))
            .collect();
        let shrinking = sizes.sources[0].shrinking;
        let cache = PictureCache::new(sizes.sources, sizes.budget.cache_bytes)?;
        let splats_max = sizes.budget.capacity.splats;
        let needs_init = checkpoint.is_none() || data.points.is_empty();
        let init = plan.init.as_deref().filter(|_| needs_init);
        let init = init.map(|model| read_init(model, &frame, &cameras, splats_max)).transpose()?;
        let mut init = init.map(|VisibleSplats { splats, count }| {
            let used = splats.len();
            given_up.extend((used < count).then(|| {
                format!("of the {count} splats to start from that the views see, the {used} most important are used")
            }));
            splats
        });
        let mut stand_ins = init.as_ref().filter(|_| data.points.is_empty()).map(centres);
        let points = stand_ins.as_mut().unwrap_or(&mut data.points);
        let depth = depth(&cameras, points);
        check_size(plan, depth * frame.unit())?;
        let training_frame = TrainingFrame::of(&cameras, depth);
        let given_cameras = cameras;
        let cameras: Vec<Camera> = given_cameras.iter().map(|camera| training_frame.camera(camera)).collect();
        held_out.iter_mut().for_each(|view| view.camera = training_frame.camera(&view.camera));
        training_frame.move_points(points);
        let points = stand_ins.as_deref().unwrap_or(&data.points);
        if let Some(init) = &mut init {
            training_frame.move_splats(init);
        }
        let extent = training_frame::extent(&cameras);
        let settings = TrainSettings {
            schedule: Schedule::new(plan.steps),
            extent,
            sh_degree: SH_DEGREE,
            surface: plan.surface,
            prune: plan.prune,
            exposure: plan.exposure,
            poses: sizes.poses,
            observers_min: if plan.one_of_many { 1 } else { 2 },
            splats_max,
            seed: plan.seed,
        };
        // The stand-ins are left out: the word `global` may name a newer model when the training resumes.
        let fingerprint = Fingerprint::of(&settings, &cameras, &data.points);
        let neighbours = match plan.surface {
            Some(_) => Neighbours::find(&cameras, points),
            None => Neighbours::none(),
        };
        if checkpoint.is_none() {
            let form = if plan.surface.is_some() { Form::Flat } else { Form::Round };
            let from_points = || splats_from_points(&data.points, extent, splats_max, SH_DEGREE, form);
            backend.load(&init.unwrap_or_else(from_points));
        }
        let mut trainer = Trainer::new(backend, settings, TrainingViews { cameras, neighbours });
        if let Some(checkpoint) = checkpoint {
            checkpoint.restore(&fingerprint, &mut trainer)?;
        }
        Ok(Self {
            frame,
            training_frame,
            given_cameras,
            trainer,
            cache,
            held_out,
            size_px: sizes.budget.capacity.size_px,
            shrinking,
            given_up,
            notes,
            fingerprint,
            dropped_pairs: 0,
        })
    }

    /// Does one training step. Fails if a picture cannot be read. Fails with [`DeviceLost`] if the device was lost;
    /// then the session is lost too, and a new one must resume from the last checkpoint.
    pub fn step(&mut self) -> Result<StepOutcome> {
        let index = self.trainer.view_index(0);
        let neighbour = self.trainer.neighbour_index(index, 0);
        let picture = self.cache.get(index)?;
        let neighbour = match neighbour {
            Some(other) => Some((other, self.cache.get(other)?)),
            None => None,
        };
        self.prefetch();
        let example = Example {
            view: index,
            rgb: TargetRgb::Bytes(&picture.rgb),
            neighbour: neighbour.as_ref().map(|(other, picture)| (*other, TargetRgb::Bytes(&picture.rgb))),
        };
        let outcome = self.trainer.step(&example);
        check_device(self.trainer.backend())?;
        self.dropped_pairs += outcome.counts.dropped as u64;
        Ok(outcome)
    }

    /// Starts to read the pictures of the next step in the background.
    fn prefetch(&self) {
        let next = self.trainer.view_index(1);
        self.cache.prefetch(next);
        if let Some(other) = self.trainer.neighbour_index(next, 1) {
            self.cache.prefetch(other);
        }
    }

    /// Identifies this training, for [`crate::checkpoint::write`].
    pub fn fingerprint(&self) -> &Fingerprint {
        &self.fingerprint
    }

    /// The trainer. Its numbers are in the frame of the training.
    pub fn trainer(&self) -> &Trainer<AnyBackend> {
        &self.trainer
    }

    /// The frame of the model and of the cameras that the session returns.
    pub fn frame(&self) -> LocalFrame {
        self.frame
    }

    /// The training cameras, scaled to the picture sizes that training uses, ordered by view name. A camera whose pose was
    /// not learnt has its given bits.
    pub fn cameras(&self) -> Vec<Camera> {
        let frame = &self.training_frame;
        let of = |(now, given): (&Camera, &Camera)| {
            if *now == frame.camera(given) { *given } else { frame.given_camera(now) }
        };
        self.trainer.cameras().iter().zip(&self.given_cameras).map(of).collect()
    }

    /// The held-out views in the frame of the training, with cameras for the pictures in their size on disk.
    pub fn held_out(&self) -> &[View] {
        &self.held_out
    }

    /// Largest width and largest height of the training pictures, px.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// When the training pictures are shrunk; held-out ones must be shrunk alike to fit into the memory.
    pub fn shrinking(&self) -> Shrinking {
        self.shrinking
    }

    /// What the session chose by itself, one line of text each.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Ends the session, frees its memory and returns the model. Fails with [`DeviceLost`] if the device was lost.
    pub fn into_model(self) -> Result<TrainedModel> {
        let backend = self.trainer.into_backend();
        let splats = backend.splats();
        check_device(&backend)?;
        Ok(TrainedModel { splats, frame: self.training_frame })
    }

    /// The reductions that the memory limit forced, one line of text each.
    pub fn given_up(&self) -> Vec<String> {
        let mut given_up = self.given_up.clone();
        if self.dropped_pairs > 0 {
            let mean = self.dropped_pairs as f64 / f64::from(self.trainer.steps_done().max(1));
            given_up.push(format!("{mean:.0} of the farthest splat–tile pairs dropped per step, on average"));
        }
        given_up
    }
}

/// A trained model, still in the frame of its training.
pub struct TrainedModel {
    splats: Splats,
    frame: TrainingFrame,
}

impl TrainedModel {
    /// The splats in the frame of the training. The cameras of [`Session::held_out`] are in the same frame.
    pub fn in_training(&self) -> &Splats {
        &self.splats
    }

    /// The splats in the frame of the session, [`Session::frame`].
    pub fn into_splats(mut self) -> Splats {
        self.frame.move_splats_back(&mut self.splats);
        self.splats
    }
}

/// Fails if the cameras are so far from the world's origin that no file of a model can tell where.
fn check_origin(plan: &TrainPlan, frame: &LocalFrame) -> Result<()> {
    let farthest = frame.origin().abs().max_element();
    if farthest > ORIGIN_MAX {
        bail!(
            "{}: the cameras have coordinates about {farthest:.1e}, but models hold at most {ORIGIN_MAX:.0e}; subtract an \
             offset from all poses and points, or use metres",
            plan.data.display()
        );
    }
    Ok(())
}

/// Fails if the typical depth of the scene, world units, is far beyond that of any real scene: its model would have numbers that
/// are not finite.
fn check_size(plan: &TrainPlan, depth: f64) -> Result<()> {
    if !SCENE_SIZES.contains(&depth) {
        bail!(
            "{}: the points lie about {depth:.1e} units from the cameras, which is impossible; check poses and points, or use \
             metres",
            plan.data.display()
        );
    }
    Ok(())
}

/// Fails if the device was lost. Values that were read from a lost device are not valid, so call this after reading.
fn check_device(backend: &AnyBackend) -> Result<(), DeviceLost> {
    backend.lost().map_or(Ok(()), |reason| Err(DeviceLost(reason)))
}

/// Indices of the training views, then of the held-out views. Fails if the dataset lacks a named view.
fn split(dataset: &Dataset, split: &Split) -> Result<(Vec<usize>, Vec<usize>)> {
    let find = |names: &[String]| -> Result<Vec<usize>> {
        names
            .iter()
            .map(|name| dataset.find(name).with_context(|| format!("the dataset has no view called {name}")))
            .collect()
    };
    match split {
        Split::Every(every) => Ok(dataset.split(*every)),
        Split::Named { train, held_out } => Ok((find(train)?, find(held_out)?)),
    }
}

/// Decodes the pictures that are held out as they are scored at the end. Fails if one cannot be read: after the training it
/// would be told too late.
fn check_pictures(held_out: &[View], sizes: &Sizes) -> Result<()> {
    let long_side_px = sizes.budget.capacity.size_px.into_iter().max().unwrap_or(1);
    for view in held_out {
        let size_px = view.camera.fitted_size(long_side_px);
        mask::read(&view.path, view.mask.as_ref(), size_px, sizes.sources[0].shrinking)?;
    }
    Ok(())
}

/// Fails if a picture of the dataset is damaged. A training leaves it out. Decodes no picture.
pub fn check_pictures_are_whole(plan: &TrainPlan) -> Result<()> {
    match open_dataset(plan)?.damaged.into_iter().next() {
        Some(line) => bail!(line),
        None => Ok(()),
    }
}

/// Reads the splats to start from, at most `splats_max`. Fails if the cameras see none of them.
fn read_init(
    model: &Path,
    frame: &LocalFrame,
    cameras: &[Camera],
    splats_max: usize,
) -> Result<VisibleSplats> {
    let visible = read_visible_splats(model, frame, cameras, splats_max, SH_DEGREE)?;
    if visible.splats.is_empty() {
        bail!("{}: the training views see no splat of this model; start from another one", model.display());
    }
    Ok(visible)
}

/// The centres of the splats as sparse points, for datasets without sparse points.
fn centres(splats: &Splats) -> Vec<SparsePoint> {
    let point = |mean: &[f32; 3]| SparsePoint {
        position: DVec3::from_array(mean.map(f64::from)),
        rgb: [0; 3],
        views: Vec::new(),
    };
    splats.means.iter().map(point).collect()
}

/// Typical depth of the scene in the unit of the cameras. If no camera sees a point, it is the median distance of the points
/// from the first camera. `points` must not be empty.
fn depth(cameras: &[Camera], points: &[SparsePoint]) -> f64 {
    typical_depth(cameras, points).unwrap_or_else(|| {
        let eye = cameras[0].cam_from_world.center();
        let mut distances: Vec<f64> = points.iter().map(|point| point.position.distance(eye)).collect();
        distances.sort_by(f64::total_cmp);
        distances[distances.len() / 2]
    })
}

/// Chooses the device, plans all sizes and allocates the backend's buffers. With `auto`, a GPU is used only if the
/// training fits on it without any reduction.
fn prepare(plan: &TrainPlan, data: &Dataset) -> Result<(Sizes, AnyBackend)> {
    let on = |device: &Device| -> Result<(Sizes, AnyBackend)> {
        let sizes = plan_sizes(plan, plan.memory_bytes, device, data)?;
        let backend = AnyBackend::new(device, sizes.budget.capacity, plan.threads)?;
        Ok((sizes, backend))
    };
    if plan.device != DeviceChoice::Auto {
        return on(&plan.device.open()?);
    }
    // Looking for a GPU loads drivers, and their memory is not freed even if there is no GPU. So the program looks for
    // a GPU only if training on the CPU would fit beside the drivers without any reduction.
    let beside_drivers = plan.memory_bytes.saturating_sub(DRIVER_BYTES);
    let may_look =
        plan_sizes(plan, beside_drivers, &Device::Cpu, data).is_ok_and(|sizes| sizes.is_unreduced());
    if may_look
        && let device = plan.device.open()?
        && device.is_gpu()
        && let Ok((sizes, backend)) = on(&device)
        && sizes.is_unreduced()
    {
        return Ok((sizes, backend));
    }
    on(&Device::Cpu)
}

/// Sizes of a training that fit into the memory.
struct Sizes {
    budget: Budget,
    sources: Vec<Source>,
    poses: PoseChoice,
}

impl Sizes {
    /// True if the memory limit forced no reduction.
    fn is_unreduced(&self) -> bool {
        self.budget.given_up.is_empty()
    }
}

/// As [`plan_sizes_as_told`]. If the memory is short, the choice whether to learn poses takes its share from the picture
/// cache, so that the model has the same splats; if there is too little of it, poses are taken as exact.
fn plan_sizes(plan: &TrainPlan, memory_bytes: u64, device: &Device, data: &Dataset) -> Result<Sizes> {
    let with = |poses| {
        let plan = TrainPlan { poses, ..plan.clone() };
        plan_sizes_as_told(&plan, memory_bytes, device, data)
    };
    if plan.poses != PoseChoice::Auto {
        return with(plan.poses);
    }
    if plan.surface.is_some()
        && let Ok(sizes) = with(PoseChoice::Auto)
        && sizes.is_unreduced()
    {
        return Ok(sizes);
    }
    let mut sizes = with(PoseChoice::Fixed)?;
    if plan.surface.is_none() {
        return Ok(sizes);
    }
    let spare = sizes.budget.cache_bytes - PictureCache::least_bytes(&sizes.sources);
    let needed = aligning_bytes(plan, sizes.budget.capacity.size_px);
    if spare >= needed {
        sizes.budget.cache_bytes -= needed;
        sizes.poses = PoseChoice::Auto;
    } else {
        sizes.budget.given_up.push("poses are taken as exact, not looked at".to_owned());
    }
    Ok(sizes)
}

/// Finds the largest of the sizes in [`SIZE_STEPS`] with which the training fits into the memory.
fn plan_sizes_as_told(plan: &TrainPlan, memory_bytes: u64, device: &Device, data: &Dataset) -> Result<Sizes> {
    let widest = data.views.iter().flat_map(|view| view.camera.size_px).max().unwrap_or(1);
    let wanted = plan.max_size_px.min(widest);
    let mut least: Option<BudgetError> = None;
    for share in SIZE_STEPS {
        let long_side_px = ((f64::from(wanted) * share) as u32).max(1);
        if share < 0.25 && long_side_px < SHRUNK_PX_MIN {
            break;
        }
        match plan_size(plan, memory_bytes, device, data, long_side_px)? {
            Ok(mut sizes) => {
                if long_side_px < wanted {
                    sizes.budget.given_up.insert(
                        0,
                        format!("pictures with a long side of {long_side_px} px instead of {wanted} px"),
                    );
                }
                return Ok(sizes);
            }
            Err(error) => least = Some(least.map_or(error, |least| least.or_less(error))),
        }
    }
    match least.expect("at least one size was tried") {
        BudgetError::TooLittleMemory { memory_bytes, least_bytes } => {
            Err(TooLittleMemory { memory_bytes, least_bytes }.into())
        }
        too_large @ BudgetError::PictureTooLarge { .. } => Err(too_large.into()),
    }
}

/// A limit on memory that is too small for a training.
#[derive(Debug, thiserror::Error)]
#[error(
    "{} of memory are too little for this training, even with the smallest pictures; it needs at least {}MiB",
    format_bytes(*memory_bytes),
    least_bytes.div_ceil(1 << 20)
)]
struct TooLittleMemory {
    memory_bytes: u64,
    least_bytes: u64,
}

impl TooLittleMemory {
    /// The dataset has one sparse point of `stride`, as many as the limit had room for. With a higher limit it has more, which
    /// need memory too.
    fn with_more_points(self, data: &Dataset, stride: usize) -> Self {
        let Some(denser) = stride.checked_sub(1).filter(|denser| *denser > 0) else { return self };
        let here = points_bytes(data);
        let (rest, all) = (self.least_bytes.saturating_sub(here), here * stride as u64);
        // At this limit, one point of `denser` had no room.
        let share = all as f64 / denser as f64 / self.memory_bytes.max(1) as f64;
        let with_share = if share < 1.0 { (rest as f64 / (1.0 - share)).ceil() as u64 } else { u64::MAX };
        Self { least_bytes: with_share.min(rest + all).max(self.least_bytes), ..self }
    }
}

/// Plans a training with pictures of this long side. Where exact shrinking would cost splats, JPEGs are shrunk while they are
/// decoded.
fn plan_size(
    plan: &TrainPlan,
    memory_bytes: u64,
    device: &Device,
    data: &Dataset,
    long_side_px: u32,
) -> Result<Result<Sizes, BudgetError>> {
    let planned = |shrinking| -> Result<Result<Sizes, BudgetError>> {
        let sources: Vec<Source> =
            data.views.iter().map(|view| Source::of(view, long_side_px, shrinking)).collect();
        let budget = Budget::plan(&Wish { memory_bytes, ..wish(plan, device, data, &sources)? });
        Ok(budget.map(|budget| Sizes { budget, sources, poses: plan.poses }))
    };
    let exact = planned(Shrinking::AfterDecoding)?;
    if exact.as_ref().is_ok_and(Sizes::is_unreduced) {
        return Ok(exact);
    }
    let scaled = planned(Shrinking::WhileDecoding)?;
    let splats =
        |sizes: &Result<Sizes, BudgetError>| sizes.as_ref().map_or(0, |it| it.budget.capacity.splats);
    Ok(match (exact, scaled) {
        (Err(exact), Err(scaled)) => Err(exact.or_less(scaled)),
        (exact, scaled) if splats(&scaled) <= splats(&exact) => exact,
        (_, scaled) => scaled.map(|mut sizes| {
            sizes.budget.given_up.push("JPEGs are shrunk while they are decoded, not exactly".to_owned());
            sizes
        }),
    })
}

/// Bytes that the alignment of a picture takes: its rendering of 8 numbers for each pixel, and blocks of 3 numbers for each 4
/// pixels at least.
fn aligning_bytes(plan: &TrainPlan, size_px: [u32; 2]) -> u64 {
    let pixels = u64::from(size_px[0]) * u64::from(size_px[1]);
    if plan.poses == PoseChoice::Fixed { 0 } else { pixels * (8 * 4 + 3) }
}

/// Upper bound on the bytes of the sparse points.
fn points_bytes(data: &Dataset) -> u64 {
    let points = data.points.len() as u64;
    let tracks: u64 = data.points.iter().map(|point| point.views.len() as u64).sum();
    // Points and their tracks (lists of views) exist twice for a moment: for all views, and for the training views
    // only. Later, a search tree over the points gives the splats their initial scales. The sum of all three is an
    // upper limit.
    2 * (64 * points + 4 * tracks) + 40 * points
}

/// What the training would allocate with enough memory, and the least that it needs.
fn wish(plan: &TrainPlan, device: &Device, data: &Dataset, sources: &[Source]) -> Result<Wish> {
    let pixels: u64 =
        sources.iter().map(|source| u64::from(source.size_px[0]) * u64::from(source.size_px[1])).sum();
    let size_px = [0, 1].map(|axis| sources.iter().map(|source| source.size_px[axis]).max().unwrap_or(1));
    let points = data.points.len() as u64;
    let pixels_per_splat = if plan.one_of_many { PIXELS_PER_SPLAT_OF_MANY } else { PIXELS_PER_SPLAT };
    Ok(Wish {
        memory_bytes: plan.memory_bytes,
        size_px,
        sh_degree: SH_DEGREE,
        binding_bytes_max: device.binding_bytes_max(),
        channels: if plan.surface.is_some() || plan.poses == PoseChoice::Learn {
            Channels::Geometry
        } else {
            Channels::Color
        },
        splats: (pixels / pixels_per_splat).max(points) as usize,
        cache_bytes_most: PictureCache::most_bytes(sources),
        cache_bytes_least: PictureCache::least_bytes(sources),
        loading_bytes: PictureCache::scratch_bytes(sources)?
            + points_bytes(data)
            + aligning_bytes(plan, size_px),
    })
}
