//! Puts a reconstruction in its place, and adjusts it to what is known of places.

use cosurf_contract::{AgentEvent, IngestStage};
use cosurf_geo::{GeoError, Up};

use super::adjustment::{TooLarge, adjust};
use super::error::IngestError;
use super::placing::{Placed, Places, up_of, upright};
use super::reconstruction::Reconstruction;

/// Rounds of placing and adjusting. The first straightens the block, so that the second can tell which marks and which
/// control points are wrong; the third no longer listens to these.
const ROUNDS: usize = 3;

/// Moves a reconstruction to where GPS and control points say, or only upright, and adjusts it to them.
pub(super) fn settle(
    its: &mut Reconstruction,
    places: Option<&Places>,
    tell: &mut dyn FnMut(AgentEvent),
) -> Result<Placed, IngestError> {
    let mut told = |done| {
        let stage = IngestStage::Adjusting;
        tell(AgentEvent::Ingesting { stage, done, of: ROUNDS, seconds_left: None, resumed: false });
    };
    let mut too_large = None;
    for round in 0..ROUNDS {
        told(round);
        let placed = place(its, places)?;
        its.move_by(&placed.similarity);
        if let Err(TooLarge { bytes }) = adjust(its, &placed.centers, &placed.points) {
            let reason = format!(
                "takes {:.1} GiB for {} photographs, more than 2 GiB; poses and lenses stay as COLMAP found them",
                bytes as f64 / (1_u64 << 30) as f64,
                its.posed.len()
            );
            too_large = Some(("the adjustment".to_owned(), reason));
            break;
        }
    }
    told(ROUNDS);
    let mut placed = place(its, places)?;
    its.move_by(&placed.similarity);
    placed.left_out.extend(too_large);
    Ok(placed)
}

/// Where a reconstruction lies; only upright if nothing tells it.
fn place(its: &Reconstruction, places: Option<&Places>) -> Result<Placed, IngestError> {
    let up = up_of(its).unwrap_or(Up { direction: glam::DVec3::Z, sigma_rad: std::f64::consts::PI });
    match places.map(|places| places.place(its, &up)) {
        Some(Err(GeoError::NoFit(reason))) => {
            let left_out = vec![("the place on the earth".to_owned(), reason.to_owned())];
            Ok(Placed { left_out, ..upright(&up) })
        }
        Some(placed) => Ok(placed?),
        None => Ok(upright(&up)),
    }
}
