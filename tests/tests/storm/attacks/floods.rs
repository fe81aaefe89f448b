//! Floods of the broker.

use std::io;

use cosurf_tests::dice::Dice;
use cosurf_tests::mqtt::{AN_HOUR, Hello, publish, subscribe};

use crate::act::Act;
use crate::field::Field;
use crate::line::Line;

/// Small and some large retained messages, under ever new topics and now and then a new name.
pub(super) fn retained<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let mut line = field.join(&format!("flood-{}", dice.below(1000)))?;
    let mut acts = 0;
    Ok(Box::new(move |dice| {
        acts += 1;
        if acts % 50 == 0 {
            line = field.join(&format!("flood-{}", dice.below(1000)))?;
        }
        let topic = |dice: &mut Dice| format!("flood/{}", dice.bits());
        let mut bytes: Vec<u8> = (0..50).flat_map(|_| publish(&topic(dice), &[7; 8], 0, true, &[])).collect();
        bytes.extend(publish(&topic(dice), &[7; 20_000], 0, true, &[]));
        line.send(&bytes)?;
        line.discard()?;
        Ok(51)
    }))
}

/// Clients that subscribe to everything and go, with sessions that last.
pub(super) fn absent_sessions<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    Ok(Box::new(move |dice| {
        let id = format!("ghost-{}", dice.below(200));
        let (properties, login) = (&AN_HOUR[..], field.login);
        let hello = Hello { id: &id, properties, clean: false, login, ..Hello::default() };
        let mut line = Line::open(field.address, &hello)?;
        line.send(&subscribe("#"))?;
        Ok(1)
    }))
}

/// 600 subscriptions to everything that is retained.
pub(super) fn subscriptions<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let id = format!("subscriber-{}", dice.bits());
    Ok(Box::new(move |_| {
        let mut line = field.join(&id)?;
        let filters = ["#", "flood/#", "gs/v1/#", "+/+"];
        let bytes: Vec<u8> = (0..600).flat_map(|place| subscribe(filters[place % 4])).collect();
        line.send(&bytes)?;
        Ok(600)
    }))
}

/// A client that subscribes to everything and reads nothing.
pub(super) fn slow_subscriber<'a>(field: &'a Field, dice: &mut Dice) -> io::Result<Act<'a>> {
    let mut line = field.join(&format!("slow-{}", dice.bits()))?;
    line.send(&subscribe("#"))?;
    Ok(Box::new(move |_| {
        line.send(&[0xC0, 0])?; // PINGREQ
        Ok(1)
    }))
}
