//! A training session: from a plan to a trained model, within the plan's memory, resumable at every
//! checkpoint.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use cosurf_engine::backend::{Channels, TargetRgb};
use cosurf_engine::budget::{Budget, BudgetError, DRIVER_BYTES, Wish};
use cosurf_engine::init::{Form, splats_from_points};
use cosurf_engine::train::StepOutcome;
use cosurf_engine::{
    AnyBackend, Backend, Device, DeviceChoice, DeviceLost, Example, Neighbours, PruneSettings, Schedule,
    SurfaceSettings, TrainSettings, Trainer, TrainingViews,
};
use cosurf_scene::bytes::format_bytes;
use cosurf_scene::cache::Source;
use cosurf_scene::{Camera, Dataset, PictureCache, Splats, View};

use crate::checkpoint::{Checkpoint, Fingerprint};
use crate::warm::beginning;

/// Stored SH degree.
pub const SH_DEGREE: u32 = 3;

/// Training pixels per splat that a training may make at most, memory permitting: finer splats than this
/// would see too few pixels each to be told apart from noise. With 48, at the same processor time, rendered Boruszyn
/// (160 px) has 0.62 dB less, Boruszyn (320 px) 0.39, Caliterra (240 px) 0.27.
const PIXELS_PER_SPLAT: u64 = 24;
/// The same where the model is one of several. Around its cell it sees others' ground in few pictures of its own: a
/// quarter of rendered Boruszyn's pictures shows two thirds of the ground, so that by the same rule it would have half
/// as many splats there as one model of all has. Merging leaves shared ground to one.
const PIXELS_PER_SPLAT_OF_MANY: u64 = 16;

/// Long sides that are tried, as shares of the wanted one, where memory is short.
const SIZE_STEPS: [f64; 6] = [1.0, 0.8, 0.63, 0.5, 0.35, 0.25];

/// What to train.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainPlan {
    /// The dataset's folder.
    pub data: PathBuf,
    /// Which views to train on and which to hold out.
    pub split: Split,
    /// Steps in all.
    pub steps: u32,
    /// Seed of every random choice.
    pub seed: u64,
    /// Most bytes of resident memory.
    pub memory_bytes: u64,
    /// Long side of the largest picture trained on.
    pub max_size_px: u32,
    /// What computes.
    pub device: DeviceChoice,
    /// Threads of the processor to compute with, at least 1.
    pub threads: usize,
    /// How the surface is trained; `None` for colour only.
    pub surface: Option<SurfaceSettings>,
    /// How the model is pruned; `None` for not at all.
    pub prune: Option<PruneSettings>,
    /// Whether each photograph has an exposure of its own.
    pub exposure: bool,
    /// A model of the same ground to begin with instead of the sparse cloud.
    pub init: Option<PathBuf>,
    /// Whether the model will be joined with those of others: then ground that a single view observes stays in it.
    pub one_of_many: bool,
}

/// Which views are for what.
#[derive(Clone, Debug, PartialEq)]
pub enum Split {
    /// With names sorted, every n-th is held out; 0 holds out none.
    Every(u32),
    /// By name.
    Named {
        /// To train on.
        train: Vec<String>,
        /// To score.
        held_out: Vec<String>,
    },
}

/// The cameras that a training of this plan has, with pictures of their size on disk.
pub fn flight(plan: &TrainPlan) -> Result<Vec<Camera>> {
    let dataset = Dataset::open(&plan.data)?;
    let (train, _) = split(&dataset, &plan.split)?;
    Ok(train.into_iter().map(|i| dataset.views[i].camera).collect())
}

/// A training that is under way.
pub struct Session {
    trainer: Trainer<AnyBackend>,
    cache: PictureCache,
    held_out: Vec<View>,
    /// Size of the largest picture trained on.
    size_px: [u32; 2],
    given_up: Vec<String>,
    fingerprint: Fingerprint,
    dropped_pairs: u64,
}

impl Session {
    /// Opens the data, plans the memory, and starts from `checkpoint` or from the sparse cloud.
    pub fn start(plan: &TrainPlan, checkpoint: Option<Checkpoint>) -> Result<Self> {
        let dataset = Dataset::open(&plan.data)?;
        let (train, held_out) = split(&dataset, &plan.split)?;
        let held_out: Vec<View> = held_out.into_iter().map(|i| dataset.views[i].clone()).collect();
        let data = dataset.subset(&train);
        drop(dataset);
        if data.views.is_empty() {
            bail!("{}: no view is left to train on; hold out fewer", plan.data.display());
        }
        if data.points.is_empty() {
            bail!(
                "{}: no sparse point is seen by the training views; training starts from the sparse cloud of COLMAP or `ply_file_path`",
                plan.data.display()
            );
        }
        let (sized, mut backend) = prepare(plan, &data)?;
        let cameras: Vec<Camera> = data
            .views
            .iter()
            .zip(&sized.sources)
            .map(|(view, source)| view.camera.resized(source.size_px))
            .collect();
        let cache = PictureCache::new(sized.sources, sized.budget.cache_bytes)?;
        let extent = extent(&data);
        let settings = TrainSettings {
            schedule: Schedule::new(plan.steps),
            extent,
            sh_degree: SH_DEGREE,
            surface: plan.surface,
            prune: plan.prune,
            exposure: plan.exposure,
            observers_min: if plan.one_of_many { 1 } else { 2 },
            splats_max: sized.budget.capacity.splats,
            seed: plan.seed,
        };
        let fingerprint = Fingerprint::of(&settings, &cameras, &data.points);
        let neighbours = match plan.surface {
            Some(_) => Neighbours::find(&cameras, &data.points),
            None => Neighbours::none(),
        };
        if checkpoint.is_none() {
            let splats_max = settings.splats_max;
            let form = if plan.surface.is_some() { Form::Flat } else { Form::Round };
            backend.load(&match &plan.init {
                Some(model) => beginning(model, &cameras, splats_max, SH_DEGREE)?,
                None => splats_from_points(&data.points, extent, splats_max, SH_DEGREE, form),
            });
        }
        let mut trainer = Trainer::new(backend, settings, TrainingViews { cameras, neighbours });
        if let Some(checkpoint) = checkpoint {
            checkpoint.restore(&fingerprint, &mut trainer)?;
        }
        Ok(Self {
            trainer,
            cache,
            held_out,
            size_px: sized.budget.capacity.size_px,
            given_up: sized.budget.given_up,
            fingerprint,
            dropped_pairs: 0,
        })
    }

    /// One step of training. Fails with [`DeviceLost`] where what is trained is lost: only a checkpoint helps then.
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
        not_lost(self.trainer.backend())?;
        self.dropped_pairs += outcome.counts.dropped as u64;
        Ok(outcome)
    }

    /// Asks for the pictures of the next step.
    fn prefetch(&self) {
        let next = self.trainer.view_index(1);
        self.cache.prefetch(next);
        if let Some(other) = self.trainer.neighbour_index(next, 1) {
            self.cache.prefetch(other);
        }
    }

    /// What a checkpoint of this training must agree with, for [`crate::checkpoint::write`].
    pub fn fingerprint(&self) -> &Fingerprint {
        &self.fingerprint
    }

    /// The trainer.
    pub fn trainer(&self) -> &Trainer<AnyBackend> {
        &self.trainer
    }

    /// Cameras trained on, at training size; their order is that of the views' names.
    pub fn cameras(&self) -> &[Camera] {
        self.trainer.cameras()
    }

    /// Views held out, at their size on disk.
    pub fn held_out(&self) -> &[View] {
        &self.held_out
    }

    /// Size of the largest picture trained on.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Ends the session and gives the model; everything else that it held is freed. Fails with [`DeviceLost`].
    pub fn into_splats(self) -> Result<Splats> {
        let backend = self.trainer.into_backend();
        let splats = backend.splats();
        not_lost(&backend)?;
        Ok(splats)
    }

    /// What memory took away, one sentence each.
    pub fn given_up(&self) -> Vec<String> {
        let mut given_up = self.given_up.clone();
        if self.dropped_pairs > 0 {
            let mean = self.dropped_pairs as f64 / f64::from(self.trainer.steps_done().max(1));
            given_up.push(format!("{mean:.0} of the farthest splat–tile pairs in a step, on average"));
        }
        given_up
    }
}

/// What was read from a device that is lost is not to be believed.
fn not_lost(backend: &AnyBackend) -> Result<(), DeviceLost> {
    backend.lost().map_or(Ok(()), |reason| Err(DeviceLost(reason)))
}

/// Indices of the views to train on and of those held out.
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

/// Extent of the cameras; for a single camera, of what it sees.
fn extent(data: &Dataset) -> f64 {
    let extent = data.extent();
    if extent > 0.0 {
        return extent;
    }
    let eye = data.views[0].camera.cam_from_world.center();
    let mut distances: Vec<f64> = data.points.iter().map(|point| point.position.distance(eye)).collect();
    distances.sort_by(f64::total_cmp);
    distances[distances.len() / 2].max(1e-6)
}

/// Sizes, and every buffer of the training. A graphics card that nobody asked for is passed over where it would make
/// anything smaller than it was wished.
fn prepare(plan: &TrainPlan, data: &Dataset) -> Result<(Sized, AnyBackend)> {
    let on = |device: &Device| -> Result<(Sized, AnyBackend)> {
        let sized = fit(plan, plan.memory_bytes, device, data)?;
        let backend = AnyBackend::new(device, sized.budget.capacity, plan.threads)?;
        Ok((sized, backend))
    };
    if plan.device != DeviceChoice::Auto {
        return on(&plan.device.open()?);
    }
    // Looking for a card loads drivers, whose memory is not given back even if there is none.
    let beside_drivers = plan.memory_bytes.saturating_sub(DRIVER_BYTES);
    let may_look = fit(plan, beside_drivers, &Device::Cpu, data).is_ok_and(|sized| sized.is_as_wished());
    if may_look
        && let device = plan.device.open()?
        && device.is_gpu()
        && let Ok((sized, backend)) = on(&device)
        && sized.is_as_wished()
    {
        return Ok((sized, backend));
    }
    on(&Device::Cpu)
}

struct Sized {
    budget: Budget,
    sources: Vec<Source>,
}

impl Sized {
    /// Whether nothing had to be given up for memory.
    fn is_as_wished(&self) -> bool {
        self.budget.given_up.is_empty()
    }
}

/// The largest pictures with which the training fits into the memory.
fn fit(plan: &TrainPlan, memory_bytes: u64, device: &Device, data: &Dataset) -> Result<Sized> {
    let widest = data.views.iter().flat_map(|view| view.camera.size_px).max().unwrap_or(1);
    let wanted = plan.max_size_px.min(widest);
    let mut short: Option<BudgetError> = None;
    for share in SIZE_STEPS {
        let long_side_px = ((f64::from(wanted) * share) as u32).max(1);
        let sources: Vec<Source> = data.views.iter().map(|view| Source::of(view, long_side_px)).collect();
        match Budget::plan(&Wish { memory_bytes, ..wish(plan, device, data, &sources)? }) {
            Ok(mut budget) => {
                if long_side_px < wanted {
                    budget.given_up.insert(
                        0,
                        format!("pictures of {long_side_px} px on the long side instead of {wanted}"),
                    );
                }
                return Ok(Sized { budget, sources });
            }
            Err(error) => short = Some(error),
        }
    }
    match short.expect("at least one size was tried") {
        BudgetError::TooLittleMemory { memory_bytes, least_bytes } => bail!(
            "{} of memory are too few for this training, even with the smallest pictures; give at least --memory {}MiB",
            format_bytes(memory_bytes),
            least_bytes.div_ceil(1 << 20)
        ),
        too_large @ BudgetError::PictureTooLarge { .. } => Err(too_large.into()),
    }
}

fn wish(plan: &TrainPlan, device: &Device, data: &Dataset, sources: &[Source]) -> Result<Wish> {
    let pixels: u64 =
        sources.iter().map(|source| u64::from(source.size_px[0]) * u64::from(source.size_px[1])).sum();
    let size_px = [0, 1].map(|axis| sources.iter().map(|source| source.size_px[axis]).max().unwrap_or(1));
    let points = data.points.len() as u64;
    let tracks: u64 = data.points.iter().map(|point| point.views.len() as u64).sum();
    // Points with tracks are held twice for a moment (whole set and subset), beside the tree of the first scales.
    let points_bytes = 2 * (64 * points + 4 * tracks) + 40 * points;
    let pixels_per_splat = if plan.one_of_many { PIXELS_PER_SPLAT_OF_MANY } else { PIXELS_PER_SPLAT };
    Ok(Wish {
        memory_bytes: plan.memory_bytes,
        size_px,
        sh_degree: SH_DEGREE,
        binding_bytes_max: device.binding_bytes_max(),
        channels: if plan.surface.is_some() { Channels::Geometry } else { Channels::Color },
        splats: (pixels / pixels_per_splat).max(points) as usize,
        cache_bytes_most: PictureCache::most_bytes(sources),
        cache_bytes_least: PictureCache::least_bytes(sources),
        loading_bytes: PictureCache::scratch_bytes(sources)? + points_bytes,
    })
}
