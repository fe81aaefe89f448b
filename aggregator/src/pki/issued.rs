//! The list of all certificates and signing keys that a site has issued to participants.

use std::fs;
use std::io;
use std::path::Path;

use cosurf_scene::{SceneError, atomic};
use serde::{Deserialize, Serialize};

const FILE: &str = "issued.toml";

/// Everything that was issued, oldest first.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Issued {
    #[serde(default)]
    issued: Vec<Record>,
}

/// What a participant got.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    /// Name of the participant.
    pub(super) name: String,
    /// Serial number of its certificate, hexadecimal.
    pub(super) serial: String,
    /// Its line in a list of trusted keys.
    pub(super) key: String,
    /// When it was made, seconds since 1970.
    pub(super) made_s: u64,
    /// When it was revoked, seconds since 1970.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) revoked_s: Option<u64>,
}

impl Record {
    /// Its line in a list of trusted keys, which tells whether it is revoked.
    pub(super) fn trust_line(&self) -> String {
        let revoked = if self.revoked_s.is_some() { "revoked " } else { "" };
        format!("{revoked}{}\n", self.key)
    }
}

impl Issued {
    /// Reads the list of a folder; it is empty if the folder has none.
    pub(super) fn read(folder: &Path) -> Result<Self, SceneError> {
        let path = folder.join(FILE);
        match fs::read_to_string(&path) {
            Ok(text) => {
                toml::from_str(&text).map_err(|error| SceneError::malformed(&path, error.to_string()))
            }
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(cause) => Err(SceneError::io(&path, cause)),
        }
    }

    pub(super) fn write(&self, folder: &Path) -> Result<(), SceneError> {
        let path = folder.join(FILE);
        let text = toml::to_string(self).map_err(|error| SceneError::io(&path, io::Error::other(error)))?;
        atomic::write_bytes(&path, text.as_bytes())
    }

    pub(super) fn add(&mut self, record: Record) {
        self.issued.push(record);
    }

    /// Notes that all that a participant got is revoked.
    pub(super) fn revoke(&mut self, name: &str, now_s: u64) {
        for record in self.issued.iter_mut().filter(|record| record.name == name) {
            record.revoked_s.get_or_insert(now_s);
        }
    }

    /// All records.
    pub(super) fn all(&self) -> impl Iterator<Item = &Record> {
        self.issued.iter()
    }

    /// The records that are not revoked.
    pub(super) fn valid(&self) -> impl Iterator<Item = &Record> {
        self.all().filter(|record| record.revoked_s.is_none())
    }

    /// The serial number of what a participant got last.
    pub(super) fn last_serial(&self, name: &str) -> Option<&str> {
        self.all().filter(|record| record.name == name).last().map(|record| record.serial.as_str())
    }
}
