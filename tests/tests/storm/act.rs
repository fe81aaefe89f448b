//! What all attacks have in common.

use std::io;

use cosurf_tests::dice::Dice;

/// What an attacker does again and again. Returns how many messages, packets or connections that were. After an error, the
/// attacker starts anew.
pub(crate) type Act<'a> = Box<dyn FnMut(&mut Dice) -> io::Result<u64> + 'a>;
