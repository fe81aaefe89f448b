//! Distillation: trains the joined model on what the local models render. Each tile of the ground is distilled by
//! itself, on one or several threads. So the result does not depend on the memory or on the number of threads: these
//! decide only how many tiles are distilled at once.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;

use cosurf_engine::Device;
use serde::Serialize;
use tracing::info_span;

use super::by_workers::{Here, by_workers};
use super::computer::Computer;
use super::error::MergeError;
use super::expected::Expected;
use super::learn::learn;
use super::memory::{STUDENT_SPLATS, at_once, beside_bytes, check_pictures, planning_bytes};
use super::news::{Learnt, Report};
use super::plan::Plan;
use super::results::{self, Found, TileRecord};
use super::settings::{MergeSettings, Tiles};
use super::shifts::Shifts;
use super::site::Site;
use super::splat_file::SplatFile;
use super::task::Task;
use super::tiles::Tile;
use crate::scratch::{Record, Records, Scratch};
use crate::store::Store;

/// Progress of a merge.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MergeProgress {
    /// Number of distillation steps done.
    pub step: u32,
    /// Number of distillation steps in all.
    pub steps: u32,
    /// PSNR of the last step on this computer, dB: the merged model's rendering against the local model's. Absent before
    /// the first one, and if none is done here because results are reused or workers distil.
    pub psnr: Option<f64>,
}

/// The result of a distillation.
pub(super) struct Distilled {
    pub(super) splats: SplatFile,
    pub(super) steps: u32,
    pub(super) tiles: Vec<TileRecord>,
    /// Number of tiles whose results were in the store.
    pub(super) found: usize,
}

/// Distils the joined splats of a site, divided into `tiles`. `lessons` has the cameras of each local model that teach.
/// Tiles whose results are kept are not distilled again.
pub(super) fn distill(
    site: &Site,
    tiles: Vec<Tile>,
    lessons: &[Vec<usize>],
    settings: &MergeSettings,
    computer: &Computer,
    by: Tiles,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Distilled, MergeError> {
    let _span = info_span!("distill", tiles = tiles.len()).entered();
    let plans = Plans::of(site, &tiles, lessons, computer, settings.memory_bytes)?;
    let steps = settings.epochs * plans.sizes.iter().map(|size| size.lessons).sum::<u32>();
    let bytes = plans.sizes.iter().map(|size| size.bytes).collect();
    let at_once = match by {
        Tiles::ByWorkers(_) => 1,
        _ => at_once(bytes, computer.threads, settings.memory_bytes, &computer.device)?,
    };
    let work = Work {
        plans: &plans,
        order: plans.longest_first(),
        next: AtomicUsize::new(0),
        is_stopped: AtomicBool::new(false),
        learn: &|plan, is_last, tell| {
            // The others will soon be done, and leave their threads to the last tile.
            let at_once = if is_last { 1 } else { at_once };
            let computer = Computer { threads: computer.threads / at_once, ..computer.clone() };
            let task = Task::of(site, &plan, settings, &computer.device)?;
            drop(plan);
            learn_or_find(&task, &site.scratch, &computer, by.store(), tell)
        },
    };
    let (mut done, mut last_psnr) = (0, None);
    let mut note = |new: Noted| {
        match new {
            Noted::Step(psnr) => (done, last_psnr) = (done + 1, Some(psnr)),
            Noted::Whole(index) => done += settings.epochs * plans.sizes[index].lessons,
            Noted::Nothing => {}
        }
        tell(MergeProgress { step: done, steps, psnr: last_psnr }).is_continue()
    };
    let results = Results::new(&site.scratch, plans.sizes.len(), site.joined.sh_degree())?;
    let (splats, tiles, found) = thread::scope(|scope| {
        let (say, reports) = mpsc::channel();
        if let Tiles::ByWorkers(workers) = by {
            let (plans, work) = (&plans, &work);
            scope.spawn(move || {
                let beside = beside_bytes(&computer.device);
                let here = Here {
                    class: computer.device.class(),
                    task: &|index| Task::of(site, &plans.get(index)?, settings, &computer.device),
                    needed_bytes: &|index| beside.saturating_add(plans.sizes[index].bytes),
                    memory_bytes: settings.memory_bytes,
                    learn: &|task, goes_on| learn(task, &site.scratch, computer, &|_| goes_on()),
                };
                by_workers(&work.order, workers, &here, &work.is_stopped, &say);
            });
        } else {
            for _ in 0..at_once {
                let (work, say) = (&work, say.clone());
                scope.spawn(move || work.run(&say));
            }
            drop(say);
        }
        let has_steps = !matches!(by, Tiles::ByWorkers(_));
        results.gather(&reports, &work.is_stopped, has_steps, &mut note)
    })?;
    Ok(Distilled { splats, steps, tiles, found })
}

/// Distils a tile, unless its result is in the store.
fn learn_or_find(
    task: &Task,
    scratch: &Scratch,
    computer: &Computer,
    store: Option<&Store>,
    tell: &dyn Fn(f64) -> bool,
) -> Result<Learnt, MergeError> {
    let hash = task.hash();
    let found = match store {
        Some(store) => results::find(store, &Expected::of(task)?)?,
        None => Found::Nothing,
    };
    let was_found = matches!(found, Found::Sound(_));
    if let Found::Bad(reason) = &found {
        tracing::warn!("the result of tile {hash} is replaced: {reason}");
    }
    let splats = match found {
        Found::Sound(splats) => splats,
        Found::Bad(_) | Found::Nothing => learn(task, scratch, computer, tell)?,
    };
    if let Some(store) = store.filter(|_| !was_found) {
        results::keep(store, &hash, &splats)?;
    }
    Ok(Learnt { record: TileRecord::of(&hash, &splats), splats, was_found })
}

/// The plans of all tiles, in a file.
struct Plans {
    records: Records,
    sizes: Vec<PlanSize>,
}

/// What stays in memory of a plan.
struct PlanSize {
    record: Record,
    lessons: u32,
    work: u64,
    bytes: u64,
}

impl Plans {
    fn of(
        site: &Site,
        tiles: &[Tile],
        lessons: &[Vec<usize>],
        computer: &Computer,
        memory_bytes: u64,
    ) -> Result<Self, MergeError> {
        let mut plans = Self { records: site.scratch.records()?, sizes: Vec::with_capacity(tiles.len()) };
        let mut largest: BTreeMap<usize, u64> = BTreeMap::new();
        let shifts = Shifts::of(planning_bytes(site.joined.sh_degree()), memory_bytes, computer.threads);
        let plan = |(): &mut (), index: usize| Plan::of(site, tiles[index], lessons, &computer.device);
        shifts.run(tiles.len(), &|| false, plan, |_, plan| {
            for (local, bytes) in &plan.picture_bytes {
                let most = largest.entry(*local).or_default();
                *most = (*most).max(*bytes);
            }
            plans.sizes.push(PlanSize {
                record: plans.records.put(&plan)?,
                lessons: plan.lessons.len() as u32,
                work: plan.work(),
                bytes: plan.bytes,
            });
            Ok(())
        })?;
        check_pictures(&largest, memory_bytes, &computer.device)?;
        plans.check_heaps(site, memory_bytes, &computer.device)?;
        Ok(plans)
    }

    /// An error if a tile takes more memory than a merge may because a model has heaped its splats there: more than half of
    /// those that an ordinary tile trains. Otherwise one such model would keep all others from being merged.
    fn check_heaps(&self, site: &Site, memory_bytes: u64, device: &Device) -> Result<(), MergeError> {
        let beside = beside_bytes(device);
        let (mut locals, mut needed_bytes) = (BTreeSet::new(), 0);
        for (index, size) in self.sizes.iter().enumerate() {
            if beside.saturating_add(size.bytes) > memory_bytes {
                let (local, splats) = self.get(index)?.most_of(site)?;
                locals.extend((splats > STUDENT_SPLATS / 2).then_some(local));
                needed_bytes = needed_bytes.max(beside.saturating_add(size.bytes));
            }
        }
        // If all have heaps, the limit is wrong rather than a model.
        match !locals.is_empty() && locals.len() < site.cameras.len() {
            true => {
                let locals = locals.into_iter().collect();
                Err(MergeError::ModelsTooLarge { locals, memory_bytes, needed_bytes })
            }
            false => Ok(()),
        }
    }

    fn get(&self, index: usize) -> Result<Plan, MergeError> {
        Ok(self.records.get(self.sizes[index].record)?)
    }

    /// The indices of the plans. Those that take longest come first, so that all threads end at the same time.
    fn longest_first(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.sizes.len()).collect();
        order.sort_by_key(|i| Reverse(self.sizes[*i].work));
        order
    }
}

/// Distils a tile. The second argument is true for the last tile. The third one gets the PSNR of each step, and returns
/// false to stop.
type Learn<'a> = dyn Fn(Plan, bool, &dyn Fn(f64) -> bool) -> Result<Learnt, MergeError> + Sync + 'a;

/// The tiles that are left to distil.
struct Work<'a> {
    plans: &'a Plans,
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
            let place = self.next.fetch_add(1, Ordering::Relaxed);
            let Some(&index) = self.order.get(place) else { return };
            let is_last = place + 1 == self.order.len();
            // Nobody listens any more once the distillation has failed.
            let tell =
                |psnr| say.send(Report::Step(psnr)).is_ok() && !self.is_stopped.load(Ordering::Relaxed);
            let learnt = self.plans.get(index).and_then(|plan| (self.learn)(plan, is_last, &tell));
            if say.send(Report::Done(index, learnt)).is_err() {
                return;
            }
        }
    }
}

/// News of a distillation.
enum Noted {
    /// PSNR of a step, dB.
    Step(f64),
    /// The whole tile with this index was in the store, or comes from a worker.
    Whole(usize),
    Nothing,
}

/// The distilled tiles.
struct Results {
    splats: SplatFile,
    /// Place of each tile's splats among the parts of the file, and its record.
    tiles: Vec<Option<(usize, TileRecord)>>,
    found: usize,
}

impl Results {
    fn new(scratch: &Scratch, tiles: usize, sh_degree: u32) -> Result<Self, MergeError> {
        Ok(Self { splats: SplatFile::new(scratch, sh_degree)?, tiles: vec![None; tiles], found: 0 })
    }

    /// Collects the tiles in their order. `note` gets all news; it returns false to stop. `has_steps` tells whether each
    /// step of a tile that is distilled is reported. Returns the splats, the
    /// records of the tiles, and the number of tiles that were in the store.
    fn gather(
        mut self,
        reports: &Receiver<Report>,
        is_stopped: &AtomicBool,
        has_steps: bool,
        note: &mut dyn FnMut(Noted) -> bool,
    ) -> Result<(SplatFile, Vec<TileRecord>, usize), MergeError> {
        for report in reports {
            let outcome = match report {
                Report::Step(psnr) if note(Noted::Step(psnr)) => Ok(()),
                Report::Waiting if note(Noted::Nothing) => Ok(()),
                Report::Step(_) | Report::Waiting => Err(MergeError::GivenUp),
                Report::Done(index, learnt) => {
                    learnt.and_then(|learnt| self.keep(index, learnt, has_steps, note))
                }
            };
            if outcome.is_err() {
                is_stopped.store(true, Ordering::Relaxed);
                outcome?;
            }
        }
        let tiles = self.tiles.into_iter().map(|tile| tile.expect("every tile has been distilled"));
        let (parts, tiles): (Vec<usize>, Vec<TileRecord>) = tiles.unzip();
        Ok((self.splats.with_order(&parts), tiles, self.found))
    }

    fn keep(
        &mut self,
        index: usize,
        learnt: Learnt,
        has_steps: bool,
        note: &mut dyn FnMut(Noted) -> bool,
    ) -> Result<(), MergeError> {
        let Learnt { record, splats, was_found } = learnt;
        self.tiles[index] = Some((self.splats.append(&splats)?, record));
        self.found += usize::from(was_found);
        let goes_on = (has_steps && !was_found) || note(Noted::Whole(index));
        if goes_on { Ok(()) } else { Err(MergeError::GivenUp) }
    }
}
