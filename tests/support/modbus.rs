//! A Modbus server on a loopback port, and the least client that can send what no library would.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use cangate::modbus::{CounterValues, Counters, ModbusSettings, Server};
use cangate::process_image::{ImageWriter, process_image};
use cangate::time::Clock;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::{plant, registers};

/// Longer than any test takes on a slow machine; nothing is proved by waiting so long.
pub const LONG: Duration = Duration::from_secs(30);

/// A server that runs.
pub struct RunningServer {
    pub address: SocketAddr,
    pub writer: ImageWriter,
    pub counters: Arc<Counters>,
    pub stop: CancellationToken,
    pub task: JoinHandle<()>,
}

/// Serves the plant of `registers` on a port of the system's choice.
pub async fn serve(settings: ModbusSettings) -> RunningServer {
    let table = registers::table();
    let (writer, reader) = process_image(plant::image(&table));
    let settings = ModbusSettings { listen: vec!["127.0.0.1:0".parse().unwrap()], ..settings };
    let bank = registers::bank(table, &settings);
    let server = Server::bind(&settings, bank, reader, Clock::start()).await.unwrap();
    let (address, counters) = (server.local_addrs()[0], server.counters());
    let stop = CancellationToken::new();
    let task = tokio::spawn(server.run(stop.clone()));
    RunningServer { address, writer, counters, stop, task }
}

impl RunningServer {
    /// Waits until the counters are such.
    pub async fn until(&self, such: impl Fn(&CounterValues) -> bool) {
        let waiting = async {
            while !such(&self.counters.values()) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        let waited = tokio::time::timeout(LONG, waiting).await;
        assert!(waited.is_ok(), "{:?}", self.counters.values());
    }

    pub async fn client(&self) -> RawClient {
        RawClient(TcpStream::connect(self.address).await.unwrap())
    }
}

/// Bytes to and from a server.
pub struct RawClient(pub TcpStream);

impl RawClient {
    pub async fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).await.unwrap();
    }

    /// The next frame: transaction, unit, PDU. `None` when the server has closed.
    pub async fn receive(&mut self) -> Option<(u16, u8, Vec<u8>)> {
        let receiving = async {
            let mut header = [0; 7];
            self.0.read_exact(&mut header).await.ok()?;
            assert_eq!(header[2..4], [0, 0]);
            let mut pdu = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
            self.0.read_exact(&mut pdu).await.ok()?;
            Some((u16::from_be_bytes([header[0], header[1]]), header[6], pdu))
        };
        tokio::time::timeout(LONG, receiving).await.expect("an answer or the end")
    }

    /// Whether the server answers a simple request.
    pub async fn works(&mut self) -> bool {
        self.0.write_all(&frame(7, 247, &[4, 0, 90, 0, 1])).await.is_ok()
            && self.receive().await == Some((7, 247, vec![4, 2, 0x12, 0x34]))
    }

    /// Waits until the server has closed.
    pub async fn closed(&mut self) {
        let reading = async {
            let mut byte = [0];
            while !matches!(self.0.read(&mut byte).await, Ok(0) | Err(_)) {}
        };
        tokio::time::timeout(LONG, reading).await.expect("the server closes");
    }
}

/// A request as it goes over the wire.
pub fn frame(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let length = u16::try_from(pdu.len() + 1).unwrap();
    [&transaction.to_be_bytes()[..], &[0, 0], &length.to_be_bytes(), &[unit], pdu].concat()
}
