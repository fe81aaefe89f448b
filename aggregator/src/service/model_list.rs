//! Lists of models by number and hash, each in a small file beside the models: those withdrawn by `forget`, and those that
//! newer models of their device have replaced.
//!
//! A model is listed by itself. So a number that a stranger has used, however high, says nothing about the device's own
//! models.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use cosurf_scene::{SceneError, atomic, files};
use cosurf_wire::{DeviceId, ModelHeader, ModelId};

use super::inputs::Input;

/// Limit on the models of a list. Beyond it, those with the lowest numbers are left out.
const MODELS_MAX: usize = 1024;
/// The line that asks a service to list the models that it has.
const ASKS: &str = "asks";
/// Before the number of a session: the flights of the device up to that session.
const FLIGHTS: &str = "flights";
/// Before the BLAKE3 hash of all other lines.
const CHECK: &str = "# check ";
/// In the place of a hash: all models with the number.
const ANY: &str = "any";

/// Models of one device.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct ModelList {
    /// Numbers and hashes in hexadecimal digits, or [`ANY`].
    models: BTreeSet<(ModelId, String)>,
    /// All models up to this number, from a list of version 0.1.
    up_to: Option<ModelId>,
    /// The device's flights of sessions up to this one are withdrawn, too.
    pub(super) flights_until: Option<u64>,
    /// Whether the models that the service has now must be added.
    pub(super) asks: bool,
}

impl ModelList {
    /// The lists of all devices in a folder. Fails if a list is damaged: without it, withdrawn models would count again.
    pub(super) fn read_all(folder: &Path) -> Result<BTreeMap<DeviceId, Self>, SceneError> {
        let entries = match fs::read_dir(folder) {
            Err(cause) if cause.kind() == ErrorKind::NotFound => return Ok(BTreeMap::new()),
            entries => entries.map_err(|cause| SceneError::io(folder, cause))?,
        };
        let mut lists = BTreeMap::new();
        for entry in entries {
            let path = entry.map_err(|cause| SceneError::io(folder, cause))?.path();
            let device = path.file_name().and_then(|name| DeviceId::new(name.to_str()?).ok());
            let Some(device) = device else { continue };
            let read = files::read(&path).map_err(|error| error.to_string());
            let text = read.and_then(|bytes| String::from_utf8(bytes).map_err(|error| error.to_string()));
            let text = text.and_then(|text| match is_damaged(&text) {
                true => Err("its hash does not match".to_owned()),
                false => Ok(text),
            });
            let text = text.map_err(|error| {
                let remedy = format!("remove it, and withdraw the device again: forget {device}");
                SceneError::malformed(
                    &path,
                    format!("the list of withdrawn models cannot be read ({error}); {remedy}"),
                )
            })?;
            lists.insert(device, Self::parse(&text));
        }
        Ok(lists)
    }

    /// The list of a device in a folder, empty if there is none.
    pub(super) fn read(folder: &Path, device: &DeviceId) -> Self {
        let bytes = files::read(&folder.join(device.as_str()));
        let text = bytes.ok().and_then(|bytes| String::from_utf8(bytes).ok());
        text.map_or_else(Self::default, |text| Self::parse(&text))
    }

    fn parse(text: &str) -> Self {
        let mut listed = Self { asks: text.trim().is_empty(), ..Self::default() };
        for line in text.lines() {
            match line.split_ascii_whitespace().collect::<Vec<_>>()[..] {
                [ASKS] => listed.asks = true,
                [number] => listed.up_to = number.parse().ok().map(ModelId).max(listed.up_to),
                [FLIGHTS, session] => listed.flights_until = session.parse().ok().max(listed.flights_until),
                [number, hash] => {
                    listed
                        .models
                        .extend(number.parse().ok().map(|number| (ModelId(number), hash.to_owned())));
                }
                _ => {}
            }
        }
        listed
    }

    /// Writes the list.
    pub(super) fn write(&self, folder: &Path, device: &DeviceId) -> Result<(), SceneError> {
        let mut text = String::new();
        let mut line = |line: std::fmt::Arguments<'_>| _ = writeln!(text, "{line}");
        if let Some(up_to) = self.up_to {
            line(format_args!("{up_to}"));
        }
        if let Some(session) = self.flights_until {
            line(format_args!("{FLIGHTS} {session}"));
        }
        let old = self.models.len().saturating_sub(MODELS_MAX);
        self.models.iter().skip(old).for_each(|(number, hash)| line(format_args!("{number} {hash}")));
        if self.asks {
            line(format_args!("{ASKS}"));
        } else if text.is_empty() {
            text.push_str("# none\n");
        }
        let check = check_line(&text);
        text.push_str(&check);
        files::create_folder(folder)?;
        atomic::write_bytes(&folder.join(device.as_str()), text.as_bytes())
    }

    /// Adds a model.
    pub(super) fn add(&mut self, header: &ModelHeader) {
        self.models.insert((header.model, header.blake3.to_string()));
    }

    /// Adds all models with a number.
    pub(super) fn add_number(&mut self, number: ModelId) {
        self.models.insert((number, ANY.to_owned()));
    }

    /// Adds another list.
    pub(super) fn add_all(&mut self, other: &Self) {
        self.models.extend(other.models.iter().cloned());
        self.up_to = self.up_to.max(other.up_to);
        self.flights_until = self.flights_until.max(other.flights_until);
    }

    /// Whether a model is listed, under whatever number it comes. `hash` is in hexadecimal digits.
    pub(super) fn has(&self, number: ModelId, hash: &str) -> bool {
        Some(number) <= self.up_to
            || self.has_number(number, |listed| listed == ANY)
            || self.models.iter().any(|(_, listed)| listed == hash)
    }

    /// Whether a part of a model is listed: its hash is not that of the model.
    pub(super) fn has_part(&self, number: ModelId) -> bool {
        Some(number) <= self.up_to || self.has_number(number, |_| true)
    }

    fn has_number(&self, number: ModelId, is_it: impl Fn(&str) -> bool) -> bool {
        let of_number =
            self.models.range((number, String::new())..).take_while(|(other, _)| *other == number);
        of_number.into_iter().any(|(_, hash)| is_it(hash))
    }
}

/// The last line of a list with these lines before it.
fn check_line(lines: &str) -> String {
    format!("{CHECK}{}\n", blake3::hash(lines.as_bytes()).to_hex())
}

/// Whether a list has another content than was written. One without a last line is of an older version, or written by hand.
fn is_damaged(text: &str) -> bool {
    text.rfind(CHECK).is_some_and(|at| check_line(&text[..at]) != text[at..])
}

/// Whether models of these lists are among the inputs of a merge.
pub(super) fn any_listed(lists: &BTreeMap<DeviceId, ModelList>, inputs: &[Input]) -> bool {
    let is_listed = |input: &Input| {
        let listed = lists.iter().find(|(device, _)| device.as_str() == input.device);
        let number = ModelId(input.model);
        // The models of a list that asks are not in it yet.
        listed.is_some_and(|(_, listed)| match input.part_splats {
            _ if listed.asks => true,
            None => listed.has(number, &input.blake3),
            Some(_) => listed.has_part(number),
        })
    };
    inputs.iter().any(is_listed)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn lists_come_back_and_those_of_version_0_1_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let device = DeviceId::new("drone-1").unwrap();
        let mut listed = ModelList::parse("7\n");
        assert!(listed.has(ModelId(7), "aa") && listed.has_part(ModelId(3)) && !listed.has(ModelId(8), "aa"));
        listed.models.insert((ModelId(u64::MAX), "bb".to_owned()));
        listed.add_number(ModelId(9));
        listed.asks = true;
        listed.flights_until = Some(1_800_000_000);
        listed.write(folder.path(), &device).unwrap();
        assert_eq!(ModelList::read(folder.path(), &device), listed);
        assert!(listed.has(ModelId(u64::MAX), "bb") && !listed.has(ModelId(u64::MAX), "cc"));
        assert!(listed.has(ModelId(12), "bb"), "the same model under another number");
        assert!(
            listed.has_part(ModelId(u64::MAX))
                && listed.has(ModelId(9), "cc")
                && !listed.has(ModelId(10), "cc")
        );
        assert!(
            ModelList::parse("").asks && !ModelList::parse("\n7").asks,
            "as `forget` of version 0.1 asks"
        );
        let path = folder.path().join(device.as_str());
        let written = fs::read(&path).unwrap();
        for place in 0..written.len() {
            let mut damaged = written.clone();
            damaged[place] ^= 1;
            fs::write(&path, damaged).unwrap();
            // Damage to the words before the hash leaves the list as it is.
            let read = ModelList::read_all(folder.path());
            assert!(read.is_err() || read.is_ok_and(|lists| lists[&device] == listed), "byte {place}");
        }
        let empty = ModelList::default();
        empty.write(folder.path(), &device).unwrap();
        assert_eq!(ModelList::read(folder.path(), &device), empty);
    }
}
