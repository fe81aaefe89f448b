//! The way to a broker or a radio.

use std::time::{Duration, Instant};

use cosurf_link::{Transport, TransportEvent};

use super::Finding;

/// How long a connection may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// What it means if the other end does not answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Silence {
    /// It does not work: a broker always answers.
    Fault,
    /// It may be out of reach now: a radio on the ground.
    Possible,
}

/// Waits until the transport is connected, or tells why it is not. `to` names the other end.
pub fn check(name: &'static str, to: &str, silence: Silence, transport: &mut impl Transport) -> Finding {
    let end = Instant::now() + CONNECT_TIMEOUT;
    while let Some(left) = end.checked_duration_since(Instant::now()) {
        match transport.poll(left) {
            Some(TransportEvent::Connected) => return Finding::ok(name, format!("{to}: connected")),
            Some(TransportEvent::Disconnected { reason, .. } | TransportEvent::Denied { reason }) => {
                let remedy = "check the address, and that the other end runs and lets this one in";
                return Finding::mend(name, reason, remedy);
            }
            Some(TransportEvent::Incoming { .. }) | None => {}
        }
    }
    let found = format!("{to}: no answer after {} s", CONNECT_TIMEOUT.as_secs());
    match silence {
        Silence::Fault => Finding::mend(name, found, "check the address, the network and the firewall"),
        Silence::Possible => {
            Finding::note(name, found, "start the ground station with its radio to check the line")
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::{Outgoing, PublishError};

    use super::*;

    /// A line on which one thing happens.
    struct Once(Option<TransportEvent>);

    impl Transport for Once {
        fn publish(&mut self, _: &Outgoing) -> Result<(), PublishError> {
            Ok(())
        }

        fn poll(&mut self, _: Duration) -> Option<TransportEvent> {
            self.0.take()
        }
    }

    #[test]
    fn the_reason_of_a_failure_is_told() {
        let connected =
            check("broker", "mqtt://h:1", Silence::Fault, &mut Once(Some(TransportEvent::Connected)));
        assert_eq!(connected, Finding::ok("broker", "mqtt://h:1: connected"));
        let reason = "mqtt://h:1: connection refused".to_owned();
        let lost = TransportEvent::Disconnected { attempt: 1, reason: reason.clone() };
        let finding = check("broker", "", Silence::Possible, &mut Once(Some(lost)));
        assert!(finding.is_fault() && finding.to_string().contains(&reason), "{finding}");
    }
}
