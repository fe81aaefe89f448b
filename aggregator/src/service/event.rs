//! What a service tells its owner.

use std::fmt;

use cosurf_scene::bytes::format_bytes;
use cosurf_wire::{DeviceId, ModelHeader, RefusalReason};
use serde::Serialize;

use super::record::KeptOut;
use crate::merge::MergeProgress;

/// What a service tells its owner.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum ServiceEvent {
    /// The link stands (again).
    Connected,
    /// The link does not stand and is tried again.
    Disconnected {
        /// Failed attempts since it last stood, from 1.
        attempt: u32,
        /// One line.
        reason: String,
    },
    /// A model is safe on the disk.
    Stored {
        /// What is announced of it.
        header: ModelHeader,
    },
    /// The disk refused; it is tried again.
    DiskFailed {
        /// One line.
        reason: String,
    },
    /// A model has not arrived as a whole; what has is used until the rest is there.
    PartTaken {
        /// What has arrived, as a model of its own.
        header: ModelHeader,
        /// Splats of the whole.
        of_splats: u32,
    },
    /// A merge has come further.
    Merging(MergeProgress),
    /// A device does not count any more.
    Withdrawn {
        /// Which.
        device: DeviceId,
    },
    /// There is a new global model, safe on the disk.
    Merged {
        /// What is announced of it; the model's number is the revision.
        header: ModelHeader,
        /// Local models in it.
        models: usize,
        /// Local models that are not, for what they contradict.
        kept_out: Vec<KeptOut>,
    },
    /// There is no new global model: nobody is believed.
    NothingMerged {
        /// The local models.
        kept_out: Vec<KeptOut>,
    },
    /// Every agent that is still counted on has the global model on its disk.
    Delivered,
    /// An agent refuses the global model.
    Refused {
        /// Who.
        by: DeviceId,
        /// Why.
        reason: RefusalReason,
    },
    /// Two drones have one name: neither gets far.
    SameName {
        /// Which.
        device: DeviceId,
    },
    /// Something was heard and thrown away.
    Ignored {
        /// One line.
        reason: String,
    },
}

impl fmt::Display for ServiceEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connected => write!(f, "connected to the broker"),
            Self::Disconnected { reason, .. } | Self::DiskFailed { reason } => write!(f, "{reason}"),
            Self::Stored { header } => {
                let size = format_bytes(header.body_bytes);
                write!(f, "the model of {} arrived: {} splats, {size}", header.device, header.splats)
            }
            Self::PartTaken { header, of_splats } => {
                let (device, splats) = (header.device, header.splats);
                write!(
                    f,
                    "of the model of {device} {splats} of {of_splats} splats have arrived; they are used"
                )
            }
            Self::Merging(MergeProgress { step, steps, psnr }) => {
                write!(f, "merging, step {step} of {steps}: {psnr:.2} dB of what the local models showed")
            }
            Self::Withdrawn { device } => write!(f, "{device} is withdrawn"),
            Self::Merged { header, models, kept_out } => {
                let (revision, splats) = (header.model, header.splats);
                write!(f, "global model, revision {revision}: {splats} splats of {models} models")?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out} and is kept out"))
            }
            Self::NothingMerged { kept_out } => {
                write!(f, "no model is merged")?;
                kept_out.iter().try_for_each(|kept_out| write!(f, "; {kept_out}"))
            }
            Self::Delivered => write!(f, "every agent has the global model"),
            Self::Refused { by, reason } => write!(f, "{by} refuses the global model: {reason}"),
            Self::SameName { device } => {
                write!(f, "two drones call themselves {device}; give each a device name of its own")
            }
            Self::Ignored { reason } => write!(f, "ignored: {reason}"),
        }
    }
}
