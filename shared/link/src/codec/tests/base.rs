//! A base is usable alone, and its splats become part of the complete model.

use cosurf_scene::{Base, LocalFrame};

use super::*;

/// Every third splat, about twice as large, moved in x and y, and with another opacity and colour.
fn base(splats: &Splats) -> Base {
    let mut base = Base { ids: Vec::new(), splats: Splats::with_capacity(0, 0) };
    let mut noise = noise(11);
    for i in (0..splats.len()).step_by(3) {
        base.ids.push(i as u32);
        let [x, y, z] = splats.means[i];
        let mean = [x + 0.05 * noise(), y + 0.05 * noise(), z];
        let log_scale = splats.log_scales[i].map(|v| v + 0.7 + 0.3 * noise());
        let color = [noise(), noise(), noise()];
        base.splats.push(mean, splats.quats[i], log_scale, 3.0 * noise(), &color);
    }
    base
}

#[test]
fn a_base_stands_in_for_the_model_and_then_becomes_part_of_it() {
    let sent = splats(30_000, 2);
    let base = base(&sent);
    let body = model_to_body(&sent, &cameras(3), &LocalFrame::WORLD, FirstLayer::Base(&base)).unwrap();
    assert!(body.len() as f64 / 30_000.0 <= 16.0, "{} bytes", body.len());
    let plan = BodyPlan::new(&body).unwrap();
    let end_of_base =
        plan.packs().filter(|pack| pack.entry.kind == PackKind::Shapes && pack.entry.layer == 0);
    let end_of_base = end_of_base.map(|pack| pack.range.end).max().unwrap();
    let part =
        |end: usize| part_to_model(&body, |range| range.end <= end, &LocalFrame::WORLD).unwrap().unwrap();
    let first = part(end_of_base);
    assert_eq!((first.splats.len(), first.cameras.len()), (base.ids.len(), 3));
    let is_unchanged = |i: usize, origin: usize| {
        let (found, sent) = (&first.splats, &base.splats);
        let error_m = Vec3::from(found.means[i]).distance(Vec3::from(sent.means[origin]));
        let widths = [axes(found, i).1.max_element(), axes(sent, origin).1.max_element()];
        let colors = found.sh_of(i)[..3].iter().zip(sent.sh_of(origin));
        error_m < 0.02
            && (widths[0] / widths[1]).ln().abs() < 0.04
            && (found.opacity_logits[i] - sent.opacity_logits[origin]).abs() <= 0.5 * OPACITY_STEP
            && colors.into_iter().all(|(a, b)| (a - b).abs() <= 0.5 * COLOR_STEP + 1e-6)
            && found.sh_of(i)[3..].iter().all(|v| *v == 0.0)
    };
    // Some splats are too close to others to be matched by position, or were moved into the bounds.
    let origins_of_base = origins(&first.splats, &base.splats);
    let right = (0..first.splats.len()).filter(|&i| is_unchanged(i, origins_of_base[i])).count();
    assert!(right > 9_500, "{right} of 10,000");
    // Without its changes the base keeps its first form, and the other splats are hidden, because they would
    // overlap the base.
    let changes: Vec<_> = plan.packs_of(PackKind::Changes).map(|pack| pack.range).collect();
    let unchanged =
        part_to_model(&body, |range| !changes.contains(&range), &LocalFrame::WORLD).unwrap().unwrap();
    assert_eq!(unchanged, first);
    // The complete model equals the model that was encoded without a base, except for quantisation errors.
    let whole = body_to_model(&body, &LocalFrame::WORLD).unwrap().splats;
    let plain = body_to_model(&super::body(&sent), &LocalFrame::WORLD).unwrap().splats;
    let found = origins(&whole, &plain);
    let mut distinct = found.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert!(distinct.len() > 29_900, "{}", distinct.len());
    for (i, &other) in found.iter().enumerate() {
        let error_m = Vec3::from(whole.means[i]).distance(Vec3::from(plain.means[other]));
        assert!(error_m < 0.02, "{error_m} m");
    }
    let mut opacities = [&whole, &plain].map(|splats| splats.opacity_logits.clone());
    opacities.iter_mut().for_each(|all| all.sort_unstable_by(f32::total_cmp));
    assert_eq!(opacities[0], opacities[1]);
    // While the rest arrives, each region has either its base splats or its final splats.
    let mut counts = Vec::new();
    for end in (end_of_base..body.len()).step_by(10_007) {
        counts.push(part(end).splats.len());
    }
    assert!(counts.is_sorted() && counts[0] == base.ids.len() && counts.last() > Some(&20_000), "{counts:?}");
}

#[test]
fn a_base_with_reversed_axes_and_outside_the_bounds_round_trips() {
    let sent = splats(600, 1);
    let mut base = base(&sent);
    for i in 0..base.ids.len() {
        base.splats.log_scales[i].reverse();
        base.splats.means[i] = base.splats.means[i].map(|v| 3.0 * v);
    }
    let body = model_to_body(&sent, &[], &LocalFrame::WORLD, FirstLayer::Base(&base)).unwrap();
    assert_eq!(body_to_model(&body, &LocalFrame::WORLD).unwrap().splats.len(), 600);
    for end in (0..body.len()).step_by(101) {
        let part = part_to_model(&body, |range| range.end <= end, &LocalFrame::WORLD).unwrap();
        assert!(part.is_none_or(|part| part.splats.find_bad_value().is_none()));
    }
    base.splats.means[7][0] = f32::NAN;
    let fault = model_to_body(&sent, &[], &LocalFrame::WORLD, FirstLayer::Base(&base)).unwrap_err();
    assert_eq!(fault, BodyFault::Splat { index: 21, field: "mean" });
    let empty = Base::default();
    assert!(model_to_body(&sent, &[], &LocalFrame::WORLD, FirstLayer::Base(&empty)).is_ok());
}
