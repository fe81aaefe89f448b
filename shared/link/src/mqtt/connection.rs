//! One connection to a broker: packets in both directions over a stream of bytes.

use std::time::{Duration, Instant};

use bytes::{Buf, BytesMut};
use rumqttc::v5::mqttbytes::v5::{ConnAck, ConnectReturnCode, Packet};
use tokio::io::{AsyncReadExt, AsyncWriteExt, ReadHalf, WriteHalf, split};
use tokio::{select, time::timeout};

use super::fault::Fault;
use super::packet::{packet_bytes, read_packet};
use super::settings::{ClientSettings, PACKET_BYTES_MAX};
use super::stream::{self, Stream};

/// Time for everything from the first packet of TCP to the broker's CONNACK.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// First bytes that a broker may answer with: CONNACK, DISCONNECT, AUTH.
const ANSWERS: [u8; 3] = [0x20, 0xE0, 0xF0];
/// Bytes that are asked of the network at once.
const READ_BYTES: usize = 16 << 10;

/// A connection that the broker has accepted.
pub(super) struct Connection {
    reader: ReadHalf<Box<dyn Stream>>,
    writer: WriteHalf<Box<dyn Stream>>,
    input: BytesMut,
    output: BytesMut,
    /// Whether everything that `output` held has left this program.
    is_flushed: bool,
    /// When bytes last arrived.
    pub(super) heard: Instant,
    /// When the network last took bytes.
    pub(super) written: Instant,
}

impl Connection {
    /// Connects, and waits for CONNACK. If `is_anew`, the broker drops the session that it has kept.
    pub(super) async fn open(settings: &ClientSettings, is_anew: bool) -> Result<(Self, ConnAck), Fault> {
        let greeted =
            timeout(CONNECT_TIMEOUT, Self::greet(settings, is_anew)).await.unwrap_or(Err(Fault::NoAnswer));
        greeted.map_err(|fault| fault.before_answer(settings.tls.is_some()))
    }

    async fn greet(settings: &ClientSettings, is_anew: bool) -> Result<(Self, ConnAck), Fault> {
        let (reader, writer) = split(stream::open(&settings.broker, settings.tls.as_ref()).await?);
        let now = Instant::now();
        let mut connection = Self {
            reader,
            writer,
            input: BytesMut::new(),
            output: BytesMut::new(),
            is_flushed: true,
            heard: now,
            written: now,
        };
        connection.queue(&settings.hello(is_anew));
        loop {
            // Other services greet with a line of text, whose first letters may read as the length of a packet.
            if connection.input.first().is_some_and(|byte| !ANSWERS.contains(byte)) {
                return Err(Fault::NoBroker);
            }
            match connection.next_packet()? {
                Some(Packet::ConnAck(ack)) if ack.code == ConnectReturnCode::Success => {
                    return Ok((connection, ack));
                }
                Some(Packet::ConnAck(ack)) => return Err(Fault::Refused(ack.code)),
                Some(Packet::Disconnect(farewell)) => return Err(Fault::Closed(farewell.reason_code)),
                Some(_) => return Err(Fault::NoBroker),
                None => connection.exchange().await.map_err(|fault| match connection.input.is_empty() {
                    true => fault,
                    false => Fault::NoBroker,
                })?,
            }
        }
    }

    /// Adds a packet to what is sent.
    pub(super) fn queue(&mut self, packet: &Packet) {
        // Fails only for packets above the limit, which is not given here.
        let _ = packet.write(&mut self.output, None);
        self.is_flushed = false;
    }

    /// Whether all packets have left this program.
    pub(super) fn is_flushed(&self) -> bool {
        self.is_flushed
    }

    /// Whether a part of a packet has arrived.
    pub(super) fn is_within_packet(&self) -> bool {
        !self.input.is_empty()
    }

    /// Removes the next whole packet from what has arrived.
    pub(super) fn next_packet(&mut self) -> Result<Option<Packet>, Fault> {
        let whole = packet_bytes(&self.input, PACKET_BYTES_MAX).map_err(Fault::Packet)?;
        let Some(whole) = whole.filter(|bytes| *bytes <= self.input.len()) else { return Ok(None) };
        let packet = read_packet(&self.input[..whole]);
        self.input.advance(whole);
        if self.input.is_empty() {
            self.input = BytesMut::new();
        }
        packet.map(Some).map_err(Fault::Packet)
    }

    /// Waits until bytes have gone in either direction. May be abandoned at any time without loss.
    pub(super) async fn exchange(&mut self) -> Result<(), Fault> {
        let Self { reader, writer, input, output, is_flushed, heard, written } = self;
        input.reserve(READ_BYTES);
        select! {
            read = reader.read_buf(input) => match read {
                Ok(0) => return Err(Fault::Lost(std::io::ErrorKind::UnexpectedEof.into())),
                read => read.map(|_| *heard = Instant::now()),
            },
            sent = send(writer, output), if !*is_flushed => sent.map(|done| {
                *written = Instant::now();
                *is_flushed = done;
            }),
        }
        .map_err(Fault::Lost)
    }
}

/// Sends what the network takes. Returns whether nothing is left.
async fn send(writer: &mut WriteHalf<Box<dyn Stream>>, output: &mut BytesMut) -> std::io::Result<bool> {
    if output.is_empty() {
        writer.flush().await?;
        *output = BytesMut::new();
        return Ok(true);
    }
    writer.write_buf(output).await?;
    Ok(false)
}
