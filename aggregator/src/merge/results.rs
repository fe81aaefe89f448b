//! The results of tiles, kept in a store under the hash of their tasks.

use std::collections::BTreeSet;
use std::mem::size_of;
use std::ops::Range;

use blake3::Hash;
use bytes::Bytes;
use cosurf_scene::Splats;
use serde::{Deserialize, Serialize};

use super::error::MergeError;
use super::expected::Expected;
use crate::scratch::numbers;
use crate::store::{ObjectError, Store};

/// Places of the parts of a result: the hash of all that follows, the number of splats, their numbers.
const HASH: Range<usize> = 0..32;
const COUNT: Range<usize> = 32..40;

/// A tile of a global model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileRecord {
    /// Hash of what the tile was distilled from, as hexadecimal digits: the name of the result in its store.
    pub task: String,
    /// Hash of the tile's splats, as hexadecimal digits.
    pub blake3: String,
    /// Number of splats.
    pub splats: usize,
}

impl TileRecord {
    /// The record of a distilled tile.
    pub(super) fn of(task: &Hash, learnt: &Splats) -> Self {
        let mut hasher = blake3::Hasher::new();
        for values in numbers(learnt) {
            hasher.update(bytemuck::cast_slice(values));
        }
        let blake3 = hasher.finalize().to_hex().to_string();
        Self { task: task.to_hex().to_string(), blake3, splats: learnt.len() }
    }
}

/// What a store has as the result of a task.
#[derive(Debug)]
pub(super) enum Found {
    Nothing,
    Sound(Splats),
    /// Something else, which distillation did not write. The text says why.
    Bad(String),
}

/// Looks for the result of a task. Whoever can write to the store may have written it.
pub(super) fn find(store: &Store, expected: &Expected) -> Result<Found, ObjectError> {
    let name = expected.task.to_hex();
    let Some(bytes) = store.size(&name)? else { return Ok(Found::Nothing) };
    let each = 11 + Splats::with_capacity(0, expected.sh_degree).sh_stride();
    let most = COUNT.end + expected.splats_max() * each * size_of::<f32>();
    if !(COUNT.end as u64..=most as u64).contains(&bytes) {
        return Ok(Found::Bad(format!("it has {bytes} bytes, and can have {} to {most}", COUNT.end)));
    }
    let Some(object) = store.get_range(&name, 0..bytes)? else { return Ok(Found::Nothing) };
    let Some(splats) = decoded(&object, expected.sh_degree) else {
        return Ok(Found::Bad("it is damaged".to_owned()));
    };
    Ok(match expected.check(&splats) {
        Ok(()) => Found::Sound(splats),
        Err(reason) => Found::Bad(reason),
    })
}

/// Keeps the result of a task.
pub(super) fn keep(store: &Store, task: &Hash, learnt: &Splats) -> Result<(), ObjectError> {
    store.put(&task.to_hex(), encoded(learnt))
}

/// Removes all results but those of these tiles.
pub fn keep_only(store: &Store, tiles: &[TileRecord]) -> Result<(), MergeError> {
    let wanted: BTreeSet<&str> = tiles.iter().map(|tile| tile.task.as_str()).collect();
    Ok(store.keep_only(|name| wanted.contains(name))?)
}

fn encoded(splats: &Splats) -> Bytes {
    let numbers = numbers(splats);
    let values: usize = numbers.iter().map(|values| values.len()).sum();
    let mut bytes = Vec::with_capacity(COUNT.end + values * size_of::<f32>());
    bytes.resize(HASH.end, 0);
    bytes.extend((splats.len() as u64).to_le_bytes());
    numbers.into_iter().flatten().for_each(|value| bytes.extend(value.to_le_bytes()));
    let hash = blake3::hash(&bytes[HASH.end..]);
    bytes[HASH].copy_from_slice(hash.as_bytes());
    bytes.into()
}

/// `None` if the bytes are not those of [`encoded`] splats of this degree of spherical harmonics.
fn decoded(bytes: &[u8], sh_degree: u32) -> Option<Splats> {
    let hash: [u8; 32] = bytes.get(HASH)?.try_into().ok()?;
    if Hash::from_bytes(hash) != blake3::hash(&bytes[HASH.end..]) {
        return None;
    }
    let count = u64::from_le_bytes(bytes.get(COUNT)?.try_into().ok()?);
    let mut splats = Splats::with_capacity(0, sh_degree);
    let each = 11 + splats.sh_stride();
    let (values, rest) = bytes[COUNT.end..].as_chunks();
    let count = usize::try_from(count).ok().filter(|count| count.checked_mul(each) == Some(values.len()))?;
    if !rest.is_empty() {
        return None;
    }
    let mut values = values.iter().map(|bytes| f32::from_le_bytes(*bytes));
    let mut take = |count: usize| values.by_ref().take(count).collect::<Vec<f32>>();
    let (means, quats, log_scales) = (take(3 * count), take(4 * count), take(3 * count));
    splats.means = means.as_chunks().0.to_vec();
    splats.quats = quats.as_chunks().0.to_vec();
    splats.log_scales = log_scales.as_chunks().0.to_vec();
    splats.opacity_logits = take(count);
    splats.sh = take(count * splats.sh_stride());
    Some(splats)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::ground;

    #[test]
    fn splats_come_back_and_damage_is_noticed() {
        let splats = ground(0.0, 3.0);
        let bytes = encoded(&splats);
        assert_eq!(decoded(&bytes, splats.sh_degree).unwrap(), splats);
        assert_eq!(decoded(&bytes, splats.sh_degree + 1), None, "another degree");
        for len in [0, 31, 39, bytes.len() - 1] {
            assert_eq!(decoded(&bytes[..len], splats.sh_degree), None, "{len} bytes");
        }
        for place in [0, 32, 39, 40, bytes.len() - 1] {
            let mut damaged = bytes.to_vec();
            damaged[place] ^= 1;
            assert_eq!(decoded(&damaged, splats.sh_degree), None, "byte {place}");
        }
        let none = encoded(&Splats::default());
        assert_eq!(decoded(&none, 0).unwrap(), Splats::default());
    }
}
