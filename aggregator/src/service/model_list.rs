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
/// Before the BLAKE3 hash of the device's name and all other lines.
const CHECK: &str = "# check ";
/// In the place of a hash: all models with the number.
const ANY: &str = "any";

/// Models of one device.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct ModelList {
    /// Numbers and hashes in hexadecimal digits, or [`ANY`].
    models: BTreeSet<(ModelId, String)>,
    /// The device's flights of sessions up to this one are withdrawn, too.
    pub(super) flights_until: Option<u64>,
    /// Whether the models that the service has now must be added.
    pub(super) asks: bool,
}

impl ModelList {
    /// The lists of all devices in a folder. Fails if a list is damaged or of version 0.1, which had no hashes: without it,
    /// withdrawn models would count again, and with another one, models that nobody has withdrawn would not.
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
            let list = Self::read_from(&path, &device).map_err(|error| {
                let remedy = format!("remove it, and withdraw the device again: forget {device}");
                SceneError::malformed(
                    &path,
                    format!("the list of withdrawn models cannot be read ({error}); {remedy}"),
                )
            })?;
            lists.insert(device, list);
        }
        Ok(lists)
    }

    /// The list of a device in a folder, empty if there is none or it is damaged.
    pub(super) fn read(folder: &Path, device: &DeviceId) -> Self {
        Self::read_from(&folder.join(device.as_str()), device).unwrap_or_default()
    }

    fn read_from(path: &Path, device: &DeviceId) -> Result<Self, String> {
        let bytes = files::read(path).map_err(|error| error.to_string())?;
        let text = String::from_utf8(bytes).map_err(|error| error.to_string())?;
        match text.rfind(CHECK).map(|at| text.split_at(at)) {
            Some((lines, check)) if check == check_line(device, lines) => Ok(Self::parse(lines)),
            Some(_) => Err("its hash does not match".to_owned()),
            None => Err("it has no hash".to_owned()),
        }
    }

    fn parse(lines: &str) -> Self {
        let mut listed = Self::default();
        for line in lines.lines() {
            match line.split_ascii_whitespace().collect::<Vec<_>>()[..] {
                [ASKS] => listed.asks = true,
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
        if let Some(session) = self.flights_until {
            line(format_args!("{FLIGHTS} {session}"));
        }
        let old = self.models.len().saturating_sub(MODELS_MAX);
        self.models.iter().skip(old).for_each(|(number, hash)| line(format_args!("{number} {hash}")));
        if self.asks {
            line(format_args!("{ASKS}"));
        }
        let check = check_line(device, &text);
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
        self.flights_until = self.flights_until.max(other.flights_until);
    }

    /// Whether a model is listed, under whatever number it comes. `hash` is in hexadecimal digits.
    pub(super) fn has(&self, number: ModelId, hash: &str) -> bool {
        self.has_number(number, |listed| listed == ANY)
            || self.models.iter().any(|(_, listed)| listed == hash)
    }

    /// Whether a part of a model is listed: its hash is not that of the model.
    pub(super) fn has_part(&self, number: ModelId) -> bool {
        self.has_number(number, |_| true)
    }

    fn has_number(&self, number: ModelId, is_it: impl Fn(&str) -> bool) -> bool {
        let of_number =
            self.models.range((number, String::new())..).take_while(|(other, _)| *other == number);
        of_number.into_iter().any(|(_, hash)| is_it(hash))
    }
}

/// The last line of a device's list with these lines before it.
fn check_line(device: &DeviceId, lines: &str) -> String {
    format!("{CHECK}{}\n", blake3::hash(format!("{device}\n{lines}").as_bytes()).to_hex())
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
    fn lists_come_back_unless_they_are_damaged() {
        let folder = tempfile::tempdir().unwrap();
        let [device, other] = ["drone-1", "drone-2"].map(|name| DeviceId::new(name).unwrap());
        let mut listed = ModelList::default();
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
        let path = folder.path().join(device.as_str());
        let written = fs::read(&path).unwrap();
        assert_eq!(ModelList::read_all(folder.path()).unwrap(), [(device, listed.clone())].into());
        let refuses = |bytes: &[u8], what: &str| {
            fs::write(&path, bytes).unwrap();
            let error = ModelList::read_all(folder.path()).expect_err(what).to_string();
            assert!(error.contains("withdraw the device again: forget drone-1"), "{what}: {error}");
            assert_eq!(ModelList::read(folder.path(), &device), ModelList::default(), "{what}");
        };
        for place in 0..written.len() {
            let mut damaged = written.clone();
            damaged[place] ^= 1;
            refuses(&damaged, &format!("byte {place}"));
            refuses(&written[..place], &format!("cut after {place} bytes"));
        }
        refuses(b"7\n", "a list of version 0.1, or the number of a session");
        listed.write(folder.path(), &other).unwrap();
        refuses(&fs::read(folder.path().join(other.as_str())).unwrap(), "another device's");
        let empty = ModelList::default();
        empty.write(folder.path(), &device).unwrap();
        assert_eq!(ModelList::read(folder.path(), &device), empty);
    }
}
