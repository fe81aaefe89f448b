//! Distillation: trains the joined model on what the local models render. Each tile of the ground is distilled by
//! itself, on one or several threads. So the result does not depend on the memory or on the number of threads: these
//! decide only how many tiles are distilled at once.

use std::cmp::Reverse;
use std::ops::{ControlFlow, Range};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;

use cosurf_scene::Splats;
use serde::Serialize;
use tracing::info_span;

use super::computer::Computer;
use super::error::MergeError;
use super::learn::learn;
use super::memory::at_once;
use super::pages::Pages;
use super::plan::Plan;
use super::scratch::Scratch;
use super::settings::MergeSettings;
use super::site::Site;
use super::tiles::Tile;

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

/// What a thread that distils tiles reports.
enum Report {
    /// PSNR of a step, dB.
    Step(f64),
    /// The tile with this index is done.
    Done(usize, Result<Splats, MergeError>),
}

/// Distils the joined splats of a site, divided into `tiles`. `lessons` has the cameras of each local model that teach.
pub(super) fn distill(
    site: &Site,
    tiles: Vec<Tile>,
    lessons: &[Vec<usize>],
    settings: &MergeSettings,
    computer: &Computer,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Distilled, MergeError> {
    let _span = info_span!("distill", tiles = tiles.len()).entered();
    let plan = |tile| Plan::of(site, tile, lessons, &computer.device);
    let plans: Vec<Plan> = tiles.into_iter().map(plan).collect::<Result<_, _>>()?;
    let steps = settings.epochs * plans.iter().map(|plan| plan.lessons.len()).sum::<usize>() as u32;
    let bytes = plans.iter().map(|plan| plan.bytes).collect();
    let at_once = at_once(bytes, computer.threads, settings.memory_bytes, &computer.device)?;
    let computer = Computer { threads: computer.threads / at_once, ..computer.clone() };
    let work = Work {
        plans: &plans,
        order: largest_first(&plans),
        next: AtomicUsize::new(0),
        is_stopped: AtomicBool::new(false),
        learn: &|plan, tell| learn(site, plan, settings, &computer, tell),
    };
    let mut done = 0;
    let mut note = |psnr| {
        done += 1;
        tell(MergeProgress { step: done, steps, psnr }).is_continue()
    };
    let results = Results::new(&site.scratch, site.joined.sh_degree(), plans.len())?;
    let splats = thread::scope(|scope| {
        let (say, reports) = mpsc::channel();
        for _ in 0..at_once {
            let (work, say) = (&work, say.clone());
            scope.spawn(move || work.run(&say));
        }
        drop(say);
        results.gather(&reports, &work.is_stopped, &mut note)
    })?;
    Ok(Distilled { splats, steps })
}

/// The indices of the plans. Those that take longest come first, so that all threads end at the same time.
fn largest_first(plans: &[Plan]) -> Vec<usize> {
    let pixels = |plan: &Plan| {
        plan.cameras().iter().map(|camera| u64::from(camera.size_px[0]) * u64::from(camera.size_px[1])).sum()
    };
    let sizes: Vec<u64> = plans.iter().map(pixels).collect();
    let mut order: Vec<usize> = (0..plans.len()).collect();
    order.sort_by_key(|i| Reverse(sizes[*i]));
    order
}

/// Distils a tile. The second argument gets the PSNR of each step, and returns false to stop.
type Learn<'a> = dyn Fn(&Plan, &dyn Fn(f64) -> bool) -> Result<Splats, MergeError> + Sync + 'a;

/// The tiles that are left to distil.
struct Work<'a> {
    plans: &'a [Plan],
    order: Vec<usize>,
    /// Place of the next tile in `order`.
    next: AtomicUsize,
    is_stopped: AtomicBool,
    learn: &'a Learn<'a>,
}

impl Work<'_> {
    /// Distils one tile after the other until none is left.
    fn run(&self, say: &Sender<Report>) {
        while !self.is_stopped.load(Ordering::Relaxed) {
            let Some(&index) = self.order.get(self.next.fetch_add(1, Ordering::Relaxed)) else { return };
            // Nobody listens any more once the distillation has failed.
            let tell =
                |psnr| say.send(Report::Step(psnr)).is_ok() && !self.is_stopped.load(Ordering::Relaxed);
            let learnt = (self.learn)(&self.plans[index], &tell);
            if say.send(Report::Done(index, learnt)).is_err() {
                return;
            }
        }
    }
}

/// The distilled tiles.
struct Results {
    pages: Pages,
    /// The pages of each tile, and the number of its splats.
    tiles: Vec<(Range<usize>, usize)>,
}

impl Results {
    fn new(scratch: &Scratch, sh_degree: u32, tiles: usize) -> Result<Self, MergeError> {
        Ok(Self { pages: Pages::new(scratch, sh_degree)?, tiles: vec![(0..0, 0); tiles] })
    }

    /// Collects the tiles in their order. `note` gets the PSNR of each step; it returns false to stop.
    fn gather(
        mut self,
        reports: &Receiver<Report>,
        is_stopped: &AtomicBool,
        note: &mut dyn FnMut(f64) -> bool,
    ) -> Result<Splats, MergeError> {
        for report in reports {
            let outcome = match report {
                Report::Step(psnr) if note(psnr) => Ok(()),
                Report::Step(_) => Err(MergeError::GivenUp),
                Report::Done(index, learnt) => learnt.and_then(|learnt| self.keep(index, &learnt)),
            };
            if outcome.is_err() {
                is_stopped.store(true, Ordering::Relaxed);
                outcome?;
            }
        }
        let count = self.tiles.iter().map(|(_, count)| count).sum();
        let mut splats = Splats::with_capacity(count, self.pages.sh_degree());
        for (pages, _) in self.tiles {
            self.pages.read(pages, |_| true, |_, _| true, &mut splats)?;
        }
        Ok(splats)
    }

    fn keep(&mut self, index: usize, learnt: &Splats) -> Result<(), MergeError> {
        self.tiles[index] = (self.pages.append(learnt)?, learnt.len());
        Ok(())
    }
}
