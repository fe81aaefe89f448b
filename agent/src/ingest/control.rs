//! Control points: where the photographs show them.

use cosurf_geo::{ControlPoint, Mark, Sighting, SiteFrame};
use glam::{DMat3, DVec2, DVec3};

use super::names::{Meant, Names};
use super::reconstruction::Reconstruction;

/// Lines of sight closer than this to each other leave the distance open, degrees.
const ANGLE_MIN_DEG: f64 = 2.0;
/// A mark so many pixels off has a quarter of its weight.
const QUARTER_AT_PX: f64 = 5.0;
/// A mark so many pixels off is of something else: even in photographs of 20 megapixels, marks are set to a few pixels.
const WRONG_FROM_PX: f64 = 20.0;
/// Rounds of weights.
const ROUNDS: usize = 20;
/// Standard deviation of a point that was measured and marked with care, metres: RTK has 2 to 3 cm, a pixel as much.
const SIGMA_M: f64 = 0.05;
/// With so many points, every third is held out, if the list does not say itself which ones are.
const HOLD_OUT_FROM: usize = 6;

/// A control point that enough photographs show.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct SeenPoint {
    pub(super) name: String,
    /// Indices of the photographs that show it, and where, pixels.
    pub(super) marks: Vec<(usize, DVec2)>,
    pub(super) sighting: Sighting,
}

/// Control points by their use.
#[derive(Debug, Default)]
pub(super) struct SeenPoints {
    /// To fit.
    pub(super) control: Vec<SeenPoint>,
    /// To judge the fit.
    pub(super) check: Vec<SeenPoint>,
    /// Names and reasons of those that are left out.
    pub(super) left_out: Vec<(String, String)>,
}

/// Finds where the reconstruction has the points.
pub(super) fn seen(points: &[ControlPoint], its: &Reconstruction, site: &SiteFrame) -> SeenPoints {
    let names = Names::of(its.posed.iter().map(|posed| posed.name.as_str()));
    let mut all = Vec::new();
    let mut seen = SeenPoints::default();
    for point in points {
        let of_several = |mark: &&Mark| names.find(&mark.photograph) == Meant::Several;
        seen.left_out.extend(point.marks.iter().filter(of_several).map(|mark| {
            let reason =
                "is of one of several photographs of this name; write their folders too, as in 100MEDIA/";
            let photograph = &mark.photograph;
            (format!("the mark of {} in {photograph}", point.name), format!("{reason}{photograph}"))
        }));
        let in_dataset = |mark: &Mark| Some((names.find(&mark.photograph).one()?, mark.at_px));
        let marks: Vec<(usize, DVec2)> = point.marks.iter().filter_map(in_dataset).collect();
        match locate(&marks, its) {
            Ok(Located { model, marks, wrong }) => {
                let mark = |photograph: usize| {
                    format!("the mark of {} in {}", point.name, its.posed[photograph].name)
                };
                seen.left_out
                    .extend(wrong.into_iter().map(|(photograph, reason)| (mark(photograph), reason)));
                let enu_m = site.enu_from_geodetic(&point.place);
                let sighting =
                    Sighting { model, enu_m, has_height: true, sigma_m: [SIGMA_M; 2], is_told: false };
                all.push((point.is_check(), SeenPoint { name: point.name.clone(), marks, sighting }));
            }
            Err(unseen) => {
                let reason = unseen.reason(marks.len(), point.marks.len());
                let noun = if point.is_check() { "check point" } else { "control point" };
                seen.left_out.push((format!("{noun} {}", point.name), reason));
            }
        }
    }
    let says_itself = points.iter().any(ControlPoint::is_check);
    let holds_out = !says_itself && all.len() >= HOLD_OUT_FROM;
    for (i, (is_check, point)) in all.into_iter().enumerate() {
        let only_checks = is_check || holds_out && i % 3 == 2;
        if only_checks { seen.check.push(point) } else { seen.control.push(point) }
    }
    seen
}

/// Where marks of one point meet.
struct Located {
    /// In the frame of the reconstruction.
    model: DVec3,
    /// The marks that agree.
    marks: Vec<(usize, DVec2)>,
    /// Photographs whose marks do not, and why these do not count.
    wrong: Vec<(usize, String)>,
}

/// Why the marks of a point give no place.
enum Unseen {
    /// Too few photographs, or from too similar places.
    TooFew,
    /// So many marks lie outside their pictures.
    Outside(usize),
    /// The marks are of different things: two of them are so many pixels apart.
    Contradictory(f64),
}

impl Unseen {
    /// In words, for a point with so many marks, of which `in_dataset` are in photographs of the dataset.
    fn reason(&self, in_dataset: usize, marks: usize) -> String {
        match self {
            Self::TooFew => format!(
                "{in_dataset} of the {marks} photographs that show it are in the dataset; a point takes two from \
                 different places"
            ),
            Self::Outside(count) => format!(
                "{count} of its {marks} marks lie outside their pictures; pixels count from the top-left corner of the \
                 photograph as it was taken, x first"
            ),
            Self::Contradictory(off_px) => {
                format!("its marks are of different things, {off_px:.0} pixels apart; check them")
            }
        }
    }
}

/// Finds where marks meet. Leaves out those that are of something else than the others, if at least two agree.
fn locate(marks: &[(usize, DVec2)], its: &Reconstruction) -> Result<Located, Unseen> {
    let is_inside = |(photograph, at_px): &(usize, DVec2)| {
        let size_px = its.lenses[its.posed[*photograph].lens].size_px;
        at_px.x <= f64::from(size_px[0]) && at_px.y <= f64::from(size_px[1])
    };
    let outside: Vec<usize> = marks.iter().filter(|mark| !is_inside(mark)).map(|mark| mark.0).collect();
    let sight = |(photograph, at_px): &(usize, DVec2)| {
        let (eye, ray, focal_px) = its.sight(&its.posed[*photograph], *at_px)?;
        Some(((*photograph, *at_px), Sight { eye, ray, focal_px }))
    };
    let (marks, sights): (Vec<_>, Vec<Sight>) =
        marks.iter().filter(|mark| is_inside(mark)).filter_map(sight).unzip();
    let few = if outside.is_empty() { Unseen::TooFew } else { Unseen::Outside(outside.len()) };
    let Some(model) = triangulate(&sights) else { return Err(few) };
    let off_px: Vec<f64> = sights.iter().map(|sight| sight.off_px(model)).collect();
    let (right, wrong): (Vec<usize>, Vec<usize>) = (0..marks.len()).partition(|i| off_px[*i] < WRONG_FROM_PX);
    let of_right: Vec<Sight> = right.iter().map(|i| sights[*i]).collect();
    let Some(model) = triangulate(&of_right) else {
        return Err(Unseen::Contradictory(off_px.iter().copied().fold(0.0, f64::max)));
    };
    let elsewhere = |i: usize| {
        let off_px = sights[i].off_px(model);
        let reason = format!(
            "is {off_px:.0} pixels from where the other photographs show the point; it does not count"
        );
        (marks[i].0, reason)
    };
    let outside = outside.into_iter().map(|i| (i, "lies outside the picture; it does not count".to_owned()));
    let wrong = outside.chain(wrong.into_iter().map(elsewhere)).collect();
    Ok(Located { model, marks: right.into_iter().map(|i| marks[i]).collect(), wrong })
}

/// A line of sight.
#[derive(Clone, Copy)]
struct Sight {
    eye: DVec3,
    /// Unit length.
    ray: DVec3,
    focal_px: f64,
}

impl Sight {
    /// How far a point is from the line: seen from the eye, pixels.
    fn off_px(&self, point: DVec3) -> f64 {
        let to = point - self.eye;
        self.focal_px * to.cross(self.ray).length() / to.dot(self.ray).max(1e-12)
    }
}

/// The point that all lines of sight pass closest to, in pixels. `None` if their angles are too small, or it lies behind a
/// camera.
fn triangulate(sights: &[Sight]) -> Option<DVec3> {
    let pairs = || sights.iter().enumerate().flat_map(|(i, a)| sights[..i].iter().map(move |b| (a, b)));
    let widest = pairs().map(|(a, b)| a.ray.angle_between(b.ray)).fold(0.0, f64::max);
    if widest < ANGLE_MIN_DEG.to_radians() {
        return None;
    }
    let mut weights = vec![1.0; sights.len()];
    let mut point = DVec3::ZERO;
    for _ in 0..ROUNDS {
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (Sight { eye, ray, .. }, weight) in sights.iter().zip(&weights) {
            // Takes away what lies along the line.
            let across = DMat3::IDENTITY - DMat3::from_cols(*ray * ray.x, *ray * ray.y, *ray * ray.z);
            matrix += across * *weight;
            right += across * *eye * *weight;
        }
        point = matrix.inverse() * right;
        for (sight, weight) in sights.iter().zip(&mut weights) {
            let pixel = sight.eye.distance(point) / sight.focal_px;
            *weight = (1.0 + (sight.off_px(point) / QUARTER_AT_PX).powi(2)).powi(-2) / (pixel * pixel);
        }
    }
    (point.is_finite() && sights.iter().all(|sight| (point - sight.eye).dot(sight.ray) > 0.0))
        .then_some(point)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use cosurf_geo::Geodetic;

    /// Photographs along a line, 10 above the ground.
    fn reconstruction(count: usize) -> Reconstruction {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).unwrap();
        write("cameras.txt", "1 OPENCV 640 480 500 500 320 240 0 0 0 0\n".into());
        // A half turn about x looks down: the translation of the camera at (i, 0, 10) is (-i, 0, 10).
        let line = |i: usize| format!("{i} 0 1 0 0 -{i} 0 10 1 IMG_{i}.JPG\n\n");
        write("images.txt", (0..count).map(line).collect());
        write("points3D.txt", String::new());
        Reconstruction::read(folder.path()).unwrap()
    }

    fn point(name: &str, at: DVec3, photographs: &[usize], off_px: f64) -> ControlPoint {
        let mark = |&i: &usize| Mark {
            photograph: format!("img_{i}.jpg"),
            at_px: DVec2::new(
                320.0 + 500.0 * (at.x - i as f64) / (10.0 - at.z) + off_px,
                240.0 - 500.0 * at.y / (10.0 - at.z),
            ),
        };
        let place = Geodetic { latitude_deg: 53.0, longitude_deg: 16.0, height_m: 70.0 };
        ControlPoint { name: name.into(), place, marks: photographs.iter().map(mark).collect() }
    }

    fn site() -> SiteFrame {
        SiteFrame::new(Geodetic { latitude_deg: 53.0, longitude_deg: 16.0, height_m: 0.0 }).unwrap()
    }

    #[test]
    fn points_are_found_where_their_marks_meet() {
        let at = DVec3::new(2.0, 1.0, 0.5);
        let mut with_bad_mark = point("b", at, &[0, 1, 2, 3, 4], 0.0);
        with_bad_mark.marks[2].at_px.x += 80.0;
        let points = [point("a", at, &[0, 3, 9], 0.0), with_bad_mark];
        let seen = seen(&points, &reconstruction(6), &site());
        assert_eq!([seen.control[0].marks.len(), seen.control[1].marks.len()], [2, 4]);
        assert_eq!(seen.left_out[0].0, "the mark of b in IMG_2.JPG");
        assert!(seen.left_out[0].1.starts_with("is 80 pixels"), "{:?}", seen.left_out);
        assert!(seen.control[0].sighting.model.distance(at) < 1e-9, "{:?}", seen.control[0]);
        assert!(seen.control[1].sighting.model.distance(at) < 0.02, "{:?}", seen.control[1]);
        assert!((seen.control[0].sighting.enu_m - DVec3::new(0.0, 0.0, 70.0)).length() < 1e-6);
    }

    #[test]
    fn points_that_one_photograph_shows_are_left_out_with_a_reason() {
        let points = [point("a", DVec3::ZERO, &[1, 7, 8], 0.0), point("b", DVec3::ZERO, &[7], 0.0)];
        let seen = seen(&points, &reconstruction(3), &site());
        assert!(seen.control.is_empty());
        assert_eq!(seen.left_out[0].0, "control point a");
        assert!(seen.left_out[0].1.starts_with("1 of the 3 photographs"), "{:?}", seen.left_out);
    }

    #[test]
    fn marks_outside_of_pictures_or_of_different_things_are_told_as_such() {
        let reason = |point: ControlPoint| {
            let seen = seen(&[point], &reconstruction(4), &site());
            assert!(seen.control.is_empty());
            seen.left_out[0].1.clone()
        };
        let mut outside = point("a", DVec3::X, &[0, 1], 0.0);
        outside.marks[1].at_px.x = 700.0;
        let told = reason(outside);
        assert!(told.starts_with("1 of its 2 marks lie outside their pictures"), "{told}");
        // The lines of sight pass each other, across the line on which the photographs were taken.
        let mut other_thing = point("a", DVec3::X, &[0, 3], 0.0);
        other_thing.marks[1].at_px.y += 100.0;
        let told = reason(other_thing);
        // The lens has 100 pixels between them, and one of the two lines of sight is longer.
        assert!(told.contains("of different things, 118 pixels apart"), "{told}");
    }

    #[test]
    fn every_third_of_six_points_is_held_out() {
        let names = ["a", "b", "c", "d", "e", "f"];
        let points = names.map(|name| point(name, DVec3::X, &[0, 1, 2], 0.0));
        let seen = seen(&points, &reconstruction(3), &site());
        let check: Vec<&str> = seen.check.iter().map(|point| &*point.name).collect();
        assert_eq!((check, seen.control.len()), (vec!["c", "f"], 4));
    }

    #[test]
    fn a_list_that_names_check_points_holds_out_no_others() {
        let points =
            ["a", "CHK-1", "c", "d", "e", "chk2", "g"].map(|name| point(name, DVec3::X, &[0, 1], 0.0));
        let names = |points: &[SeenPoint]| points.iter().map(|point| point.name.clone()).collect::<Vec<_>>();
        let its = reconstruction(2);
        let all = seen(&points, &its, &site());
        assert_eq!(
            (names(&all.check), names(&all.control).concat()),
            (vec!["CHK-1".into(), "chk2".into()], "acdeg".into())
        );
        // Which points are held out does not depend on which of them are seen.
        let unseen = points.map(|point| match point.is_check() {
            true => ControlPoint { marks: Vec::new(), ..point },
            false => point,
        });
        let rest = seen(&[&unseen[..], &[point("h", DVec3::X, &[0, 1], 0.0)]].concat(), &its, &site());
        assert_eq!((names(&rest.check).len(), names(&rest.control).concat()), (0, "acdegh".into()));
        assert_eq!(rest.left_out[0].0, "check point CHK-1");
    }
}
