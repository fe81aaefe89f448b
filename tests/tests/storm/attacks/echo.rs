//! What genuine participants have said, heard and said again.

use std::io;

use cosurf_tests::dice::Dice;
use cosurf_tests::mqtt::{publish, subscribe};

use crate::act::Act;
use crate::field::Field;

/// Reads everything, and remembers what is genuine.
pub(super) fn listen<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let mut line = field.join(&format!("listener-{}", dice.bits()))?;
    line.send(&subscribe("gs/v1/#"))?;
    Ok(Box::new(move |_| {
        let messages = line.messages()?;
        let count = messages.len() as u64;
        messages.into_iter().for_each(|(topic, payload)| field.hear(topic, payload));
        Ok(count)
    }))
}

/// Repeats genuine messages of this mission and of earlier ones, retained or not.
pub(super) fn replay<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let mut line = field.join(&format!("replay-{}", dice.bits()))?;
    Ok(Box::new(move |dice| {
        line.discard()?;
        let Some((topic, payload)) = field.echo(dice) else { return Ok(0) };
        line.send(&publish(&topic, &payload, 0, dice.below(4) == 0, &[]))?;
        Ok(1)
    }))
}
