//! Attacks at the broker's door.

use std::collections::VecDeque;
use std::io;

use cosurf_link::{Identity, Role};
use cosurf_tests::dice::Dice;
use cosurf_tests::mqtt::{Hello, connect};
use cosurf_wire::{DeviceId, SiteId};

use crate::act::Act;
use crate::field::{Field, GROUND, SITE, device};
use crate::line::Line;

/// Connections that an attacker keeps open.
const KEPT: usize = 300;

/// Sockets that send nothing, or one byte of CONNECT now and then.
pub(super) fn drips<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    let hello = connect(&Hello { id: "drip", ..Hello::default() });
    let mut drips: VecDeque<(Line, usize)> = VecDeque::new();
    Ok(Box::new(move |dice| {
        for _ in 0..10 {
            drips.push_back((Line::silent(field.address)?, dice.below(2)));
        }
        // Every other socket never sends anything.
        drips.retain_mut(|(line, sent)| {
            if *sent == 0 {
                return true;
            }
            *sent += 1;
            line.send(&hello[*sent - 2..*sent - 1]).is_ok() && *sent < hello.len()
        });
        drips.drain(..drips.len().saturating_sub(KEPT));
        Ok(10)
    }))
}

/// Clients that connect and then do nothing. For some seconds they take all places, then they leave them to the other
/// attackers for a while.
pub(super) fn idle_clients<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    let (mut kept, mut acts): (VecDeque<Line>, u64) = (VecDeque::new(), 0);
    Ok(Box::new(move |dice| {
        let mut done = 0;
        acts += 1;
        if acts % 100 > 60 {
            kept.clear();
            return Ok(0);
        }
        for _ in 0..10 {
            let id = format!("idle-{}", dice.bits());
            let hello = Hello { id: &id, keep_alive_s: 0, login: field.login, ..Hello::default() };
            // Refused once all places are taken.
            if let Ok(line) = Line::open(field.address, &hello) {
                kept.push_back(line);
                done += 1;
            }
        }
        kept.drain(..kept.len().saturating_sub(KEPT));
        Ok(done)
    }))
}

/// Bytes of other protocols, packets before CONNECT, wrong passwords and lengths.
pub(super) fn junk<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    Ok(Box::new(move |dice| {
        let mut line = Line::silent(field.address)?;
        let wrong = Hello { id: "x", login: Some(("ground", "wrong")), ..Hello::default() };
        let mut bytes = match dice.below(5) {
            0 => b"GET / HTTP/1.1\r\n\r\n".to_vec(),
            1 => vec![0x16, 3, 1, 2, 0, 1, 0, 1, 0xFC, 3, 3],
            2 => [&connect(&wrong)[..], &[0x30, 0xFF, 0xFF, 0xFF, 0x7F]].concat(),
            3 => (0..200).map(|_| dice.bits() as u8).collect(),
            _ => connect(&wrong),
        };
        if dice.coin() {
            let place = dice.below(bytes.len());
            bytes[place] ^= 1 << dice.below(8);
        }
        let _ = line.send(&bytes);
        Ok(1)
    }))
}

/// A client with the client id of a drone that flies: the broker sends the drone away.
pub(super) fn take_over_drones<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    Ok(Box::new(move |dice| take_over(field, field.victim(dice), Role::Device)))
}

/// A client with the client id of the aggregator.
pub(super) fn take_over_ground<'a>(field: &'a Field, _: &mut Dice) -> io::Result<Act<'a>> {
    Ok(Box::new(move |_| take_over(field, device(GROUND), Role::Aggregator)))
}

fn take_over(field: &Field, device: DeviceId, role: Role) -> io::Result<u64> {
    let id = Identity { site: SiteId::new(SITE).unwrap(), device, session: 0, role }.client_id();
    let hello = Hello { id: &id, clean: true, login: field.login, ..Hello::default() };
    Line::open(field.address, &hello).map(|_| 1)
}
