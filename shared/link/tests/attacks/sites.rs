//! Messages that were recorded at another site whose participants have the same names and keys.

use std::time::Duration;

use cosurf_link::NodeEvent;
use cosurf_tests::keys::Signer;
use cosurf_tests::offers::offer;
use cosurf_tests::stranger::Stranger;
use cosurf_wire::{Message, ModelKind, SiteId, State, Topic};

use crate::site::{keyed_site, network, pass};

/// A signature holds for the site in the topic that was signed.
#[test]
fn a_message_signed_for_another_site_does_not_count() {
    let network = network();
    let mut fleet = keyed_site(&network);
    let mut stranger = Stranger::new(&network);
    let header = offer("drone-1", 1, ModelKind::Local, 1, 100, 1024).header;
    let state = State { device: header.device, session: 50, alive: true };
    let messages = [
        (Topic::State { device: header.device }, Message::State(state)),
        (Topic::LocalHeader { device: header.device, model: header.model }, Message::Header(header)),
    ];
    let counts = |event: &&NodeEvent| match event {
        NodeEvent::State(state) => state.session == 50,
        NodeEvent::Receiving(_) => true,
        _ => false,
    };
    for (signed_for, counted) in [("other", 0), ("site", 2)] {
        for (topic, message) in &messages {
            let signed = topic.to_text(&SiteId::new(signed_for).unwrap());
            let payload = Signer::of("drone-1").seal(&signed, message, 50, 1);
            stranger.say_bytes(&topic.to_text(&SiteId::new("site").unwrap()), payload);
        }
        pass(&network, &mut fleet, &mut stranger, Duration::from_secs(1));
        assert_eq!(fleet[0].events.iter().filter(counts).count(), counted, "signed for {signed_for}");
        assert_eq!(fleet[0].node.forged(), 2);
    }
}
