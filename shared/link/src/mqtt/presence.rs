//! Asks a broker whether another program is connected as a device, by the device's retained birth and death notices.

use std::time::Duration;

use cosurf_wire::{Message, Sealed, Topic};
use rumqttc::v5::mqttbytes::v5::{DisconnectReasonCode, Packet, PingReq};
use tokio::time::timeout;

use super::MqttConfig;
use super::connection::Connection;
use super::fault::Fault;
use super::probe::{block_on, leave};
use super::settings::ClientSettings;
use super::worker::is_granted;

/// Time for the broker to send what it keeps.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time in which a program that was thrown out of the broker has connected again: it waits at most a second.
const RETURN_TIMEOUT: Duration = Duration::from_millis(1500);

/// Whether the broker counts a device as connected: a program that uses its name, or one that has crashed so lately that the
/// broker has not noticed. The notice is taken as it is, signed or not. Connects under a client id of its own, so that the
/// other program stays connected. If the broker makes the client id of the certificate or the user, the other program is
/// thrown out, and shows that it is there when it comes back. An error is the reason, with the remedy.
pub fn is_present(config: MqttConfig) -> Result<bool, String> {
    let settings = config.into_presence_client();
    block_on(&settings, look(&settings))
}

/// Looks once more if a connection breaks that the broker had accepted. If that happens again, another program has most likely
/// ended both.
async fn look(settings: &ClientSettings) -> Result<bool, Fault> {
    for _ in 0..2 {
        if let Some(found) = look_once(settings).await? {
            return Ok(found);
        }
    }
    Ok(true)
}

/// Whether there is another program; `None` if the connection broke.
async fn look_once(settings: &ClientSettings) -> Result<Option<bool>, Fault> {
    let (mut connection, ack) = Connection::open(settings, false).await?;
    if ack.session_present {
        // Nobody else uses this client id, so the session is that of the device. It is kept as it is.
        let is_back = is_thrown_out(&mut connection).await;
        leave(&mut connection, None).await;
        return Ok(Some(is_back));
    }
    connection.queue(&settings.subscription());
    let notice = timeout(ANSWER_TIMEOUT, await_notice(&mut connection)).await.unwrap_or(Err(Fault::NoAnswer));
    let found = match notice {
        // Perhaps because this connection has ended that of the other program.
        Ok(Some(false)) => Ok(Some(is_thrown_out(&mut connection).await)),
        Ok(notice) => Ok(Some(notice.unwrap_or_default())),
        Err(Fault::Lost(_)) => return Ok(None),
        Err(fault) => Err(fault),
    };
    leave(&mut connection, Some(0)).await;
    found
}

/// Whether another client connects with the id that the broker has given to this one.
async fn is_thrown_out(connection: &mut Connection) -> bool {
    timeout(RETURN_TIMEOUT, until_thrown_out(connection)).await.is_ok()
}

/// Waits until the broker ends the connection because another client has connected with the same id. It may not say so.
async fn until_thrown_out(connection: &mut Connection) {
    while !matches!(connection.next_packet(), Ok(Some(Packet::Disconnect(_))) | Err(_)) {
        if connection.exchange().await.is_err() {
            return;
        }
    }
}

/// Waits for the notice, or for the answer to a ping that was sent after the subscription: then there is none. Returns
/// whether it is one of a birth.
async fn await_notice(connection: &mut Connection) -> Result<Option<bool>, Fault> {
    loop {
        match connection.next_packet()? {
            Some(Packet::SubAck(ack)) if is_granted(&ack) => connection.queue(&Packet::PingReq(PingReq)),
            Some(Packet::SubAck(_)) => return Err(Fault::Subscriptions),
            Some(Packet::Publish(message)) => return Ok(Some(is_alive(&message.topic, &message.payload))),
            Some(Packet::PingResp(_)) => return Ok(None),
            Some(Packet::Disconnect(farewell))
                if farewell.reason_code == DisconnectReasonCode::SessionTakenOver =>
            {
                return Ok(Some(true));
            }
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
