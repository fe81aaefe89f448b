//! Distils one tile: trains its splats, and those around it, on what its teachers show. The splats around it are trained
//! so that both sides of a border fit each other; their changes are discarded, because they belong to other tiles.

use cosurf_engine::backend::Channels;
use cosurf_engine::train::view_order;
use cosurf_engine::{AnyBackend, Backend, Capacity, DistillSettings, Distiller, StudentRates, distill};
use cosurf_scene::{Camera, Splats};
use glam::DVec3;
use tracing::debug_span;

use super::computer::Computer;
use super::error::MergeError;
use super::task::Task;
use super::teachers::write_book;
use crate::scratch::Scratch;

/// Epochs at the end of a distillation with lower learning rates.
const COOLDOWN_EPOCHS: u32 = 2;
/// A camera is a stray if it is this many times as far from the middle of all cameras as half of them are.
const STRAY_TIMES: f64 = 10.0;

/// Distils a tile. Returns its splats. `tell` gets the PSNR of each step, dB: the merged model's rendering against the
/// local model's; it returns false to stop.
pub(super) fn learn(
    task: &Task,
    scratch: &Scratch,
    computer: &Computer,
    tell: &dyn Fn(f64) -> bool,
) -> Result<Splats, MergeError> {
    let cameras = task.cameras();
    if cameras.is_empty() {
        return Ok(task.student()?); // no part of a picture shows splats around the tile either
    }
    let book = debug_span!("teach").in_scope(|| write_book(task, scratch, computer))?;
    let student = task.student()?;
    let room = Capacity::to_train(&student, &cameras, Channels::Geometry);
    let mut backend =
        debug_span!("allocate").in_scope(|| AnyBackend::new(&computer.device, room, computer.threads))?;
    backend.load(&student);
    drop(student);
    let mut distiller = Distiller::new(backend, settings(task, cameras, book.median_depth()));
    let mut numbers = Vec::new();
    for epoch in 0..task.epochs() {
        for index in view_order(task.seed(), u64::from(epoch), book.len()) {
            let (losses, _) = distiller.step(&book.read(index, &mut numbers)?);
            computer.device.check()?;
            if !tell(losses.color.psnr()) {
                return Err(MergeError::GivenUp);
            }
        }
    }
    let _span = debug_span!("finish").entered();
    let (mut learnt, useless) = distiller.finish(task.wide_crops(), task.own());
    computer.device.check()?;
    keep_first(&mut learnt, task.own());
    Ok(learnt.without(&useless))
}

/// No mean moves farther than this while the task is distilled, along any axis, world units.
pub(super) fn reach(task: &Task) -> f64 {
    settings(task, task.cameras(), 1.0).reach()
}

/// `cameras` has those of the lessons, and `depth` is the median depth of what they show.
fn settings(task: &Task, cameras: Vec<Camera>, depth: f64) -> DistillSettings {
    let lessons = cameras.len() as u32;
    DistillSettings {
        steps: task.epochs() * lessons,
        cooldown_steps: COOLDOWN_EPOCHS * lessons,
        rates: StudentRates::TRAINED,
        extent: distill::extent(&without_strays(cameras)),
        depth,
        sh_degree: task.sh_degree(),
    }
}

fn keep_first(splats: &mut Splats, count: usize) {
    splats.sh.truncate(count * splats.sh_stride());
    splats.means.truncate(count);
    splats.quats.truncate(count);
    splats.log_scales.truncate(count);
    splats.opacity_logits.truncate(count);
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
