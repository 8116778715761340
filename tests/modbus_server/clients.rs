//! Many clients at once, and foreign ones.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use cangate::modbus::{End, ModbusSettings, RegisterMap, Server, WordOrder};
use cangate::process_image::{Revision, Value, process_image};
use cangate::time::Clock;
use tokio::net::TcpSocket;
use tokio_modbus::client::{Reader, tcp};
use tokio_modbus::prelude::{Client, ReadCode, Request, Response};
use tokio_modbus::{ExceptionCode, Slave};

use crate::support::modbus::{LONG, RawClient, RunningServer, serve};
use crate::support::{plant, registers};

fn few(max_connections: u16) -> ModbusSettings {
    ModbusSettings { max_connections, ..ModbusSettings::default() }
}

async fn from_address(server: &RunningServer, last: u8) -> RawClient {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(SocketAddr::from((Ipv4Addr::new(127, 0, 0, last), 0))).unwrap();
    RawClient(socket.connect(server.address).await.unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sixty_four_clients_are_served_at_once_and_read_whole_images() {
    let mut server = serve(ModbusSettings::default()).await;
    let mut clients = tokio::task::JoinSet::new();
    for _ in 0..64 {
        let stream = tcp::connect_slave(server.address, Slave(1));
        clients.spawn(async move {
            let mut client = stream.await.unwrap();
            for _ in 0..50 {
                // u16 and i16 of one tag: both from the same image.
                let both = client.read_input_registers(100, 2).await.unwrap().unwrap();
                assert_eq!(both[0], both[1]);
            }
            client
        });
    }
    for value in 0..2000_u32 {
        server.writer.apply(|image| {
            image.revision = Revision(image.revision.0 + 1);
            image.tags[0].value = Value::Float(f64::from(value % 100));
        });
        tokio::task::yield_now().await;
    }
    let mut open = Vec::new();
    while let Some(client) = clients.join_next().await {
        open.push(client.unwrap());
    }
    let values = server.counters.values();
    assert_eq!((values.open, values.requests, values.ended(End::Evicted)), (64, 3200, 0));
    drop(open);
    server.until(|counters| counters.open == 0).await;
}

#[tokio::test]
async fn f42_when_all_places_are_taken_the_longest_silent_makes_room() {
    let server = serve(few(4)).await;
    let mut clients = Vec::new();
    for _ in 0..4 {
        let mut client = server.client().await;
        assert!(client.works().await);
        clients.push(client);
    }
    assert!(clients[0].works().await, "now the second is the one that has been silent for longest");
    let mut newcomer = server.client().await;
    assert!(newcomer.works().await);
    clients[1].closed().await;
    for place in [0, 2, 3] {
        assert!(clients[place].works().await);
    }
    let values = server.counters.values();
    assert_eq!((values.open, values.ended(End::Evicted)), (4, 1));
}

#[tokio::test]
async fn p25_a_flood_from_one_address_does_not_displace_a_plc_of_another() {
    let server = serve(few(4)).await;
    let mut plc = from_address(&server, 2).await;
    assert!(plc.works().await);
    let mut strangers = Vec::new();
    for _ in 0..200 {
        let mut stranger = server.client().await;
        assert!(stranger.works().await);
        strangers.push(stranger);
    }
    assert!(plc.works().await);
    assert!(server.counters.values().ended(End::Evicted) > 190);
}

#[tokio::test]
async fn s2_places_return_to_zero_whatever_the_races() {
    let server = serve(few(8)).await;
    let mut rounds = tokio::task::JoinSet::new();
    for round in 0..400_u32 {
        let address = server.address;
        rounds.spawn(async move {
            let mut client = RawClient(tokio::net::TcpStream::connect(address).await.unwrap());
            match round % 4 {
                0 => {}
                1 => drop(tokio::io::AsyncWriteExt::write_all(&mut client.0, &[0, 1, 0, 0]).await),
                2 => drop(client.works().await),
                _ => client.0.set_zero_linger().unwrap(),
            }
        });
    }
    while let Some(round) = rounds.join_next().await {
        round.unwrap();
    }
    server.until(|counters| counters.open == 0 && counters.accepted >= 300).await;
    let values = server.counters.values();
    let ended: u64 = End::ALL.iter().map(|end| values.ended(*end)).sum();
    assert_eq!(ended, values.accepted);
    assert!(server.client().await.works().await);
}

#[tokio::test]
async fn stopping_closes_every_connection_and_the_port() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    assert!(client.works().await);
    server.stop.cancel();
    client.closed().await;
    tokio::time::timeout(LONG, server.task).await.unwrap().unwrap();
    assert!(tokio::net::TcpStream::connect(server.address).await.is_err());
}

#[tokio::test]
async fn several_addresses_are_served_and_a_taken_one_is_named() {
    let table = registers::table();
    let (_writer, reader) = process_image(plant::image(&table));
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let mut settings = ModbusSettings { listen: vec![any, any], ..ModbusSettings::default() };
    let bank = || registers::bank(registers::table(), &ModbusSettings::default());
    let server = Server::bind(&settings, bank(), reader.clone(), Clock::start()).await.unwrap();
    let addresses = server.local_addrs();
    let stop = tokio_util::sync::CancellationToken::new();
    let task = tokio::spawn(server.run(stop.clone()));
    for address in &addresses {
        assert!(RawClient(tokio::net::TcpStream::connect(address).await.unwrap()).works().await);
    }
    settings.listen = vec![any, addresses[1]];
    let error = Server::bind(&settings, bank(), reader, Clock::start()).await.unwrap_err();
    assert_eq!(error.address, addresses[1]);
    assert!(error.to_string().contains(&addresses[1].to_string()));
    stop.cancel();
    task.await.unwrap();
}

#[tokio::test]
async fn the_gateway_heartbeat_counts_by_itself() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = tcp::connect_slave(server.address, Slave(247)).await.unwrap();
    let first = client.read_input_registers(0, 1).await.unwrap().unwrap()[0];
    let counting = async {
        while client.read_input_registers(0, 1).await.unwrap().unwrap()[0] == first {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(LONG, counting).await.unwrap();
}

#[tokio::test]
async fn a_foreign_client_reads_all_four_tables_and_sees_exceptions() {
    let server = serve(ModbusSettings { word_order: WordOrder::Little, ..ModbusSettings::default() }).await;
    let mut client = tcp::connect_slave(server.address, Slave(1)).await.unwrap();
    assert_eq!(client.read_input_registers(100, 4).await.unwrap().unwrap(), [1255, 1255, 1255, 0]);
    assert_eq!(client.read_holding_registers(100, 1).await.unwrap().unwrap(), [1255]);
    let bits = client.read_discrete_inputs(90, 10).await.unwrap().unwrap();
    assert_eq!(bits.iter().position(|bit| *bit), Some(6));
    assert_eq!(client.read_coils(90, 10).await.unwrap().unwrap(), bits);
    let exceptions = [
        (Request::ReadInputRegisters(119, 2), ExceptionCode::IllegalDataAddress),
        (Request::WriteSingleRegister(100, 1), ExceptionCode::IllegalDataAddress),
        (Request::WriteMultipleCoils(0, vec![true; 1968].into()), ExceptionCode::IllegalDataAddress),
        (Request::MaskWriteRegister(100, 0, 0), ExceptionCode::IllegalDataAddress),
        (Request::ReadInputRegisters(0, 126), ExceptionCode::IllegalDataValue),
        (Request::ReportServerId, ExceptionCode::IllegalFunction),
        (Request::Custom(0x65, vec![1, 2, 3].into()), ExceptionCode::IllegalFunction),
    ];
    for (request, expected) in exceptions {
        assert_eq!(client.call(request.clone()).await.unwrap().unwrap_err(), expected, "{request:?}");
    }
    assert_eq!(server.counters.values().exceptions, [0, 2, 4, 1, 0, 0, 0, 0, 0, 0, 0, 0]);
}

#[tokio::test]
async fn a_foreign_client_identifies_the_gateway_and_the_device() {
    let server = serve(ModbusSettings::default()).await;
    let table = registers::table();
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap();
    for (unit, expected) in [
        (255, vec!["cangate", "cangate", env!("CARGO_PKG_VERSION")]),
        (2, vec!["MOTORTECH", "motortech-detcon", env!("CARGO_PKG_VERSION")]),
    ] {
        let mut client = tcp::connect_slave(server.address, Slave(unit)).await.unwrap();
        let mut texts = Vec::new();
        let request = Request::ReadDeviceIdentification(ReadCode::Extended, 0);
        let Response::ReadDeviceIdentification(answer) = client.call(request).await.unwrap().unwrap() else {
            panic!("another answer");
        };
        for object in &answer.device_id_objects {
            texts.push((object.id, object.value_as_str().unwrap().to_owned()));
        }
        assert_eq!(texts[..3].iter().map(|(_, text)| text.as_str()).collect::<Vec<_>>(), expected);
        assert!(texts.contains(&(0x80, map.hash_text())));
    }
}
