//! What a client has sent and the broker has not acknowledged, and how much that may be.

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::v5::Publish;

use crate::transport::is_offer;

/// Maximum number of unacknowledged messages.
pub(super) const IN_FLIGHT_MAX: usize = 64;
/// Limit on the unacknowledged bytes of bulk messages on a fast line.
const BULK_BYTES_MAX: usize = 1 << 20;
/// The same limit before anything is known of the line.
const BULK_BYTES_FIRST: usize = 32 << 10;
/// While acknowledgements take less, more bulk may be in flight. So a control message waits about as long behind it.
const WAIT_WANTED: Duration = Duration::from_secs(1);

/// Largest packet id of a message. The next one is [`SUBSCRIBE_ID`].
const ID_MAX: u16 = SUBSCRIBE_ID - 1;
/// The packet id of SUBSCRIBE.
pub(super) const SUBSCRIBE_ID: u16 = u16::MAX;

/// A message with what its handling depends on.
#[derive(Clone, Debug)]
pub(super) struct Letter {
    pub(super) publish: Publish,
    /// Whether control messages overtake this message: it is a chunk.
    pub(super) is_bulk: bool,
    /// Whether it is dropped when the connection is lost, as the protocol makes up for it. To send chunks again unasked would
    /// keep a slow line busy. Old requests would fill what may be in flight: on a line that breaks each second, their
    /// acknowledgements wait behind chunks and are lost, until no new request gets through.
    pub(super) is_made_up_for: bool,
}

impl Letter {
    pub(super) fn topic(&self) -> String {
        String::from_utf8_lossy(&self.publish.topic).into_owned()
    }
}

/// The unacknowledged messages, in the order in which they were sent.
#[derive(Debug)]
pub(super) struct InFlight {
    letters: VecDeque<(Letter, Instant)>,
    /// Limit on the number of messages.
    count_max: usize,
    /// Limit on the bytes of bulk. The line shows how much it takes.
    bulk_bytes_max: usize,
    /// The shortest time that a control message of this connection took to be acknowledged. Bulk takes it too, on a line of any
    /// rate: over a satellite, a second says nothing about how much is under way.
    latency: Option<Duration>,
    last_id: u16,
}

impl InFlight {
    pub(super) fn new() -> Self {
        Self {
            letters: VecDeque::new(),
            count_max: IN_FLIGHT_MAX,
            bulk_bytes_max: BULK_BYTES_FIRST,
            latency: None,
            last_id: 0,
        }
    }

    /// Number of messages.
    pub(super) fn len(&self) -> usize {
        self.letters.len()
    }

    /// The oldest message: its payload's bytes, and when it was sent.
    pub(super) fn oldest(&self) -> Option<(usize, Instant)> {
        self.letters.front().map(|(letter, since)| (letter.publish.payload.len(), *since))
    }

    /// Whether this message may be sent now.
    pub(super) fn has_room_for(&self, letter: &Letter) -> bool {
        let bulk = self.letters.iter().filter(|(letter, _)| letter.is_bulk);
        let bulk_bytes: usize = bulk.map(|(letter, _)| letter.publish.payload.len()).sum();
        let is_within = bulk_bytes == 0 || bulk_bytes + letter.publish.payload.len() <= self.bulk_bytes_max;
        self.letters.len() < self.count_max && (is_within || !letter.is_bulk)
    }

    /// Takes a message that is sent now, and returns it with its packet id.
    pub(super) fn add(&mut self, mut letter: Letter, now: Instant) -> &Publish {
        loop {
            self.last_id = self.last_id % ID_MAX + 1;
            if self.letters.iter().all(|(letter, _)| letter.publish.pkid != self.last_id) {
                break;
            }
        }
        letter.publish.pkid = self.last_id;
        self.letters.push_back((letter, now));
        &self.letters[self.letters.len() - 1].0.publish
    }

    /// Takes an acknowledgement. Returns the message that waited for it.
    pub(super) fn acknowledge(&mut self, id: u16, now: Instant) -> Option<Publish> {
        let place = self.letters.iter().position(|(letter, _)| letter.publish.pkid == id);
        let (letter, since) = self.letters.remove(place?)?;
        let waited = now.saturating_duration_since(since);
        match letter.is_bulk {
            true => self.learn(letter.publish.payload.len(), waited),
            false => self.latency = Some(self.latency.map_or(waited, |least| least.min(waited))),
        }
        Some(letter.publish)
    }

    /// Learns from how long a bulk message waited for its acknowledgement.
    fn learn(&mut self, bytes: usize, waited: Duration) {
        let limit = self.bulk_bytes_max;
        self.bulk_bytes_max = match waited.saturating_sub(self.latency.unwrap_or_default()) {
            short if short < WAIT_WANTED => (limit + bytes).min(BULK_BYTES_MAX),
            long if long > 2 * WAIT_WANTED => limit - limit / 4,
            _ => limit,
        };
    }

    /// The topics of the bulk messages, in the order in which they were sent.
    pub(super) fn bulk_topics(&self) -> impl Iterator<Item = String> {
        self.letters.iter().filter(|(letter, _)| letter.is_bulk).map(|(letter, _)| letter.topic())
    }

    /// Begins again after the connection was lost. Returns the messages that must be sent again: those that nothing else
    /// makes up for, if the broker has kept the session. Of those that it retains, and of offers, the last of each topic is
    /// enough, and of equal messages one: on a line that breaks each second, they would fill the line. `count_max` is the
    /// broker's own limit on messages in flight.
    pub(super) fn resume(
        &mut self,
        has_session: bool,
        count_max: Option<u16>,
        now: Instant,
    ) -> impl Iterator<Item = &Publish> {
        self.letters.retain(|(letter, _)| has_session && !letter.is_made_up_for);
        self.latency = None;
        let mut newer = BTreeSet::new();
        let is_newest = |(letter, _): &(Letter, Instant)| {
            let Publish { topic, payload, retain, .. } = &letter.publish;
            let is_last_enough = *retain || str::from_utf8(topic).is_ok_and(is_offer);
            newer.insert((topic.clone(), (!is_last_enough).then(|| payload.clone())))
        };
        let kept: Vec<bool> = self.letters.iter().rev().map(is_newest).collect();
        let mut kept = kept.into_iter().rev();
        self.letters.retain(|_| kept.next().unwrap_or(true));
        self.count_max = count_max.map_or(IN_FLIGHT_MAX, |count| IN_FLIGHT_MAX.min(count.into()));
        self.letters.iter_mut().map(move |(letter, since)| {
            (letter.publish.dup, *since) = (true, now);
            &letter.publish
        })
    }
}

#[cfg(test)]
mod tests {
    use rumqttc::v5::mqttbytes::QoS;

    use super::*;

    fn control(bytes: usize) -> Letter {
        let publish = Publish::new("topic", QoS::AtLeastOnce, vec![0; bytes], None);
        Letter { publish, is_bulk: false, is_made_up_for: false }
    }

    fn chunk() -> Letter {
        Letter { is_bulk: true, is_made_up_for: true, ..control(8 << 10) }
    }

    /// The bytes of chunks of 8 KiB that are in flight once a line of this rate, in bytes per second, is known.
    fn bytes_in_flight(rate: f64) -> usize {
        let (mut flight, start) = (InFlight::new(), Instant::now());
        let mut seconds = 0.0;
        for _ in 0..500 {
            let at = start + Duration::from_secs_f64(seconds);
            while flight.has_room_for(&chunk()) {
                flight.add(chunk(), at);
            }
            seconds += 8192.0 / rate;
            let id = flight.letters[0].0.publish.pkid;
            assert!(flight.acknowledge(id, start + Duration::from_secs_f64(seconds)).is_some());
        }
        flight.letters.iter().map(|(letter, _)| letter.publish.payload.len()).sum::<usize>() + (8 << 10)
    }

    #[test]
    fn bulk_in_flight_follows_the_line() {
        assert_eq!(bytes_in_flight(1e3), 8 << 10);
        assert_eq!(bytes_in_flight(1e8), IN_FLIGHT_MAX * (8 << 10));
        // A line of 50 kB/s carries what is in flight in one to two seconds.
        let bytes = bytes_in_flight(5e4);
        assert!((50_000..115_000).contains(&bytes), "{bytes}");
    }

    /// Over a satellite, acknowledgements take seconds however little is under way.
    #[test]
    fn bulk_in_flight_does_not_shrink_because_of_latency() {
        let (mut flight, start) = (InFlight::new(), Instant::now());
        let latency = Duration::from_secs(4);
        let id = flight.add(control(100), start).pkid;
        flight.acknowledge(id, start + latency);
        let mut at = start + latency;
        for _ in 0..20 {
            let sent: Vec<u16> =
                std::iter::from_fn(|| flight.has_room_for(&chunk()).then(|| flight.add(chunk(), at).pkid))
                    .collect();
            at += latency;
            sent.into_iter().for_each(|id| drop(flight.acknowledge(id, at)));
        }
        assert!(flight.bulk_bytes_max > BULK_BYTES_FIRST, "{}", flight.bulk_bytes_max);
    }

    #[test]
    fn control_passes_while_bulk_waits() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        while flight.has_room_for(&chunk()) {
            flight.add(chunk(), now);
        }
        assert_eq!(flight.len() * (8 << 10), BULK_BYTES_FIRST);
        assert!(flight.has_room_for(&control(100)));
    }

    #[test]
    fn ids_in_use_are_not_given_twice() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let first = flight.add(control(1), now).pkid;
        for _ in 0..70_000 {
            let id = flight.add(control(1), now).pkid;
            assert!(id != 0 && id != first);
            assert!(flight.acknowledge(id, now).is_some() && flight.acknowledge(id, now).is_none());
        }
    }

    #[test]
    fn after_a_lost_connection_control_is_sent_again_and_chunks_and_requests_are_not() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let id = flight.add(control(100), now).pkid;
        flight.add(chunk(), now);
        flight.add(Letter { is_made_up_for: true, ..control(50) }, now);
        let again: Vec<_> =
            flight.resume(true, Some(3), now).map(|message| (message.pkid, message.dup)).collect();
        assert_eq!(again, [(id, true)]);
        assert_eq!((flight.len(), flight.count_max), (1, 3));
        assert_eq!(flight.resume(false, None, now).count(), 0);
    }

    #[test]
    fn of_retained_messages_only_the_last_of_a_topic_is_sent_again() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let of = |topic: &str, retain| {
            let mut letter = control(10);
            (letter.publish.topic, letter.publish.retain) = (topic.to_owned().into(), retain);
            letter
        };
        let ids: Vec<u16> =
            [("state", true), ("done", false), ("header", true), ("done", false), ("state", true)]
                .map(|(topic, retain)| flight.add(of(topic, retain), now).pkid)
                .into();
        let again: Vec<u16> = flight.resume(true, None, now).map(|message| message.pkid).collect();
        // Of the two equal messages, the later one.
        assert_eq!(again, ids[2..]);
    }

    #[test]
    fn of_offers_the_last_is_sent_again_and_of_others_each_that_differs() {
        let (mut flight, now) = (InFlight::new(), Instant::now());
        let mut add = |topic: &str, payload: &'static str| {
            let mut letter = control(0);
            (letter.publish.topic, letter.publish.payload) = (topic.to_owned().into(), payload.into());
            flight.add(letter, now).pkid
        };
        let [_, second] = ["1", "2"].map(|payload| add("gs/v1/site/drone/up/1/m", payload));
        let others = ["1", "2"].map(|payload| add("gs/v1/site/drone/dn/done", payload));
        let again: Vec<u16> = flight.resume(true, None, now).map(|message| message.pkid).collect();
        assert_eq!(again, [second, others[0], others[1]]);
    }
}
