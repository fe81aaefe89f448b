//! Distillation: trains the joined model, one camera per step, on what the local models render.
//!
//! If the whole model does not fit into the memory, it is distilled in parts, one after the other. A part consists of
//! the splats of some local models. Splats of other parts that the part's cameras see are rendered with the part, but
//! their changes are discarded.

use std::ops::{ControlFlow, Range};

use cosurf_engine::backend::{Channels, TargetSurface};
use cosurf_engine::distill;
use cosurf_engine::train::view_order;
use cosurf_engine::{
    AnyBackend, Backend, Capacity, DistillSettings, Distiller, Lesson, Rendering, StudentRates,
};
use cosurf_scene::{Camera, Splats, Watchers};
use glam::DVec3;
use serde::Serialize;
use tracing::info_span;

use super::computer::Computer;
use super::error::MergeError;
use super::lessons::{distinct, lessons};
use super::locals::Surveyed;
use super::memory::{renderer_bytes, student_room, teachers_bytes};
use super::settings::MergeSettings;
use super::teachers::{Taught, Teachers, ViewKey};

/// Epochs at the end of a distillation with lower learning rates.
const COOLDOWN_EPOCHS: u32 = 2;

/// A camera is a stray if it is this many times as far from the middle of all cameras as half of them are.
const STRAY_TIMES: f64 = 10.0;

/// Progress of a merge.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MergeProgress {
    /// Number of distillation steps done.
    pub step: u32,
    /// Number of distillation steps in all.
    pub steps: u32,
    /// PSNR of the last step, dB: the merged model's rendering against the local model's.
    pub psnr: f64,
}

/// The result of a distillation.
pub(super) struct Distilled {
    pub(super) splats: Splats,
    pub(super) steps: u32,
}

/// Distils `joined`, which consists of `sizes[0]` splats of the first local model, then `sizes[1]` of the second, and
/// so on. For `standings` see [`lessons`].
pub(super) fn distill(
    surveyed: &Surveyed,
    sizes: &[usize],
    mut joined: Splats,
    standings: Option<&[Vec<f64>]>,
    settings: &MergeSettings,
    computer: &Computer,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Distilled, MergeError> {
    let _span = info_span!("distill", splats = joined.len()).entered();
    let Surveyed { locals, cameras, .. } = surveyed;
    let device = &computer.device;
    let room = student_room(device, settings, joined.sh_degree, cameras);
    let parts = parts(sizes, room);
    let lessons = lessons(cameras, standings, |local| standings.is_some() || !locals.is_compressed(local));
    let steps = settings.epochs * lessons.iter().map(Vec::len).sum::<usize>() as u32;
    if steps == 0 {
        return Ok(Distilled { splats: joined, steps });
    }
    let largest = surveyed.sizes.iter().copied().max().unwrap_or(0);
    let teacher_bytes = renderer_bytes(device, largest, joined.sh_degree, cameras);
    let mut teachers = Teachers::new(surveyed, computer, teacher_bytes, teachers_bytes(device, settings));
    let depth = median_depth(&mut teachers, cameras)?;
    let extent = distill::extent(&without_strays(cameras.iter().flatten().copied().collect()));
    let mut useless = Vec::new();
    let mut done = 0;
    for part in &parts {
        let own: Range<usize> = sizes[..part.start].iter().sum()..sizes[..part.end].iter().sum();
        let views = views_of(part.clone(), &lessons);
        let its = distinct(&cameras[part.clone()]);
        if own.is_empty() || views.is_empty() {
            continue;
        }
        let (student, around) = with_surroundings(&joined, own.clone(), &its, room);
        let room = Capacity::to_train(&student, &its, Channels::Geometry);
        let mut backend = AnyBackend::new(device, room, computer.threads)?;
        backend.load(&student);
        drop(student);
        let mut distiller = Distiller::new(
            backend,
            DistillSettings {
                steps: settings.epochs * views.len() as u32,
                cooldown_steps: COOLDOWN_EPOCHS * views.len() as u32,
                rates: StudentRates::TRAINED,
                extent,
                depth,
                sh_degree: joined.sh_degree,
            },
        );
        for epoch in 0..settings.epochs {
            for view in order(&views, teachers.shelf_max(), settings.seed, epoch) {
                let psnr = learn(&mut distiller, &teachers.teach(view)?);
                device.check()?;
                done += 1;
                if tell(MergeProgress { step: done, steps, psnr }).is_break() {
                    return Err(MergeError::GivenUp);
                }
            }
        }
        let (learnt, its_useless) = distiller.finish(&its);
        device.check()?;
        put_back(&mut joined, &learnt, own.clone());
        let count = own.len() as u32;
        useless.extend(its_useless.into_iter().filter(|i| *i < count).map(|i| i + own.start as u32));
        debug_assert_eq!(learnt.len(), own.len() + around);
    }
    Ok(Distilled { splats: joined.without(&useless), steps: done })
}

/// Trains one step. Returns the PSNR of the student's rendering against the teacher's, dB.
fn learn(distiller: &mut Distiller<AnyBackend>, taught: &Taught) -> f64 {
    let Taught { camera, shown, trust } = taught;
    let Rendering { rgb, depth, normal, .. } = &**shown;
    let lesson = Lesson { camera, rgb, surface: TargetSurface { depth, normal, trust } };
    distiller.step(&lesson).0.color.psnr()
}

/// Divides the local models into parts that are trained one after the other. A part has consecutive models, as many as
/// fit into `room` splats, but at least one. If not all models fit into one part, a part takes only two thirds of the
/// room; the rest is for the splats around it.
fn parts(sizes: &[usize], room: usize) -> Vec<Range<usize>> {
    let room = if sizes.iter().sum::<usize>() <= room { room } else { room / 3 * 2 };
    let (mut parts, mut start, mut taken) = (Vec::new(), 0, 0);
    for (i, size) in sizes.iter().enumerate() {
        if i > start && taken + size > room {
            parts.push(start..i);
            (start, taken) = (i, 0);
        }
        taken += size;
    }
    parts.push(start..sizes.len());
    parts
}

/// All views that the given local models teach.
fn views_of(locals: Range<usize>, lessons: &[Vec<usize>]) -> Vec<ViewKey> {
    locals.flat_map(|local| lessons[local].iter().map(move |&camera| ViewKey { local, camera })).collect()
}

/// Draws a random order of the views for an epoch. At most `shelf` teachers can be loaded at once. If there are more,
/// they teach in groups of `shelf`, one group after the other, and the order is random only within a group.
fn order(views: &[ViewKey], shelf: usize, seed: u64, epoch: u32) -> Vec<ViewKey> {
    let drawn = view_order(seed, u64::from(epoch), views.len()).into_iter().map(|place| views[place]);
    let mut order: Vec<ViewKey> = drawn.collect();
    let first = views.first().map_or(0, |view| view.local);
    order.sort_by_key(|view| (view.local - first) / shelf);
    order
}

/// Returns the splats to train: those of `own`, then other splats that `cameras` see, up to `room` splats in all. Also
/// returns the number of the other splats.
fn with_surroundings(joined: &Splats, own: Range<usize>, cameras: &[Camera], room: usize) -> (Splats, usize) {
    let mut student = Splats::with_capacity(own.len(), joined.sh_degree);
    own.clone().for_each(|i| student.push_from(joined, i));
    let mut watchers = Watchers::new(cameras);
    let is_seen = |i: &usize| {
        let mean = DVec3::from_array(joined.means[*i].map(f64::from));
        !own.contains(i) && watchers.any(mean, |_| true)
    };
    let free = room.saturating_sub(own.len());
    let around: Vec<usize> = (0..joined.len()).filter(is_seen).take(free).collect();
    around.iter().for_each(|&i| student.push_from(joined, i));
    (student, around.len())
}

/// Writes the first splats of `learnt` back to the places `own` of `joined`.
fn put_back(joined: &mut Splats, learnt: &Splats, own: Range<usize>) {
    let (count, stride) = (own.len(), joined.sh_stride());
    joined.means[own.clone()].copy_from_slice(&learnt.means[..count]);
    joined.quats[own.clone()].copy_from_slice(&learnt.quats[..count]);
    joined.log_scales[own.clone()].copy_from_slice(&learnt.log_scales[..count]);
    joined.opacity_logits[own.clone()].copy_from_slice(&learnt.opacity_logits[..count]);
    joined.sh[own.start * stride..own.end * stride].copy_from_slice(&learnt.sh[..count * stride]);
}

/// The cameras without those that are far from all others: these would raise the learning rates.
fn without_strays(cameras: Vec<Camera>) -> Vec<Camera> {
    let eyes: Vec<DVec3> = cameras.iter().map(|camera| camera.cam_from_world.center()).collect();
    let middle_of = |mut values: Vec<f64>| {
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or_default()
    };
    let [x, y, z] = [0, 1, 2].map(|axis| middle_of(eyes.iter().map(|eye| eye[axis]).collect()));
    let distances: Vec<f64> = eyes.iter().map(|eye| eye.distance(DVec3::new(x, y, z))).collect();
    let limit = STRAY_TIMES * middle_of(distances.clone());
    cameras.into_iter().zip(distances).filter(|(_, far)| *far <= limit).map(|(camera, _)| camera).collect()
}

/// Median depth over the first view of each local model that has cameras, world units.
fn median_depth(teachers: &mut Teachers, cameras: &[Vec<Camera>]) -> Result<f64, MergeError> {
    /// Only every `STEP`-th pixel is sampled.
    const STEP: usize = 17;
    let mut depths: Vec<f32> = Vec::new();
    for local in (0..cameras.len()).filter(|local| !cameras[*local].is_empty()) {
        let taught = teachers.teach(ViewKey { local, camera: 0 })?;
        depths.extend(taught.shown.depth.iter().step_by(STEP));
    }
    Ok(distill::median_depth(depths.into_iter()))
}
