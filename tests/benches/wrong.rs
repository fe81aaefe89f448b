//! Models that lie in a wrong frame.

use cosurf_aggregator::gate::Similarity;
use cosurf_link::Model;
use cosurf_tests::dice::Dice;
use glam::{DQuat, DVec3};

/// Ways in which one model can lie wrong: name, distance in metres, rotation in degrees, and scale.
pub(crate) const WRONG: [(&str, f64, f64, f64); 10] = [
    ("moved by 0.25 m", 0.25, 0.0, 1.0),
    ("moved by 0.5 m", 0.5, 0.0, 1.0),
    ("moved by 1 m", 1.0, 0.0, 1.0),
    ("moved by 2 m", 2.0, 0.0, 1.0),
    ("moved by 5 m", 5.0, 0.0, 1.0),
    ("turned by 0.2°", 0.0, 0.2, 1.0),
    ("turned by 0.5°", 0.0, 0.5, 1.0),
    ("turned by 1°", 0.0, 1.0, 1.0),
    ("0.5 % too large", 0.0, 0.0, 1.005),
    ("2 % too large", 0.0, 0.0, 1.02),
];

/// The model turned and scaled about the middle of its flight, then moved; axis and direction are random.
pub(crate) fn displaced(model: &Model, dice: &mut Dice, by_m: f64, turn_deg: f64, scale: f64) -> Model {
    let rotation = DQuat::from_axis_angle(dice.direction(), turn_deg.to_radians());
    about_its_middle(model, scale, rotation, by_m * dice.direction())
}

/// The model turned and scaled about the middle of its flight, then moved.
pub(crate) fn about_its_middle(model: &Model, scale: f64, rotation: DQuat, by_m: DVec3) -> Model {
    let eyes = model.cameras.iter().map(|camera| camera.cam_from_world.center());
    let middle = eyes.sum::<DVec3>() / model.cameras.len().max(1) as f64;
    let translation = by_m + middle - scale * (rotation * middle);
    Similarity { scale, rotation, translation }.model(model)
}

/// The similarity that lays the cameras of `from` best on those of `to`. `None` if they are too few.
pub(crate) fn between<'a>(
    from: impl IntoIterator<Item = &'a Model>,
    to: impl IntoIterator<Item = &'a Model>,
) -> Option<Similarity> {
    Similarity::between(&eyes(from), &eyes(to))
}

/// The centres of the cameras of all models.
pub(crate) fn eyes<'a>(models: impl IntoIterator<Item = &'a Model>) -> Vec<DVec3> {
    let cameras = models.into_iter().flat_map(|model| &model.cameras);
    cameras.map(|camera| camera.cam_from_world.center()).collect()
}
