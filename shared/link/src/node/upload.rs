//! Uploads one model and waits for the end of the upload.

use std::ops::ControlFlow;
use std::time::Duration;

use cosurf_wire::RefusalReason;

use super::event::NodeEvent;
use super::state::Node;
use crate::key::ModelKey;
use crate::offer::Offer;
use crate::transport::{PublishError, Transport};
use crate::uploader::UploadProgress;

/// Uploads a model. Returns when the aggregator has stored it or has refused it for good, or when the link
/// accepts only messages that are too small. All other events go to `on_event`, which must handle
/// [`NodeEvent::Store`].
pub fn upload_blocking<T: Transport>(
    node: &mut Node,
    transport: &mut T,
    offer: Offer,
    now: impl Fn() -> Duration,
    mut on_event: impl FnMut(&mut Node, NodeEvent),
) -> Result<UploadProgress, UploadFault> {
    let own_key = ModelKey::from(offer.header);
    node.upload(offer);
    node.serve(transport, now, Duration::from_secs(1), |node, event| match event {
        Some(NodeEvent::Uploaded(key, progress)) if key == own_key => ControlFlow::Break(Ok(progress)),
        Some(NodeEvent::UploadRefused { key, reason, .. }) if key == own_key && !reason.is_temporary() => {
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

/// Why an upload failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UploadFault {
    /// The aggregator refuses the model.
    #[error("the aggregator refuses the model: {0}")]
    Refused(RefusalReason),
    /// The broker accepts only messages that are too small for useful chunks.
    #[error("the broker accepts only small messages; raise its maximum packet size: {0}")]
    LinkTooNarrow(PublishError),
}
