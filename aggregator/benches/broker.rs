//! How many messages a second the built-in broker carries from one client to another, beside clients that subscribe to
//! other topics and some that left sessions behind. The argument is the number of subscriptions of those.
//!
//! `cargo bench -p cosurf-aggregator --bench broker`

#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};

use cosurf_aggregator::broker::Broker;
use cosurf_tests::mqtt::{AN_HOUR, Hello, connect, publish, subscribe};
use divan::Bencher;
use divan::counter::{BytesCount, ItemsCount};

/// Messages that are on their way together.
const BATCH: usize = 64;
/// Subscriptions of one client.
const FILTERS: usize = 8;
/// Bytes of a chunk of a model.
const CHUNK_BYTES: usize = 8 << 10;

fn main() {
    divan::main();
}

fn client(address: SocketAddr, id: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_nodelay(true).unwrap();
    stream.write_all(&connect(&Hello { id, properties: &AN_HOUR, ..Hello::default() })).unwrap();
    skip_packet(&mut stream);
    stream
}

/// Reads a packet, and forgets it.
fn skip_packet(stream: &mut TcpStream) {
    let byte = |stream: &mut TcpStream| {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        byte[0]
    };
    byte(stream);
    let (mut length, mut shift) = (0, 0);
    loop {
        let next = byte(stream);
        length |= u64::from(next & 0x7F) << shift;
        shift += 7;
        if next & 0x80 == 0 {
            break;
        }
    }
    std::io::copy(&mut stream.take(length), &mut std::io::sink()).unwrap();
}

#[divan::bench(args = [0, 800, 8000])]
fn messages(bencher: Bencher, filters: usize) {
    let broker = Broker::start((Ipv4Addr::LOCALHOST, 0).into()).unwrap();
    let mut others: Vec<TcpStream> = Vec::new();
    for number in 0..filters / FILTERS {
        let mut other = client(broker.address(), &format!("other-{number}"));
        for filter in 0..FILTERS {
            other.write_all(&subscribe(&format!("gs/v1/site/other-{number}/dn/{filter}/#"))).unwrap();
            skip_packet(&mut other);
        }
        // Half of them leave.
        if number % 2 == 0 {
            others.push(other);
        }
    }
    let mut reader = client(broker.address(), "reader");
    reader.write_all(&subscribe("gs/v1/site/+/up/#")).unwrap();
    skip_packet(&mut reader);
    let mut writer = client(broker.address(), "writer");
    let message = publish("gs/v1/site/writer/up/1/c/7", &[7; CHUNK_BYTES], 0, false, &[]);
    let batch = message.repeat(BATCH);
    bencher.counter(ItemsCount::new(BATCH)).counter(BytesCount::new(batch.len())).bench_local(|| {
        writer.write_all(&batch).unwrap();
        (0..BATCH).for_each(|_| skip_packet(&mut reader));
    });
    drop(others);
}
