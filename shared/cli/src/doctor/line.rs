//! The way to a broker or a radio.

use std::time::{Duration, Instant};

use cosurf_link::{MqttConfig, Transport, TransportEvent, probe};

use super::Finding;

/// How long a radio may take to answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// Tries whether a broker lets a participant in. What the broker keeps for the participant stays.
pub fn broker(name: &'static str, config: MqttConfig) -> Finding {
    let to = config.broker.to_string();
    match probe(config) {
        Ok(()) => Finding::ok(name, format!("{to}: connected")),
        Err(reason) => Finding::failed(name, reason),
    }
}

/// Waits until a radio at the port `to` is answered, or tells why it is not. The other end may be out of reach now.
pub fn radio(name: &'static str, to: &str, transport: &mut impl Transport) -> Finding {
    let end = Instant::now() + ANSWER_TIMEOUT;
    while let Some(left) = end.checked_duration_since(Instant::now()) {
        match transport.poll(left) {
            Some(TransportEvent::Connected | TransportEvent::Resumed { .. }) => {
                return Finding::ok(name, format!("{to}: connected"));
            }
            Some(TransportEvent::Disconnected { reason, .. } | TransportEvent::Denied { reason }) => {
                return Finding::failed(name, reason);
            }
            Some(TransportEvent::Incoming { .. }) | None => {}
        }
    }
    let found = format!("{to}: no answer after {} s", ANSWER_TIMEOUT.as_secs());
    Finding::note(name, found, "start the ground station with its radio to check the line")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::net::TcpListener;

    use cosurf_link::{BrokerAddress, Identity, Outgoing, PublishError, Role};
    use cosurf_wire::{DeviceId, SiteId};

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
        let connected = radio("line", "/dev/radio", &mut Once(Some(TransportEvent::Connected)));
        assert_eq!(connected, Finding::ok("line", "/dev/radio: connected"));
        let reason = "/dev/radio: no such port".to_owned();
        let lost = TransportEvent::Disconnected { attempt: 1, reason: reason.clone() };
        let finding = radio("line", "", &mut Once(Some(lost)));
        assert!(finding.is_fault() && finding.to_string().contains(&reason), "{finding}");
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let (site, device) = (SiteId::new("site").unwrap(), DeviceId::new("drone").unwrap());
        let identity = Identity { site, device, session: 1, role: Role::Device };
        let address = BrokerAddress::plain("127.0.0.1", free.port());
        let config = MqttConfig { broker: address, identity, will: None, tls: None, login: None };
        let finding = broker("broker", config);
        assert!(finding.is_fault() && finding.to_string().contains("connection refused"), "{finding}");
    }
}
