//! Serial lines as TCP ports, over loopback sockets.

use std::time::Duration;

use cangate::gateway::command::{CommandSource, Outcome};
use cangate::mapping::{LineDef, LineTcp};
use cangate::process_image::LineIndex;
use cangate::serial::Server;
use cangate::slots::AllowList;
use cangate::time::Clock;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::support::lines::{self, Bench};
use crate::support::{PATIENCE, until};

/// A server for one line.
struct World {
    bench: Bench,
    address: std::net::SocketAddr,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl World {
    async fn start() -> Self {
        Self::with(|_| {}).await
    }

    async fn with(change: impl FnOnce(&mut LineTcp)) -> Self {
        let mut tcp = lines::tcp();
        change(&mut tcp);
        let table = lines::table(vec![LineDef { tcp: Some(tcp), ..lines::line() }]);
        let bench = Bench::new(&table);
        let server = Server::bind(&table, &bench.desk, &bench.reader, Clock::start()).await.unwrap();
        let address = server.addresses().next().unwrap().1;
        let stop = CancellationToken::new();
        let task = tokio::spawn(server.run(stop.clone()));
        Self { bench, address, stop, task }
    }

    /// A client that gets what comes in from now on.
    async fn client(&mut self) -> TcpStream {
        let mut client = TcpStream::connect(self.address).await.unwrap();
        // Admitted once it gets something.
        let mut byte = [0];
        loop {
            self.bench.receive(b"\0");
            match tokio::time::timeout(Duration::from_millis(50), client.read(&mut byte)).await {
                Ok(read) => break assert_eq!(read.unwrap(), 1, "the connection ended"),
                Err(_elapsed) => {}
            }
        }
        client
    }

    async fn stop(self) {
        self.stop.cancel();
        tokio::time::timeout(PATIENCE, self.task).await.unwrap().unwrap();
    }
}

/// Reads until so many bytes came that are no zeros: those are how `World::client` knocks.
async fn read(client: &mut TcpStream, count: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    let reading = async {
        while bytes.len() < count {
            let mut buffer = vec![0; 65_536];
            let read = client.read(&mut buffer).await.unwrap();
            assert!(read > 0, "the connection ended after {} of {count} bytes", bytes.len());
            bytes.extend(buffer[..read].iter().filter(|byte| **byte != 0));
        }
    };
    tokio::time::timeout(PATIENCE, reading).await.expect("it does not come");
    bytes
}

/// Reads to the end of the connection; how many bytes came before.
async fn read_to_end(client: &mut TcpStream) -> usize {
    let mut total = 0;
    let reading = async {
        let mut buffer = vec![0; 65_536];
        while let Ok(read @ 1..) = client.read(&mut buffer).await {
            total += read;
        }
    };
    tokio::time::timeout(PATIENCE, reading).await.expect("the connection does not end");
    total
}

#[tokio::test]
async fn every_connection_gets_what_comes_in_from_then_on_in_order() {
    let mut world = World::start().await;
    world.bench.receive(b"before");
    let mut first = world.client().await;
    world.bench.receive(b"one ");
    let mut second = world.client().await;
    world.bench.receive(b"two ");
    world.bench.receive(b"three");
    assert_eq!(read(&mut first, 13).await, b"one two three");
    assert_eq!(read(&mut second, 9).await, b"two three");
    world.stop().await;
}

#[tokio::test]
async fn r_esd_039_the_first_that_sends_is_the_writer_until_it_ends() {
    let mut world = World::start().await;
    let (mut writer, mut other) = (world.client().await, world.client().await);
    let mut reader = world.client().await;
    writer.write_all(b"mine").await.unwrap();
    let asked = world.bench.asked().await;
    assert_eq!((asked.bytes.as_slice(), asked.line), (b"mine".as_slice(), LineIndex(0)));
    assert_eq!(asked.source, CommandSource::serial(writer.local_addr().unwrap().to_string()));
    other.write_all(b"not mine").await.unwrap();
    read_to_end(&mut other).await;
    asked.answer(Outcome::Done);
    writer.write_all(b" too").await.unwrap();
    assert_eq!(world.bench.take(4).await, b" too");
    world.bench.receive(b"answer");
    assert_eq!(read(&mut writer, 6).await, b"answer");
    assert_eq!(read(&mut reader, 6).await, b"answer", "who only reads stays");

    writer.shutdown().await.unwrap();
    drop(writer);
    // The seat is free soon; until then newcomers that send are closed.
    let bench = &mut world.bench;
    until("another one writes", async || {
        let mut next = TcpStream::connect(world.address).await.unwrap();
        next.write_all(b"next").await.unwrap();
        tokio::select! {
            asked = bench.asked() => {
                assert_eq!(asked.bytes, b"next");
                Some(())
            }
            _ = read_to_end(&mut next) => None,
        }
    })
    .await;
    world.stop().await;
}

#[tokio::test]
async fn r_esd_039_two_pieces_wait_at_the_gateway_and_the_next_when_one_went_out() {
    let mut world = World::start().await;
    let mut client = world.client().await;
    let sent: Vec<u8> = (0..20_000_u32).map(|number| u8::try_from(number % 251).unwrap()).collect();
    client.write_all(&sent).await.unwrap();
    let mut taken: Vec<u8> = Vec::new();
    let mut waiting = vec![world.bench.asked().await, world.bench.asked().await];
    while taken.len() < sent.len() {
        // What comes in meanwhile is delivered: the client is alive, and asks for nothing more.
        world.bench.receive(b"x");
        read(&mut client, 1).await;
        assert!(world.bench.is_quiet(), "three at once");
        let oldest = waiting.remove(0);
        assert!(oldest.bytes.len() <= 1024);
        taken.extend(&oldest.bytes);
        oldest.answer(Outcome::Done);
        let left = sent.len() - taken.len() - waiting.iter().map(|asked| asked.bytes.len()).sum::<usize>();
        if left > 0 {
            waiting.push(world.bench.asked().await);
        } else if waiting.is_empty() {
            break;
        }
    }
    assert_eq!(taken, sent);
    world.stop().await;
}

#[tokio::test]
async fn while_the_line_is_closed_what_clients_send_waits_and_they_stay() {
    let mut world = World::start().await;
    let mut client = world.client().await;
    world.bench.open(false);
    // A sign that the server knows: after it, nothing is read.
    world.bench.receive(b"x");
    read(&mut client, 1).await;
    client.write_all(b"later").await.unwrap();
    world.bench.receive(b"y");
    read(&mut client, 1).await;
    assert!(world.bench.is_quiet());
    world.bench.open(true);
    assert_eq!(world.bench.take(5).await, b"later");
    world.stop().await;
}

#[tokio::test]
async fn what_a_client_sent_that_ended_its_sending_does_not_go_out_when_the_line_opens_again_and_it_reads_on()
{
    let mut world = World::start().await;
    let mut half = world.client().await;
    let mut writer = world.client().await;
    world.bench.open(false);
    world.bench.receive(b"x");
    read(&mut half, 1).await;
    half.write_all(b"stale").await.unwrap();
    half.shutdown().await.unwrap();
    world.bench.receive(b"y");
    assert_eq!(read(&mut half, 1).await, b"y");
    world.bench.open(true);
    writer.write_all(b"fresh").await.unwrap();
    assert_eq!(world.bench.take(5).await, b"fresh");
    world.bench.receive(b"answer");
    assert_eq!(read(&mut half, 6).await, b"answer", "it still reads");
    // A reset, and its place is free.
    half.set_zero_linger().unwrap();
    drop(half);
    world.stop().await;
}

#[tokio::test]
async fn on_a_passive_bus_what_clients_send_is_thrown_away_and_does_not_wait_for_ever() {
    let mut table = (*lines::table(vec![LineDef { tcp: Some(lines::tcp()), ..lines::line() }])).clone();
    table.buses[0].role = cangate::canopen::Role::Passive;
    let mut bench = Bench::new(&table);
    bench.open(false);
    let server = Server::bind(&table, &bench.desk, &bench.reader, Clock::start()).await.unwrap();
    let address = server.addresses().next().unwrap().1;
    let stop = CancellationToken::new();
    let task = tokio::spawn(server.run(stop.clone()));
    let mut world = World { bench, address, stop, task };
    let mut client = world.client().await;
    // More than the system keeps for somebody who does not read.
    let much = vec![b'x'; 16_000_000];
    tokio::time::timeout(PATIENCE, client.write_all(&much)).await.expect("it waits").unwrap();
    world.bench.receive(b"on");
    assert_eq!(read(&mut client, 2).await, b"on");
    assert!(world.bench.is_quiet());
    world.stop().await;
}

#[tokio::test]
async fn a_writer_learns_by_the_end_of_its_connection_that_bytes_did_not_go_out() {
    let mut world = World::start().await;
    let mut reader = world.client().await;
    for outcome in [Outcome::Failed("12 of 40 bytes were sent".into()), Outcome::NodeUnavailable] {
        let mut client = world.client().await;
        client.write_all(&[7; 40]).await.unwrap();
        world.bench.asked().await.answer(outcome);
        read_to_end(&mut client).await;
    }
    let mut next = world.client().await;
    next.write_all(b"next").await.unwrap();
    assert_eq!(world.bench.take(4).await, b"next");
    world.bench.receive(b"abc");
    assert_eq!(read(&mut reader, 3).await, b"abc");
    world.stop().await;
}

#[tokio::test]
async fn who_ends_its_sending_still_gets_the_answer_and_another_one_may_write() {
    let mut world = World::start().await;
    let mut client = world.client().await;
    client.write_all(b"question").await.unwrap();
    client.shutdown().await.unwrap();
    let asked = world.bench.asked().await;
    let mut other = world.client().await;
    asked.answer(Outcome::Done);
    world.bench.receive(b"answer");
    assert_eq!(read(&mut client, 6).await, b"answer");
    other.write_all(b"me").await.unwrap();
    assert_eq!(world.bench.take(2).await, b"me");
    // A reset, and its place is free.
    client.set_zero_linger().unwrap();
    drop(client);
    world.stop().await;
}

#[tokio::test]
async fn an_address_that_is_not_allowed_is_closed_at_once() {
    let list =
        |networks: &[&str]| AllowList::new(networks.iter().map(|text| text.parse().unwrap()).collect());
    let mut world = World::with(|tcp| tcp.allow = list(&["10.0.0.0/8"])).await;
    let mut stranger = TcpStream::connect(world.address).await.unwrap();
    world.bench.receive(b"secret");
    assert_eq!(read_to_end(&mut stranger).await, 0);
    world.stop().await;
    let mut world = World::with(|tcp| tcp.allow = list(&["10.0.0.0/8", "127.0.0.0/8"])).await;
    let mut friend = world.client().await;
    world.bench.receive(b"welcome");
    assert_eq!(read(&mut friend, 7).await, b"welcome");
    world.stop().await;
}

#[tokio::test]
async fn who_may_not_write_reads_on_and_nothing_goes_out() {
    let mut world = World::with(|tcp| tcp.write = false).await;
    let mut client = world.client().await;
    for round in 0..3 {
        client.write_all(b"please").await.unwrap();
        world.bench.receive(b"no");
        assert_eq!(read(&mut client, 2).await, b"no", "{round}");
    }
    assert!(world.bench.is_quiet());
    world.stop().await;
}

#[tokio::test]
async fn a_reader_that_takes_nothing_is_cut_and_the_others_do_not_wait_for_it() {
    let mut world = World::start().await;
    let (mut slow, mut fast) = (world.client().await, world.client().await);
    let block: Vec<u8> = (0..32_768_u32).map(|number| u8::try_from(number % 250 + 1).unwrap()).collect();
    // More than the image, the system and the network keep together.
    let rounds = 1_024;
    for _ in 0..rounds {
        world.bench.receive(&block);
        assert_eq!(read(&mut fast, block.len()).await, block);
    }
    assert!(read_to_end(&mut slow).await < rounds * block.len());
    world.bench.receive(b"on");
    assert_eq!(read(&mut fast, 2).await, b"on");
    world.stop().await;
}

#[tokio::test]
async fn a_newcomer_gets_a_place_when_all_are_taken() {
    let mut world = World::with(|tcp| tcp.max_connections = 1).await;
    let mut first = world.client().await;
    let mut second = world.client().await;
    read_to_end(&mut first).await;
    world.bench.receive(b"on");
    assert_eq!(read(&mut second, 2).await, b"on");
    world.stop().await;
}

#[tokio::test]
async fn a_reader_of_a_quiet_line_is_not_displaced_by_one_address_that_sends() {
    let mut world = World::with(|tcp| tcp.max_connections = 3).await;
    let elsewhere = tokio::net::TcpSocket::new_v4().unwrap();
    elsewhere.bind("127.0.0.2:0".parse().unwrap()).unwrap();
    let mut reader = elsewhere.connect(world.address).await.unwrap();
    let mut noisy = TcpStream::connect(world.address).await.unwrap();
    noisy.write_all(b"a").await.unwrap();
    world.bench.asked().await.answer(Outcome::Done);
    noisy.shutdown().await.unwrap();
    let bench = &mut world.bench;
    let _second = until("another one writes", async || {
        let mut second = TcpStream::connect(world.address).await.unwrap();
        second.write_all(b"b").await.unwrap();
        tokio::select! {
            asked = bench.asked() => {
                asked.answer(Outcome::Done);
                Some(second)
            }
            _ = read_to_end(&mut second) => None,
        }
    })
    .await;
    let _newcomer = TcpStream::connect(world.address).await.unwrap();
    read_to_end(&mut noisy).await;
    world.bench.receive(b"on");
    assert_eq!(read(&mut reader, 2).await, b"on");
    world.stop().await;
}

#[tokio::test]
async fn a_browser_cannot_be_made_to_send_to_a_line() {
    let mut world = World::start().await;
    let long = format!("GET /{} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nSTART", "\r\nSTART\r\n".repeat(300));
    let hello = [b"\x16\x03\x01\x02\x00\x01\x00\x01\xFC\x03\x03".as_slice(), &[b'x'; 500]].concat();
    for request in [b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nSTART", long.as_bytes(), &hello] {
        let mut browser = world.client().await;
        // Its connection may end before all of it was taken.
        let _ = browser.write_all(request).await;
        read_to_end(&mut browser).await;
        assert!(world.bench.is_quiet(), "{}", request.len());
    }
    let mut client = world.client().await;
    client.write_all(b"mine").await.unwrap();
    assert_eq!(world.bench.take(4).await, b"mine");
    world.stop().await;
}

#[tokio::test]
async fn a_command_that_could_begin_a_request_goes_out_after_a_while_or_with_its_next_byte() {
    let mut world = World::start().await;
    let mut client = world.client().await;
    client.write_all(b"GET").await.unwrap();
    assert_eq!(world.bench.take(3).await, b"GET");
    client.write_all(b"\r\n").await.unwrap();
    assert_eq!(world.bench.take(2).await, b"\r\n");
    let mut other = world.client().await;
    drop(client);
    until("the seat is free", async || {
        other.write_all(b"G").await.ok()?;
        other.shutdown().await.ok()?;
        tokio::select! {
            asked = world.bench.asked() => (asked.bytes == b"G").then_some(()),
            _ = read_to_end(&mut other) => {
                other = TcpStream::connect(world.address).await.unwrap();
                None
            }
        }
    })
    .await;
    world.stop().await;
}

#[tokio::test]
async fn a_taken_port_is_named_with_its_line() {
    let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let listen = taken.local_addr().unwrap();
    let tcp = LineTcp { listen, ..lines::tcp() };
    let table = lines::table(vec![LineDef { tcp: Some(tcp), ..lines::line() }]);
    let bench = Bench::new(&table);
    let message =
        Server::bind(&table, &bench.desk, &bench.reader, Clock::start()).await.unwrap_err().to_string();
    assert!(
        message.contains("serial line 1 of `engine1`") && message.contains(&listen.to_string()),
        "{message}"
    );
}

#[tokio::test]
async fn lines_do_not_see_each_other() {
    let port = |number| LineDef { number, tcp: Some(lines::tcp()), ..lines::line() };
    let table = lines::table(vec![port(1), LineDef { tcp: None, ..port(2) }, port(3)]);
    let mut bench = Bench::new(&table);
    let server = Server::bind(&table, &bench.desk, &bench.reader, Clock::start()).await.unwrap();
    let addresses: Vec<_> = server.addresses().map(|(name, address)| (name.to_owned(), address)).collect();
    assert_eq!(addresses[0].0, "serial line 1 of `engine1`");
    assert_eq!(addresses[1].0, "serial line 3 of `engine1`");
    let stop = CancellationToken::new();
    let task = tokio::spawn(server.run(stop.clone()));
    let mut clients = Vec::new();
    for (_, address) in &addresses {
        clients.push(TcpStream::connect(address).await.unwrap());
    }
    for (client, bytes) in clients.iter_mut().zip(["one", "three"]) {
        client.write_all(bytes.as_bytes()).await.unwrap();
    }
    let mut asked = [bench.asked().await, bench.asked().await];
    asked.sort_by_key(|asked| asked.line);
    let seen = asked.map(|asked| {
        let seen = (asked.line.0, asked.bytes.clone());
        asked.answer(Outcome::Done);
        seen
    });
    assert_eq!(seen, [(0, b"one".to_vec()), (2, b"three".to_vec())]);
    // Both were admitted: they sent.
    bench.change(2, |line| line.append(b"III"));
    bench.change(0, |line| line.append(b"I"));
    assert_eq!(read(&mut clients[0], 1).await, b"I");
    assert_eq!(read(&mut clients[1], 3).await, b"III");
    stop.cancel();
    tokio::time::timeout(PATIENCE, task).await.unwrap().unwrap();
}
