//! The events that a service reports to its owner.

use std::fmt;

use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{DeviceId, ModelHeader, RefusalReason};
use serde::Serialize;

use super::record::KeptOut;
use crate::merge::MergeProgress;
use cosurf_contract::counted;

/// What a service reports.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum ServiceEvent {
    /// The link is up (again).
    Connected,
    /// The link is down; the service keeps trying.
    Disconnected {
        /// Number of failed attempts since the link was last up, from 1.
        attempt: u32,
        /// The reason, one line.
        reason: String,
    },
    /// A model is safe on the disk.
    Stored {
        /// Header of the model.
        header: ModelHeader,
    },
    /// A read, a write or a merge failed; the service tries again.
    DiskFailed {
        /// The reason, one line.
        reason: String,
    },
    /// The program died while a merge was reading this model.
    MergeDied {
        /// The device that sent the model.
        device: String,
        /// Number of the model.
        model: u64,
        /// True if the model is set aside: the program has died too often in a row while it was reading the model.
        is_set_aside: bool,
        /// The file that keeps the model aside.
        file: String,
    },
    /// A file in the folder of the service could not be used at the start, and was renamed.
    SetAside {
        /// What is wrong with which file, how it is called now, and what follows; one line.
        reason: String,
    },
    /// A model that was stored is missing or damaged. Its device is asked for it again.
    Lost {
        /// Header of the model.
        header: ModelHeader,
        /// What is wrong, one line.
        reason: String,
    },
    /// A model has arrived only in part; the part is used until the rest arrives.
    PartTaken {
        /// Header of the part, which is stored like a model of its own.
        header: ModelHeader,
        /// Number of splats of the whole model.
        of_splats: u32,
    },
    /// Progress of a merge.
    Merging(MergeProgress),
    /// A result of a tile was not believed, or the workers give none. The merge goes on.
    TileTrouble {
        /// The reason, one line.
        reason: String,
    },
    /// A device is withdrawn: the models that it has sent so far no longer count.
    Withdrawn {
        /// The device.
        device: DeviceId,
    },
    /// A device is revoked: its messages no longer count.
    Revoked {
        /// The device.
        device: DeviceId,
    },
    /// A revoked device may take part again.
    Readmitted {
        /// The device.
        device: DeviceId,
    },
    /// The newest revision repeats an older one, as the operator asked. It stays until a merge is asked for.
    Restored {
        /// The newest revision.
        revision: u64,
        /// The revision that it repeats.
        from: u64,
    },
    /// A revision cannot be restored.
    NotRestored {
        /// The revision.
        revision: u64,
        /// The reason, one line.
        reason: String,
    },
    /// The newest global model was merged from withdrawn models and is removed; the next merge makes a new one.
    GlobalWithdrawn,
    /// The newest global model is safe on the disk, and is offered to the agents.
    Merged {
        /// Header of the global model. Its model number is the revision.
        header: ModelHeader,
        /// Number of local models in the global model.
        models: usize,
        /// Local models that are kept out, with reasons.
        kept_out: Vec<KeptOut>,
    },
    /// Mesh and report of a revision are in the folder of the service.
    Reported {
        /// The revision.
        revision: u64,
        /// Number of triangles of the mesh; absent if there is none.
        #[serde(skip_serializing_if = "Option::is_none")]
        triangles: Option<usize>,
        /// Why there is no mesh; absent if there is one.
        #[serde(skip_serializing_if = "Option::is_none")]
        mesh_failure: Option<String>,
    },
    /// There is no new global model: all local models are kept out.
    NothingMerged {
        /// All local models, with the reasons.
        kept_out: Vec<KeptOut>,
    },
    /// Every agent that sent a model and is not given up has the global model on its disk.
    Delivered,
    /// An agent has lost the global model that it had stored, and gets it again.
    LostThere {
        /// The agent.
        device: DeviceId,
    },
    /// An agent refuses the global model.
    Refused {
        /// The agent.
        by: DeviceId,
        /// The reason.
        reason: RefusalReason,
    },
    /// An agent has a global model of a folder or file that was lost. The model is sent again, under a number that is higher
    /// than those that were lost.
    Outnumbered {
        /// The agent.
        by: DeviceId,
    },
    /// Two drones use the same device name, so they disturb each other's uploads.
    SameName {
        /// The name.
        device: DeviceId,
    },
    /// A model is not taken because a later session of its device was heard.
    OlderSession {
        /// The device.
        device: DeviceId,
        /// The newest session that was heard.
        heard: u64,
    },
    /// The broker does not take a message of this aggregator.
    Denied {
        /// The reason, one line.
        reason: String,
    },
    /// A message was discarded.
    Ignored {
        /// The reason, one line.
        reason: String,
    },
}

impl fmt::Display for ServiceEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connected => write!(f, "connected to the broker"),
            Self::Disconnected { attempt, reason } => write!(f, "{reason}; trying again (attempt {attempt})"),
            Self::DiskFailed { reason }
            | Self::SetAside { reason }
            | Self::TileTrouble { reason }
            | Self::Denied { reason } => {
                write!(f, "{reason}")
            }
            Self::Stored { header } => {
                let (splats, size) = (counted(header.splats, "splat"), format_bytes(header.body_bytes));
                write!(f, "the model of {} arrived: {splats}, {size}", header.device)
            }
            Self::MergeDied { device, model, is_set_aside: false, .. } => write!(
                f,
                "the program died in a merge, while it was reading model {model} of {device}; the model is merged again"
            ),
            Self::MergeDied { device, model, is_set_aside: true, file } => write!(
                f,
                "model {model} of {device} is set aside: the program died too often in a row while a merge was reading it; send a new \
                 model of {device}, or delete {file} to merge it once more"
            ),
            Self::Lost { header, reason } => {
                let (device, model) = (header.device, header.model);
                write!(f, "model {model} of {device} is lost: {reason}; {device} is asked for it again")
            }
            Self::PartTaken { header, of_splats } => {
                let (device, splats) = (header.device, header.splats);
                write!(
                    f,
                    "the model of {device} has arrived in part: {splats} of {of_splats} splats are used"
                )
            }
            Self::Merging(MergeProgress { step, steps, psnr }) => {
                write!(f, "merging, step {step} of {steps}")?;
                psnr.iter().try_for_each(|psnr| write!(f, ": PSNR {psnr:.2} dB against the local models"))
            }
            Self::Withdrawn { device } => write!(f, "{device} is withdrawn"),
            Self::Revoked { device } => write!(f, "{device} is revoked: its messages do not count"),
            Self::Readmitted { device } => write!(f, "{device} is no longer revoked"),
            Self::Restored { revision, from } => {
                write!(f, "revision {revision} repeats revision {from}, and stays until a merge is asked for")
            }
            Self::NotRestored { revision, reason } => {
                write!(f, "revision {revision} is not restored: {reason}")
            }
            Self::GlobalWithdrawn => {
                write!(f, "the global model is removed: it was merged from withdrawn models")
            }
            Self::Merged { header, models, kept_out } => {
                let (splats, models) = (counted(header.splats, "splat"), counted(*models, "model"));
                write!(f, "global model, revision {}: {splats} from {models}", header.model)?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out} and is kept out"))
            }
            Self::Reported { revision, triangles, mesh_failure } => {
                write!(f, "report.html shows revision {revision}")?;
                triangles
                    .iter()
                    .try_for_each(|count| write!(f, ", mesh.ply has {}", counted(*count, "triangle")))?;
                mesh_failure.iter().try_for_each(|reason| write!(f, "; no mesh: {reason}"))
            }
            Self::NothingMerged { kept_out } => {
                write!(f, "no global model: all local models are kept out")?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out}"))
            }
            Self::Delivered => write!(f, "every agent has the global model"),
            Self::LostThere { device } => {
                write!(f, "{device} no longer has the global model; it is sent again")
            }
            Self::Refused { by, reason } => write!(f, "{by} refuses the global model: {reason}"),
            Self::Outnumbered { by } => write!(
                f,
                "{by} has a global model of this number that is not in this folder: the model is sent again under a \
                 higher number"
            ),
            Self::SameName { device } => {
                write!(f, "two programs use the device name {device}; give each its own")
            }
            Self::OlderSession { device, heard } => write!(
                f,
                "ignored: a model of {device} from a session before {heard}, which was heard already: if it is not a \
                 recorded one, the drone's clock was ahead before; write a number above {heard} into the file `session` \
                 in its folder"
            ),
            Self::Ignored { reason } => write!(f, "ignored: {reason}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_merge_that_distils_nothing_tells_no_quality() {
        let merging = |psnr| ServiceEvent::Merging(MergeProgress { step: 4, steps: 9, psnr }).to_string();
        assert_eq!(merging(None), "merging, step 4 of 9");
        assert_eq!(merging(Some(20.125)), "merging, step 4 of 9: PSNR 20.12 dB against the local models");
    }
}
