//! A Modbus server that wants certificates, with a plant's authority and files.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use cangate::gateway::Desk;
use cangate::modbus::security::settings::RoleEntry;
use cangate::modbus::security::{Right, SecuritySettings};
use cangate::modbus::{Accounts, CounterValues, Counters, ModbusSettings, Server};
use cangate::process_image::{ImageWriter, process_image};
use cangate::time::Clock;
use cangate::tls::{ClientKeeper, Reason, TlsClientSettings};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_util::sync::CancellationToken;

use super::modbus::{LONG, frame};
use super::pki::{Authority, Folder, Pair};
use super::{plant, registers};

/// Register 90 of the gateway: 0x1234.
pub const READ: &[u8] = &[4, 0, 90, 0, 1];
/// One of a register.
pub const WRITE: &[u8] = &[6, 0, 90, 0, 1];

/// A server that runs, and what its clients need.
pub struct Secure {
    pub folder: Folder,
    pub authority: Authority,
    pub plain: SocketAddr,
    pub address: SocketAddr,
    pub counters: Arc<Counters>,
    pub accounts: Arc<Accounts>,
    pub stop: CancellationToken,
    pub task: JoinHandle<()>,
    _writer: ImageWriter,
}

/// Files of a gateway in a folder, and the roles Operator (reads), Engineer (reads and writes) and Visitor (nothing).
pub fn settings(folder: &Folder, authority: &Authority) -> SecuritySettings {
    let (cert_file, key_file) = folder.write_pair("gateway", &authority.host());
    let role = |name: &str, rights: &[Right]| RoleEntry { name: name.to_owned(), rights: rights.to_vec() };
    SecuritySettings {
        listen: vec!["127.0.0.1:0".parse().unwrap()],
        cert_file,
        key_file,
        client_ca_file: folder.write("ca.pem", &authority.pem),
        roles: vec![
            role("Operator", &[Right::Read]),
            role("Engineer", &[Right::Read, Right::Write]),
            role("Visitor", &[]),
        ],
        no_role: Vec::new(),
    }
}

impl Secure {
    pub async fn start(change: impl FnOnce(&mut ModbusSettings)) -> Self {
        Self::start_with(None, change).await
    }

    /// The same with a desk.
    pub async fn start_with(desk: Option<Desk>, change: impl FnOnce(&mut ModbusSettings)) -> Self {
        let (folder, authority) = (Folder::new(), Authority::new("plant"));
        let mut settings = ModbusSettings {
            listen: vec!["127.0.0.1:0".parse().unwrap()],
            security: settings(&folder, &authority),
            ..ModbusSettings::default()
        };
        change(&mut settings);
        let table = registers::table();
        let (writer, reader) = process_image(plant::image(&table));
        let bank = registers::bank(table, &settings);
        let server = Server::bind(&settings, bank, reader, Clock::start()).await.unwrap();
        let server = desk.into_iter().fold(server, Server::with_desk);
        let server = server.with_security(&settings.security).await.unwrap();
        let (plain, address) = (server.local_addrs()[0], server.secure_addrs()[0]);
        let (counters, accounts, stop) = (server.counters(), server.accounts(), CancellationToken::new());
        let task = tokio::spawn(server.run(stop.clone()));
        Self { folder, authority, plain, address, counters, accounts, stop, task, _writer: writer }
    }

    /// Files of a client.
    pub fn files(&self, name: &str, pair: &Pair) -> TlsClientSettings {
        let (cert, key) = self.folder.write_pair(name, pair);
        let ca_file: Option<PathBuf> = Some(self.folder.write("gateway-ca.pem", &self.authority.pem));
        TlsClientSettings { ca_file, cert_file: Some(cert), key_file: Some(key) }
    }

    /// A client with these roles in its certificate.
    pub async fn client(&self, roles: &[&str]) -> Result<SecureClient, Reason> {
        let files = self.files("client", &self.authority.with_roles(roles));
        SecureClient::connect(self.address, &files).await
    }

    pub async fn until(&self, such: impl Fn(&CounterValues) -> bool) -> CounterValues {
        let waiting = async {
            while !such(&self.counters.values()) {
                tokio::time::sleep(std::time::Duration::from_millis(5)).await;
            }
        };
        let waited = tokio::time::timeout(LONG, waiting).await;
        assert!(waited.is_ok(), "{:?}", self.counters.values());
        self.counters.values()
    }
}

/// A Modbus client with a certificate.
pub struct SecureClient(pub TlsStream<TcpStream>);

impl SecureClient {
    pub async fn connect(address: SocketAddr, files: &TlsClientSettings) -> Result<Self, Reason> {
        let config = ClientKeeper::new("[client]", files.clone(), Clock::start()).current().unwrap();
        let stream = TcpStream::connect(address).await.unwrap();
        let host = rustls::pki_types::ServerName::try_from("127.0.0.1").unwrap();
        let connected = TlsConnector::from(config).connect(host, stream).await;
        connected.map(Self).map_err(|error| Reason::of_handshake(&error))
    }

    /// Asks for something of unit 247: the answer's PDU, or why there is none.
    pub async fn ask(&mut self, pdu: &[u8]) -> Result<Vec<u8>, Reason> {
        let asking = async {
            self.0.write_all(&frame(7, 247, pdu)).await?;
            self.0.flush().await?;
            let mut header = [0; 7];
            self.0.read_exact(&mut header).await?;
            let mut answer = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
            self.0.read_exact(&mut answer).await?;
            Ok(answer)
        };
        let asked = tokio::time::timeout(LONG, asking).await.expect("an answer or the end");
        asked.map_err(|error| Reason::of_handshake(&error))
    }
}
