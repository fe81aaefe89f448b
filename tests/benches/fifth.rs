//! Measures the PSNR that a mission's global model loses or gains if a fifth agent sends its model too. Some of the
//! fifth models are poor, some show something else, some come with wrong cameras, and one is better than the others.
//!
//! `cargo bench -p cosurf-tests --bench fifth -- --help`

mod held_out;
mod mission;

use std::env::temp_dir;
use std::f64::consts::{FRAC_PI_2, PI};
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::Parser;
use cosurf_aggregator::gate::{Admitted, Similarity, Workspace, admit};
use cosurf_aggregator::merge::{InMemory, Locals, MergeSettings, Resources, Tiles, merge};
use cosurf_city::{City, CitySettings};
use cosurf_link::Model;
use cosurf_scene::{Camera, Dataset, Pose, View, colmap};
use cosurf_tests::dice::Dice;
use cosurf_tests::models::read_model;
use cosurf_tests::programs::program;
use cosurf_tests::results::{Better, Column, Measurement, Tolerance};
use glam::{DQuat, DVec3};
use held_out::{EVERY, HeldOut, THREADS};
use mission::Mission;

/// How the model of a fifth agent is made.
type Fifth = fn(&Joined) -> Result<Model>;

/// The fifth agents: name, and how the model is made.
const FIFTHS: [(&str, Fifth); 12] = [
    ("160 px, 600 steps", |mission| mission.honest(160, 600)),
    ("160 px, 600 steps, said to be 1,280 px", |mission| mission.honest(160, 600).map(enlarged)),
    ("160 px, 600 steps, ten copies of each camera", |mission| mission.honest(160, 600).map(copied)),
    ("64 px, 3 steps", |mission| mission.honest(64, 3)),
    ("poses wrong by 5°", |mission| mission.misled("turned", turn)),
    ("random poses", |mission| mission.misled("shuffled", shuffle)),
    ("cameras in OpenGL's convention", |mission| Ok(mission.first_with(opengl))),
    ("cameras in a world with y up", |mission| Ok(mission.first_with(y_up))),
    ("cameras with inverted poses", |mission| Ok(mission.first_with(inverted))),
    ("cameras moved by 1 km", |mission| Ok(mission.first_with(far_away))),
    ("another city", Joined::another_city),
    ("honest and better", |mission| mission.honest(mission.long_side_px(), mission.better_steps)),
];
/// By how much pictures are said to be larger than they are.
const LARGER: f64 = 8.0;
/// Number of copies of each camera, and their distance, metres.
const COPIES: usize = 10;
const COPIES_APART_M: f64 = 1e-6;
/// By how much a camera with a wrong pose is turned.
const TURN_DEG: f64 = 5.0;
/// By how much cameras that are moved away are moved.
const FAR_M: f64 = 1000.0;

/// Measure what the model of a fifth agent costs or gains when it joins a mission of four. A fifth agent that is
/// trained on the mission's dataset sees all training views. Prints a table, before each row what the gate decided, and
/// writes JSON to target/results.
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    mission: Mission,
    /// Training steps of the models with wrong poses, and of another city's
    #[arg(long, value_name = "N", default_value_t = 600)]
    steps: u32,
    /// Training steps of the model that is better than the others
    #[arg(long, value_name = "N", default_value_t = 6000)]
    better_steps: u32,
    /// Folder that keeps the trained models of this dataset; models that it has are not trained again [default: a
    /// temporary folder]
    #[arg(long, value_name = "DIR")]
    fifths: Option<PathBuf>,
    /// Measure only cases whose names contain this text
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let temporary = tempfile::tempdir()?;
    let mission = Joined::open(&arguments, temporary.path())?;
    let views = HeldOut::read(&mission.dataset, |camera| camera.resized(mission.size_px))?;
    let psnr = |models: Vec<Model>| -> Result<f64> {
        Ok(views.psnr(&views.render(&mission.merged(models)?.splats)))
    };
    let lost = Column::new("lost", "dB", 2).guarded(Better::Lower, Tolerance::Absolute(0.1));
    let mut measurement = Measurement::start("fifth", &[Column::psnr("PSNR"), lost]);
    let alone = psnr(mission.models.clone())?;
    let mut row = |case: &str, psnr: f64| {
        measurement.row(&format!("{}: {case}", arguments.mission.name), &[Some(psnr), Some(alone - psnr)]);
    };
    row("the four alone", alone);
    for (case, fifth) in FIFTHS.into_iter().filter(|(case, _)| case.contains(&arguments.only)) {
        let fifth = fifth(&mission)?;
        row(case, psnr([&mission.models[..], &[fifth]].concat())?);
    }
    measurement.finish()?;
    Ok(())
}

/// The mission that the fifth agent joins.
struct Joined {
    data: PathBuf,
    dataset: Dataset,
    models: Vec<Model>,
    /// The names of the agents, and that of the fifth.
    names: Vec<String>,
    /// Size of the agents' pictures.
    size_px: [u32; 2],
    steps: u32,
    better_steps: u32,
    /// Folder of the trained fifth models.
    fifths: PathBuf,
}

impl Joined {
    /// Reads the mission. Without an option, the fifth models lie in the folder `temporary`.
    fn open(arguments: &Arguments, temporary: &Path) -> Result<Self> {
        let Mission { data, agents, .. } = &arguments.mission;
        let models = arguments.mission.models()?;
        let size_px = models[0].cameras.first().context("the first model has no cameras")?.size_px;
        let name = |agent: &PathBuf| agent.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self {
            data: data.clone(),
            dataset: Dataset::open(data)?,
            models,
            names: agents.iter().map(name).chain(["the fifth".to_owned()]).collect(),
            size_px,
            steps: arguments.steps,
            better_steps: arguments.better_steps,
            fifths: arguments.fifths.as_deref().unwrap_or(temporary).to_owned(),
        })
    }

    fn long_side_px(&self) -> u32 {
        self.size_px[0].max(self.size_px[1])
    }

    /// The global model of these models. Prints what the gate decided.
    fn merged(&self, models: Vec<Model>) -> Result<Model> {
        let (locals, settings) = (InMemory(models), MergeSettings::default());
        let admitted =
            admit(&locals, (&settings).into(), Workspace::of(&settings, &temp_dir(), THREADS), &|| false)?;
        self.tell(&admitted);
        Ok(merge(
            &admitted,
            &settings,
            Resources { scratch: &temp_dir(), tiles: Tiles::Forgotten, threads: THREADS },
            &mut |_| ControlFlow::Continue(()),
        )?
        .model)
    }

    /// Prints which models take part, which are kept out and why, and which are moved.
    fn tell(&self, admitted: &Admitted) {
        let taking_part = (0..admitted.count()).map(|i| self.names[admitted.place(i).local].as_str());
        println!("  taking part: {}", taking_part.collect::<Vec<_>>().join(", "));
        for (i, reason) in admitted.kept_out(&self.names) {
            println!("  kept out: {} {reason}", self.names[i]);
        }
        for place in (0..admitted.count()).map(|i| admitted.place(i)) {
            if let Some(by) = place.by {
                println!("  moved by {:.2} m: {}", by.distance_m, self.names[place.local]);
            }
        }
    }

    /// A model of the mission's dataset as it is.
    fn honest(&self, size_px: u32, steps: u32) -> Result<Model> {
        self.trained("honest", size_px, steps, |_| Ok(self.data.clone()))
    }

    /// A model of the mission's dataset after its poses are changed.
    fn misled(&self, name: &str, change: fn(&mut [View], &mut Dice)) -> Result<Model> {
        self.trained(name, self.long_side_px(), self.steps, |folder| {
            let mut dataset = self.dataset.clone();
            change(&mut dataset.views, &mut Dice(0));
            write(&dataset, folder)?;
            Ok(folder.to_owned())
        })
    }

    /// A model of the built-in city with another seed than the mission's. The model is moved so that the middles of
    /// both flights coincide.
    fn another_city(&self) -> Result<Model> {
        let model = self.trained("city", self.long_side_px(), self.steps, |folder| {
            let settings = CitySettings::default();
            City::build(&CitySettings { seed: settings.seed + 1, ..settings })?.write(folder, |_, _| ())?;
            Ok(folder.to_owned())
        })?;
        let here = middle(self.models.iter().flat_map(|model| &model.cameras));
        let translation = here - middle(&model.cameras);
        Ok(Similarity { translation, ..Similarity::IDENTITY }.model(&model))
    }

    /// The model of the first agent with other poses of its cameras.
    fn first_with(&self, change: fn(&Pose) -> Pose) -> Model {
        let Model { splats, cameras } = &self.models[0];
        let changed = |camera: &Camera| Camera { cam_from_world: change(&camera.cam_from_world), ..*camera };
        // One splat less: a copy would be kept out as such.
        Model { splats: splats.without(&[0]), cameras: cameras.iter().map(changed).collect() }
    }

    /// Reads a model from the folder of the fifth models, or trains it first if the folder lacks it. `data` gets a
    /// temporary folder, and gives the folder of the dataset.
    fn trained(
        &self,
        name: &str,
        size_px: u32,
        steps: u32,
        data: impl FnOnce(&Path) -> Result<PathBuf>,
    ) -> Result<Model> {
        let out = self.fifths.join(format!("{name}-{size_px}px-{steps}steps"));
        // A training writes its report last.
        if !out.join("report.json").is_file() {
            let temporary = tempfile::tempdir()?;
            train(&data(temporary.path())?, size_px, steps, &out)?;
        }
        read_model(&out)
    }
}

/// Trains a model by the agent's program, without the held-out views.
fn train(data: &Path, size_px: u32, steps: u32, out: &Path) -> Result<()> {
    let mut command = Command::new(program("cosurf-agent"));
    // A training that was broken off cannot be resumed: its dataset may have lain in another folder.
    command.args(["train", "--fresh"]).arg(data).arg("--out").arg(out);
    for (option, value) in [("--max-size", size_px), ("--steps", steps), ("--eval-every", EVERY)] {
        command.args([option, &value.to_string()]);
    }
    let output = command.stdin(Stdio::null()).stdout(Stdio::null()).output()?;
    // An agent that has learnt nothing, because of wrong poses, ends with an error after it has written all files.
    let is_written = out.join("report.json").is_file();
    ensure!(is_written, "{}: {}", out.display(), String::from_utf8_lossy(&output.stderr));
    Ok(())
}

/// Writes a dataset with copies of its pictures into a folder.
fn write(dataset: &Dataset, folder: &Path) -> Result<()> {
    colmap::write(folder, dataset)?;
    for View { name, path, .. } in &dataset.views {
        let copy = folder.join("images").join(name);
        fs::create_dir_all(copy.parent().context("a picture without a folder")?)?;
        fs::copy(path, copy)?;
    }
    Ok(())
}

/// The same model, whose pictures are said to be larger.
fn enlarged(mut model: Model) -> Model {
    for camera in &mut model.cameras {
        *camera = camera.resized(camera.size_px.map(|side| (LARGER * f64::from(side)) as u32));
    }
    model
}

/// The same model with further cameras that differ hardly from its own.
fn copied(mut model: Model) -> Model {
    let copies = |camera: &Camera| {
        let camera = *camera;
        (0..COPIES).map(move |copy| {
            let mut moved = camera;
            moved.cam_from_world.translation.x += COPIES_APART_M * copy as f64;
            moved
        })
    };
    model.cameras = model.cameras.iter().flat_map(copies).collect();
    model
}

/// Mean position of cameras.
fn middle<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> DVec3 {
    let eyes: Vec<DVec3> = cameras.into_iter().map(|camera| camera.cam_from_world.center()).collect();
    eyes.iter().sum::<DVec3>() / eyes.len().max(1) as f64
}

/// Turns every camera about a random axis through its centre.
fn turn(views: &mut [View], dice: &mut Dice) {
    for view in views {
        let turn = DQuat::from_axis_angle(dice.direction(), TURN_DEG.to_radians());
        view.camera.cam_from_world = turned(turn, &view.camera.cam_from_world);
    }
}

/// Shuffles the poses among the views (Fisher and Yates).
fn shuffle(views: &mut [View], dice: &mut Dice) {
    let mut poses: Vec<Pose> = views.iter().map(|view| view.camera.cam_from_world).collect();
    for i in (1..poses.len()).rev() {
        poses.swap(i, (dice.unit() * (i + 1) as f64) as usize);
    }
    views.iter_mut().zip(poses).for_each(|(view, pose)| view.camera.cam_from_world = pose);
}

/// The camera turned about its centre; the rotation is given in the camera's frame.
fn turned(turn: DQuat, pose: &Pose) -> Pose {
    Pose { rotation: turn * pose.rotation, translation: turn * pose.translation }
}

/// The pose in OpenGL's convention: the camera's y axis points up and its z axis backward.
fn opengl(pose: &Pose) -> Pose {
    turned(DQuat::from_rotation_x(PI), pose)
}

/// The pose in a world whose y axis points up, and whose z axis points south.
fn y_up(pose: &Pose) -> Pose {
    Pose { rotation: pose.rotation * DQuat::from_rotation_x(FRAC_PI_2), ..*pose }
}

/// The pose from the camera to the world, as if it led from the world to the camera.
fn inverted(pose: &Pose) -> Pose {
    Pose { rotation: pose.rotation.inverse(), translation: pose.center() }
}

/// The pose far to the east.
fn far_away(pose: &Pose) -> Pose {
    Pose { translation: pose.translation - pose.rotation * (FAR_M * DVec3::X), ..*pose }
}
