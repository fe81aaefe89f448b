//! Tries whether a broker lets a participant in, without touching what the broker keeps for it.

use std::time::Duration;

use rumqttc::v5::mqttbytes::v5::{Disconnect, DisconnectProperties, DisconnectReasonCode, Packet};
use tokio::time::timeout;

use super::MqttConfig;
use super::connection::Connection;
use super::fault::Fault;
use super::settings::ClientSettings;
use super::worker::is_granted;

/// Time for the broker's answer to the subscriptions, and for the farewell.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for the broker to end the connection after the farewell. Before that, a session that ends with it may still be there.
const END_TIMEOUT: Duration = Duration::from_secs(1);

/// Connects as a participant, and leaves again. Of what the broker keeps for this client id, nothing is dropped and no
/// message is acknowledged, so the participant gets everything when it comes back. If the broker keeps nothing, the
/// subscriptions are tried too, and ended again. An error is the reason, with the remedy.
///
/// It uses the participant's own client id, because a broker may take the id from the certificate.
pub fn probe(config: MqttConfig) -> Result<(), String> {
    let settings = config.into_probing_client();
    block_on(&settings, try_in(&settings))
}

/// Runs what asks the broker to its end, on this thread. An error names the broker.
pub(super) fn block_on<T>(
    settings: &ClientSettings,
    asking: impl Future<Output = Result<T, Fault>>,
) -> Result<T, String> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime =
        runtime.map_err(|error| format!("broker {}: cannot start the I/O: {error}", settings.broker))?;
    let asked = runtime.block_on(asking);
    // A name that is still being looked up must not hold up the end.
    runtime.shutdown_background();
    asked.map_err(|fault| format!("broker {}: {fault}", settings.broker))
}

async fn try_in(settings: &ClientSettings) -> Result<(), Fault> {
    let (mut connection, ack) = Connection::open(settings, false).await?;
    if ack.session_present {
        // The participant was let in before.
        leave(&mut connection, None).await;
        return Ok(());
    }
    connection.queue(&settings.subscription());
    let granted = timeout(ANSWER_TIMEOUT, await_grant(&mut connection)).await.unwrap_or(Err(Fault::NoAnswer));
    // Ends the session that began with this connection.
    leave(&mut connection, Some(0)).await;
    granted
}

async fn await_grant(connection: &mut Connection) -> Result<(), Fault> {
    loop {
        match connection.next_packet()? {
            Some(Packet::SubAck(ack)) if is_granted(&ack) => return Ok(()),
            Some(Packet::SubAck(_)) => return Err(Fault::Subscriptions),
            Some(Packet::Disconnect(farewell)) => return Err(Fault::Closed(farewell.reason_code)),
            Some(_) => {}
            None => connection.exchange().await?,
        }
    }
}

/// Says farewell. `expiry_s` changes how long the broker keeps the session, seconds.
pub(super) async fn leave(connection: &mut Connection, expiry_s: Option<u32>) {
    let properties = expiry_s.map(|seconds| DisconnectProperties {
        session_expiry_interval: Some(seconds),
        reason_string: None,
        user_properties: Vec::new(),
        server_reference: None,
    });
    let reason_code = DisconnectReasonCode::NormalDisconnection;
    connection.queue(&Packet::Disconnect(Disconnect { reason_code, properties }));
    let flush = async { while !connection.is_flushed() && connection.exchange().await.is_ok() {} };
    // A broker that takes nothing more notices the end of the connection.
    let _ = timeout(ANSWER_TIMEOUT, flush).await;
    let _ = timeout(END_TIMEOUT, async { while connection.exchange().await.is_ok() {} }).await;
}
