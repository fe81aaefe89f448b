//! Asks a broker whether another program is connected as a device, by the device's retained birth and death notices.

use std::time::Duration;

use cosurf_wire::{Message, Sealed, Topic};
use rumqttc::v5::mqttbytes::v5::{Packet, PingReq};
use tokio::time::timeout;

use super::MqttConfig;
use super::connection::Connection;
use super::fault::Fault;
use super::probe::{block_on, leave};
use super::settings::ClientSettings;
use super::worker::is_granted;

/// Time for the broker to send what it keeps.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// Whether the broker counts a device as connected: a program that uses its name, or one that has crashed so lately that the
/// broker has not noticed. The notice is taken as it is, signed or not. Connects under a client id of its own, so that the
/// other program stays connected. An error is the reason, with the remedy.
pub fn is_present(config: MqttConfig) -> Result<bool, String> {
    let settings = config.into_presence_client();
    block_on(&settings, look(&settings))
}

async fn look(settings: &ClientSettings) -> Result<bool, Fault> {
    let (mut connection, _) = Connection::open(settings, false).await?;
    connection.queue(&settings.subscription());
    let found = timeout(ANSWER_TIMEOUT, await_notice(&mut connection)).await.unwrap_or(Err(Fault::NoAnswer));
    leave(&mut connection, None).await;
    found
}

/// Waits for the notice, or for the answer to a ping that was sent after the subscription: then there is none.
async fn await_notice(connection: &mut Connection) -> Result<bool, Fault> {
    loop {
        match connection.next_packet()? {
            Some(Packet::SubAck(ack)) if is_granted(&ack) => connection.queue(&Packet::PingReq(PingReq)),
            Some(Packet::SubAck(_)) => return Err(Fault::Subscriptions),
            Some(Packet::Publish(message)) => return Ok(is_alive(&message.topic, &message.payload)),
            Some(Packet::PingResp(_)) => return Ok(false),
            Some(Packet::Disconnect(farewell)) => return Err(Fault::Closed(farewell.reason_code)),
            Some(_) => {}
            None => connection.exchange().await?,
        }
    }
}

fn is_alive(topic: &[u8], payload: &[u8]) -> bool {
    let topic = str::from_utf8(topic).ok().and_then(|topic| Topic::parse(topic).ok());
    match (topic, Sealed::decode(payload).map(|sealed| sealed.message)) {
        (Some((_, Topic::State { device })), Ok(Message::State(state))) => {
            state.device == device && state.alive
        }
        _ => false,
    }
}
