//! Merges two small models of one coloured ground. Some models have black splats above the ground (`clouds`), which
//! their own cameras do not see.
#![allow(clippy::unwrap_used)]

mod device;
mod workers;

use cosurf_engine::{Device, DeviceChoice, Observers, Renderer};
use cosurf_scene::Splats;
use cosurf_scene::metrics::psnr;

use super::*;
use crate::store::Store;
use crate::testing::{above, ground};

/// A model of the ground from x = `west` to `east`, with cameras above `places`. Black splats float at the x of
/// `clouds`, outside the view of these cameras.
fn local(west: f32, east: f32, places: &[f64], clouds: &[f32]) -> Model {
    let mut splats = ground(west, east);
    for x in clouds {
        splats.push([*x, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.0; 3], 1.5, &[-1.7; 3]);
    }
    Model { splats, cameras: places.iter().map(|x| above(*x)).collect() }
}

/// Two models of neighbouring flights that meet at x = 0. Each has a black splat above the ground of the other.
pub(crate) fn neighbours() -> InMemory {
    let west = local(-20.0, 4.0, &[-14.0, -12.0, -10.0, -8.0, -6.0, -4.0], &[5.0]);
    let east = local(-4.0, 20.0, &[14.0, 12.0, 10.0, 8.0, 6.0, 4.0], &[-5.0]);
    InMemory(vec![west, east])
}

fn run(locals: &dyn Locals, settings: &MergeSettings, threads: usize) -> Merged {
    try_to_run(locals, settings, threads, &mut |_| ControlFlow::Continue(())).unwrap()
}

fn try_to_run(
    locals: &dyn Locals,
    settings: &MergeSettings,
    threads: usize,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    let scratch = tempfile::tempdir().unwrap();
    merge(locals, settings, Resources { scratch: scratch.path(), tiles: Tiles::Forgotten, threads }, tell)
}

/// Merges with tiles of at most `tile_splats` splats.
fn in_tiles(locals: &dyn Locals, settings: &MergeSettings, threads: usize, tile_splats: usize) -> Merged {
    let folder = tempfile::tempdir().unwrap();
    let mut go_on = |_: MergeProgress| ControlFlow::Continue(());
    let resources = Resources { scratch: folder.path(), tiles: Tiles::Forgotten, threads };
    let merged =
        merge_in_tiles(locals, settings, resources, tile_splats, &mut go_on).unwrap().read().unwrap();
    assert_eq!(folder.path().read_dir().unwrap().count(), 0, "a file is left");
    merged
}

/// Mean PSNR of a model's renderings against those of the true ground, from fixed positions, dB.
fn quality(splats: &Splats) -> f64 {
    agreement(splats, &ground(-30.0, 30.0))
}

/// Mean PSNR between the renderings of two models, from fixed positions, dB.
fn agreement(splats: &Splats, others: &Splats) -> f64 {
    let (mut truth, mut shown) = (Renderer::new(others, 1), Renderer::new(splats, 1));
    let places = [-9.0, -5.0, -3.0, 3.0, 5.0, 9.0];
    places.map(|x| psnr(&shown.render(&above(x)).rgb, &truth.render(&above(x)).rgb)).iter().sum::<f64>() / 6.0
}

#[test]
fn a_camera_far_away_does_not_raise_the_learning_rates() {
    let settings = MergeSettings { epochs: 2, ..MergeSettings::default() };
    let calm = quality(&run(&neighbours(), &settings, 1).model.splats);
    let mut locals = neighbours();
    let mut far = above(0.0);
    far.cam_from_world.translation.z += 1e6;
    locals.0[0].cameras.push(far);
    let with_far = quality(&run(&locals, &settings, 1).model.splats);
    assert!(with_far > calm - 0.5, "{with_far:.2} dB instead of {calm:.2} dB");
}

#[test]
fn a_single_model_stays_as_it_is() {
    let alone = InMemory(neighbours().0[..1].to_vec());
    let merged = run(&alone, &MergeSettings::default(), 1);
    assert_eq!((merged.summary.steps, merged.model), (0, alone.0[0].clone()));
}

#[test]
fn distillation_removes_clouds_that_teachers_do_not_show() {
    let locals = neighbours();
    let settings = MergeSettings { compress: false, ..MergeSettings::default() };
    let joined = run(&locals, &MergeSettings { epochs: 0, ..settings }, 1);
    let mut steps = Vec::new();
    let taught = try_to_run(&locals, &MergeSettings { epochs: 10, ..settings }, 1, &mut |progress| {
        steps.push(progress.step);
        ControlFlow::Continue(())
    });
    let taught = taught.unwrap();
    assert_eq!(steps, (1..=120).collect::<Vec<_>>());
    let (before, after) = (quality(&joined.model.splats), quality(&taught.model.splats));
    assert!(after > before + 3.0, "{before:.2} dB joined, {after:.2} dB distilled");
    assert_eq!(taught.model.cameras, joined.model.cameras);
    assert_eq!((taught.summary.joined, taught.summary.steps), (joined.model.splats.len(), 120));
}

#[test]
fn compression_removes_clouds_above_ground_that_another_model_saw() {
    let joined = |compress| {
        run(&neighbours(), &MergeSettings { compress, epochs: 0, ..MergeSettings::default() }, 1).model
    };
    let clouds = |model: &Model| model.splats.means.iter().filter(|mean| mean[2] > 1.0).count();
    assert_eq!([joined(false), joined(true)].map(|model| clouds(&model)), [2, 0]);
}

#[test]
fn the_same_models_give_the_same_bytes_with_any_memory_and_number_of_threads() {
    let settings = MergeSettings { epochs: 2, ..MergeSettings::default() };
    let with = |memory_bytes, threads| {
        in_tiles(&neighbours(), &MergeSettings { memory_bytes, ..settings }, threads, 400)
    };
    let [little, one, three] = [with(32 << 20, 3), with(4 << 30, 1), with(4 << 30, 3)];
    assert_eq!(little, one);
    assert_eq!(three, one);
    let other = in_tiles(&neighbours(), &MergeSettings { seed: 1, ..settings }, 1, 400);
    assert_ne!(one, other, "another seed gives another order");
}

/// Merges with tiles of at most 400 splats, whose results are kept in `store`.
fn with_store(
    locals: &dyn Locals,
    store: &Store,
    tell: &mut dyn FnMut(MergeProgress) -> ControlFlow<()>,
) -> Result<Merged, MergeError> {
    let settings = MergeSettings { epochs: 2, device: DeviceChoice::Cpu, ..MergeSettings::default() };
    let scratch = tempfile::tempdir().unwrap();
    let resources = Resources { scratch: scratch.path(), tiles: Tiles::Kept(store), threads: 2 };
    merge_in_tiles(locals, &settings, resources, 400, tell)?.read()
}

#[test]
fn what_no_model_changes_is_not_computed_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::in_folder(folder.path()).unwrap();
    let run = |locals: &dyn Locals| with_store(locals, &store, &mut |_| ControlFlow::Continue(())).unwrap();
    let first = run(&neighbours());
    let tiles = first.summary.tiles;
    assert!(tiles >= 3 && first.summary.known_tiles == 0, "{:?}", first.summary);
    let mut told = Vec::new();
    let mut note = |progress| {
        told.push(progress);
        ControlFlow::Continue(())
    };
    let mut again = with_store(&neighbours(), &store, &mut note).unwrap();
    assert_eq!(again.summary.known_tiles, tiles);
    let is_reused = |progress: &MergeProgress| progress.psnr.is_none();
    assert!(told.last().unwrap().step > 0 && told.iter().all(is_reused), "no step, no PSNR: {told:?}");
    again.summary.known_tiles = 0;
    assert_eq!(again, first);

    // A model beside the others comes first in the order, and has nothing to do with the western tiles.
    let mut more = neighbours();
    let east = local(18.0, 40.0, &[24.0, 26.0, 28.0, 30.0, 32.0, 34.0], &[]);
    more.0.insert(0, east);
    let third = run(&more);
    let known = third.tiles.iter().filter(|tile| first.tiles.contains(tile)).count();
    assert!(known > 0 && known < tiles, "{known} of {tiles} tiles are known");
    assert_eq!(third.summary.known_tiles, known);

    keep_only(&store, &first.tiles[..1]).unwrap();
    assert_eq!(run(&neighbours()).summary.known_tiles, 1);
    let damaged = folder.path().join(&first.tiles[0].task);
    std::fs::write(&damaged, "nothing of use").unwrap();
    let mended = run(&neighbours());
    assert_eq!((mended.summary.known_tiles, mended.tiles), (tiles - 1, first.tiles));
}

#[test]
fn tiles_of_a_merge_that_was_broken_off_are_used_by_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::in_folder(folder.path()).unwrap();
    let mut go_on = |_: MergeProgress| ControlFlow::Continue(());
    let whole = in_tiles(
        &neighbours(),
        &MergeSettings { epochs: 2, device: DeviceChoice::Cpu, ..MergeSettings::default() },
        1,
        400,
    );
    let broken_off = with_store(&neighbours(), &store, &mut |progress| {
        if progress.step < progress.steps - 2 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    });
    assert!(matches!(broken_off, Err(MergeError::GivenUp)));
    let next = with_store(&neighbours(), &store, &mut go_on).unwrap();
    assert!(next.summary.known_tiles > 0, "{:?}", next.summary);
    assert_eq!((next.model, next.tiles), (whole.model, whole.tiles));
}

#[test]
fn tiles_are_almost_as_good_as_the_whole_model() {
    let (locals, settings) =
        (neighbours(), MergeSettings { epochs: 40, compress: false, ..MergeSettings::default() });
    let [whole, tiles] = [usize::MAX, 400].map(|splats| in_tiles(&locals, &settings, 2, splats));
    assert!(tiles.summary.steps > whole.summary.steps, "the model is not divided");
    let untaught = run(&locals, &MergeSettings { epochs: 0, ..settings }, 1);
    let [whole, tiles, untaught] = [whole, tiles, untaught].map(|merged| quality(&merged.model.splats));
    assert!(tiles > untaught + 10.0 && tiles > whole - 2.5, "{untaught:.2}, {whole:.2}, {tiles:.2} dB");
}

#[test]
fn too_little_memory_is_refused_with_the_remedy() {
    let settings = MergeSettings { memory_bytes: 2_200_000, ..MergeSettings::default() };
    let refused = try_to_run(&neighbours(), &settings, 1, &mut |_| ControlFlow::Continue(()));
    let Err(error @ MergeError::TooLittleMemory { needed_bytes, .. }) = refused else {
        panic!("{refused:?}")
    };
    assert!(error.to_string().contains("--memory"), "{error}");
    // What the tiles need is known later than what the models need.
    let for_models = MergeSettings { memory_bytes: needed_bytes, epochs: 1, ..settings };
    let refused = try_to_run(&neighbours(), &for_models, 1, &mut |_| ControlFlow::Continue(()));
    let Err(MergeError::TooLittleMemory { needed_bytes, .. }) = refused else { panic!("{refused:?}") };
    let enough = MergeSettings { memory_bytes: needed_bytes, ..for_models };
    assert_eq!(run(&neighbours(), &enough, 1).summary.locals.len(), 2);
}

#[test]
fn a_merge_stops_when_told_to() {
    let mut steps = 0;
    let given_up = try_to_run(&neighbours(), &MergeSettings::default(), 1, &mut |_| {
        steps += 1;
        if steps == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(given_up, Err(MergeError::GivenUp)) && steps == 3);
}

/// Models of two flights that share much of their ground.
fn overlapping() -> Vec<Model> {
    let west = local(-20.0, 10.0, &[-12.0, -9.0, -6.0, -3.0, 0.0, 3.0], &[]);
    let east = local(-10.0, 20.0, &[12.0, 9.0, 6.0, 3.0, 0.0, -3.0], &[]);
    vec![west, east]
}

#[test]
fn shared_ground_has_one_owner_and_stays_covered() {
    let locals = InMemory(overlapping());
    let settings = MergeSettings { compress: true, epochs: 0, ..MergeSettings::default() };
    let merged = run(&locals, &settings, 1);
    let [first, second] = merged.summary.locals[..] else { panic!("{:?}", merged.summary) };
    for local in [first, second] {
        assert!((0.3..1.0).contains(&local.overlap) && local.removed > 0, "{local:?}");
    }
    let arrived = first.arrived + second.arrived;
    assert!((arrived - merged.summary.joined) * 100 >= 20 * arrived, "{first:?} {second:?}");
    let mut shown = Renderer::new(&merged.model.splats, 1);
    let both = Model { splats: ground(-20.0, 20.0), cameras: Vec::new() };
    let mut full = Renderer::new(&both.splats, 1);
    for x in -12..=12 {
        let (here, there) = (shown.render(&above(f64::from(x))), full.render(&above(f64::from(x))));
        let holes = here.alpha.iter().zip(&there.alpha).filter(|(a, b)| **b > 0.95 && **a < 0.9).count();
        assert_eq!(holes, 0, "at {x}");
    }
}

/// Local models. The merge is told that the first so many were pruned before upload.
struct Pruned(InMemory, usize);

impl Locals for Pruned {
    fn count(&self) -> usize {
        self.0.count()
    }

    fn load(&self, index: usize) -> Result<Model, MergeError> {
        self.0.load(index)
    }

    fn is_compressed(&self, index: usize) -> bool {
        index < self.1
    }
}

#[test]
fn a_model_pruned_before_upload_does_not_teach_black() {
    let models = overlapping();
    let mut observers = Observers::default();
    models.iter().for_each(|model| observers.announce(&model.cameras));
    let pruned = models.into_iter().enumerate().map(|(own, Model { splats, cameras: its })| {
        let removed = Compression::plan(&splats, own, &observers).removed;
        assert!(!removed.is_empty());
        Model { splats: splats.without(&removed), cameras: its }
    });
    let pruned = InMemory(pruned.collect());
    let merged = |is_told| {
        let settings = MergeSettings { epochs: 10, device: DeviceChoice::Cpu, ..MergeSettings::default() };
        run(&Pruned(pruned.clone(), if is_told { 2 } else { 0 }), &settings, 1)
    };
    let (told, untold) = (merged(true), merged(false));
    assert_eq!((told.summary.steps, told.summary.splats), (0, told.summary.joined));
    let [told, untold] = [told, untold].map(|merged| quality(&merged.model.splats));
    assert!(told > untold + 1.0, "{told:.2} dB if the merge knows of the pruning, {untold:.2} dB if not");
}

/// A model with few splats that claims large pictures, and says that it was pruned.
#[test]
fn one_model_that_says_it_was_pruned_does_not_make_all_claims_believed() {
    let [west, east] = overlapping().try_into().unwrap();
    let mut liar = west.clone();
    let is_thin = |i: &u32| !i.is_multiple_of(9);
    liar.splats = liar.splats.without(&(0..liar.splats.len() as u32).filter(is_thin).collect::<Vec<_>>());
    liar.cameras
        .iter_mut()
        .for_each(|camera| *camera = camera.resized(camera.size_px.map(|side| side * 3 / 2)));
    let settings = MergeSettings { epochs: 0, device: DeviceChoice::Cpu, ..MergeSettings::default() };
    let taken = |pruned| {
        let locals = InMemory(vec![liar.clone(), west.clone(), east.clone()]);
        let LocalSummary { arrived, removed, .. } =
            run(&Pruned(locals, pruned), &settings, 1).summary.locals[1];
        removed as f64 / arrived as f64
    };
    let (none, one, most) = (taken(0), taken(1), taken(2));
    assert!(one == none && none < 0.6, "{one} and {none} of an honest model are lost");
    assert!(most > none + 0.1, "{most} is lost where only cameras count, {none} elsewhere");
}
