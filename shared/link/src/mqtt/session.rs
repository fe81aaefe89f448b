//! What a client has sent and the broker has not acknowledged, and how much that may be.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::v5::Publish;

/// Maximum number of unacknowledged messages: 16 chunks of 64 KiB are 1 MiB.
pub(super) const IN_FLIGHT_MAX: usize = 16;
/// Limit on the unacknowledged bytes of bulk messages on a fast line.
const BULK_BYTES_MAX: usize = 1 << 20;
/// The same limit before anything is known of the line.
const BULK_BYTES_FIRST: usize = 128 << 10;
/// While acknowledgements take less, more bulk may be in flight. So a control message waits about as long behind it.
const WAIT_WANTED: Duration = Duration::from_secs(1);
/// Larger messages are bulk, unless the broker retains them: chunks.
const CONTROL_BYTES_MAX: usize = 4096;

/// Largest packet id of a message. The next one is [`SUBSCRIBE_ID`].
const ID_MAX: u16 = SUBSCRIBE_ID - 1;
/// The packet id of SUBSCRIBE.
pub(super) const SUBSCRIBE_ID: u16 = u16::MAX;

/// Whether control messages overtake this message, and whether it is left out after the connection was lost: the
/// protocol asks for missing chunks, and to send them again unasked would keep a slow line busy.
pub(super) fn is_bulk(message: &Publish) -> bool {
    !message.retain && message.payload.len() > CONTROL_BYTES_MAX
}

/// The unacknowledged messages, in the order in which they were sent.
#[derive(Debug)]
pub(super) struct InFlight {
    messages: VecDeque<(Publish, Instant)>,
    /// Limit on the number of messages.
    count_max: usize,
    /// Limit on the bytes of bulk. The line shows how much it takes.
    bulk_bytes_max: usize,
    last_id: u16,
}

impl InFlight {
    pub(super) fn new() -> Self {
        Self {
            messages: VecDeque::new(),
            count_max: IN_FLIGHT_MAX,
            bulk_bytes_max: BULK_BYTES_FIRST,
            last_id: 0,
        }
    }

    /// Number of messages.
    pub(super) fn len(&self) -> usize {
        self.messages.len()
    }

    /// The oldest message: its payload's bytes, and when it was sent.
    pub(super) fn oldest(&self) -> Option<(usize, Instant)> {
        self.messages.front().map(|(message, since)| (message.payload.len(), *since))
    }

    /// Whether this message may be sent now.
    pub(super) fn has_room_for(&self, message: &Publish) -> bool {
        let bulk = self.messages.iter().filter(|(message, _)| is_bulk(message));
        let bulk_bytes: usize = bulk.map(|(message, _)| message.payload.len()).sum();
        let is_within = bulk_bytes == 0 || bulk_bytes + message.payload.len() <= self.bulk_bytes_max;
        self.messages.len() < self.count_max && (is_within || !is_bulk(message))
    }

    /// Takes a message that is sent now, and returns it with its packet id.
    pub(super) fn add(&mut self, mut message: Publish, now: Instant) -> &Publish {
        loop {
            self.last_id = self.last_id % ID_MAX + 1;
            if self.messages.iter().all(|(message, _)| message.pkid != self.last_id) {
                break;
            }
        }
        message.pkid = self.last_id;
        self.messages.push_back((message, now));
        &self.messages[self.messages.len() - 1].0
    }

    /// Takes an acknowledgement. Returns whether a message waited for it.
    pub(super) fn acknowledge(&mut self, id: u16, now: Instant) -> bool {
        let Some(place) = self.messages.iter().position(|(message, _)| message.pkid == id) else {
            return false;
        };
        if let Some((message, since)) = self.messages.remove(place).filter(|(message, _)| is_bulk(message)) {
            self.learn(message.payload.len(), now.saturating_duration_since(since));
        }
        true
    }

    /// Learns from how long a bulk message waited for its acknowledgement.
    fn learn(&mut self, bytes: usize, waited: Duration) {
        let limit = self.bulk_bytes_max;
        self.bulk_bytes_max = match waited {
            short if short < WAIT_WANTED => (limit + bytes).min(BULK_BYTES_MAX),
            long if long > 2 * WAIT_WANTED => limit - limit / 4,
            _ => limit,
        };
    }

    /// Begins again after the connection was lost. Returns the messages that must be sent again: control messages, if
    /// the broker has kept the session. `count_max` is the broker's own limit on messages in flight.
    pub(super) fn resume(
        &mut self,
        has_session: bool,
        count_max: Option<u16>,
        now: Instant,
    ) -> impl Iterator<Item = &Publish> {
        self.messages.retain(|(message, _)| has_session && !is_bulk(message));
        self.count_max = count_max.map_or(IN_FLIGHT_MAX, |count| IN_FLIGHT_MAX.min(count.into()));
        self.bulk_bytes_max = BULK_BYTES_FIRST;
        self.messages.iter_mut().map(move |(message, since)| {
            (message.dup, *since) = (true, now);
            &*message
        })
    }
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::QoS;

    use super::*;

    fn message(bytes: usize) -> Publish {
        Publish::new("topic", QoS::AtLeastOnce, vec![0; bytes], None)
    }

    /// The bytes of chunks of 64 KiB that are in flight once a line of this rate, in bytes per second, is known.
    fn bytes_in_flight(rate: f64) -> usize {
        let (mut flight, start) = (InFlight::new(), Instant::now());
        let mut seconds = 0.0;
        for _ in 0..200 {
            let at = start + Duration::from_secs_f64(seconds);
            while flight.has_room_for(&message(64 << 10)) {
                flight.add(message(64 << 10), at);
            }
            seconds += 65536.0 / rate;
            let id = flight.messages[0].0.pkid;
            assert!(flight.acknowledge(id, start + Duration::from_secs_f64(seconds)));
        }
        flight.messages.iter().map(|(message, _)| message.payload.len()).sum::<usize>() + (64 << 10)
    }

    #[test]
    fn bulk_in_flight_follows_the_line() {
        assert_eq!(bytes_in_flight(5e3), 64 << 10);
        assert_eq!(bytes_in_flight(1e8), 1 << 20);
        // A line of 200 kB/s carries what is in flight in one to two seconds.
        let bytes = bytes_in_flight(2e5);
        assert!((200_000..450_000).contains(&bytes), "{bytes}");
    }

    #[test]
    fn control_passes_while_bulk_waits() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        flight.add(message(64 << 10), now);
        flight.add(message(64 << 10), now);
        assert!(!flight.has_room_for(&message(64 << 10)));
        assert!(flight.has_room_for(&message(100)));
    }

    #[test]
    fn ids_in_use_are_not_given_twice() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let first = flight.add(message(1), now).pkid;
        for _ in 0..70_000 {
            let id = flight.add(message(1), now).pkid;
            assert!(id != 0 && id != first);
            assert!(flight.acknowledge(id, now) && !flight.acknowledge(id, now));
        }
    }

    #[test]
    fn after_a_lost_connection_control_is_sent_again_and_bulk_is_not() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let id = flight.add(message(100), now).pkid;
        flight.add(message(64 << 10), now);
        let again: Vec<_> =
            flight.resume(true, Some(3), now).map(|message| (message.pkid, message.dup)).collect();
        assert_eq!(again, [(id, true)]);
        assert_eq!((flight.len(), flight.count_max), (1, 3));
        assert_eq!(flight.resume(false, None, now).count(), 0);
    }
}
