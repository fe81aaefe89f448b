//! One model on its way, for those who wait for it.

use std::ops::ControlFlow;
use std::time::Duration;

use cosurf_wire::RefusalReason;

use super::event::NodeEvent;
use super::state::Node;
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::transport::{PublishError, Transport};
use crate::uploader::UploadProgress;

/// Uploads one model and returns when the aggregator has it on its disk, or why it refuses for good.
/// Everything else that happens is told to `on_event`, which must answer [`NodeEvent::Store`].
pub fn upload_blocking<T: Transport>(
    node: &mut Node,
    transport: &mut T,
    offer: Offer,
    now: impl Fn() -> Duration,
    mut on_event: impl FnMut(&mut Node, NodeEvent),
) -> Result<UploadProgress, UploadFault> {
    let mine = ModelKey::from(offer.header);
    node.upload(offer);
    node.serve(transport, now, Duration::from_secs(1), |node, event| match event {
        Some(NodeEvent::Uploaded(key, progress)) if key == mine => ControlFlow::Break(Ok(progress)),
        Some(NodeEvent::UploadRefused { key, reason, .. }) if key == mine && !reason.is_passing() => {
            ControlFlow::Break(Err(UploadFault::Refused(reason)))
        }
        Some(NodeEvent::LinkTooNarrow(error)) => ControlFlow::Break(Err(UploadFault::LinkTooNarrow(error))),
        Some(event) => {
            on_event(node, event);
            ControlFlow::Continue(())
        }
        None => ControlFlow::Continue(()),
    })
}

/// Why an upload ended without success.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UploadFault {
    /// The aggregator will not have it.
    #[error("the aggregator refuses the model: {0}")]
    Refused(RefusalReason),
    /// The broker takes no messages of a size that makes sense.
    #[error("the broker takes too small messages; raise its largest packet size: {0}")]
    LinkTooNarrow(PublishError),
}
