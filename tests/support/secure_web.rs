//! The page over TLS, with a plant's authority and files.

use std::net::SocketAddr;
use std::sync::Arc;

use cangate::gateway::Desk;
use cangate::mapping::TagTable;
use cangate::process_image::{ImageReader, ImageWriter, process_image};
use cangate::time::Clock;
use cangate::tls::{ClientKeeper, Reason, TlsClientSettings};
use cangate::web::{About, ProgramHealth, Server, WebSettings, WebState, WebTls};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_util::sync::CancellationToken;

use super::pki::{Authority, Folder, Pair};
use super::plant;

/// What a server shows to whom its desk knows.
pub fn state(table: Arc<TagTable>, desk: Desk) -> (WebState, ImageWriter) {
    let (writer, reader) = process_image(plant::image(&table));
    (state_of(table, reader, desk, Clock::start()), writer)
}

/// The same of a gateway that runs.
pub fn state_of(table: Arc<TagTable>, reader: ImageReader, desk: Desk, clock: Clock) -> WebState {
    WebState {
        table,
        reader,
        desk,
        clock,
        about: About::default(),
        health: Arc::new(ProgramHealth::default),
        map_json: "{}".into(),
        map_csv: "".into(),
    }
}

/// A server that runs, and what its clients need.
pub struct SecureWeb {
    pub folder: Folder,
    pub authority: Authority,
    pub address: SocketAddr,
    pub desk: Desk,
    pub stop: CancellationToken,
    pub task: JoinHandle<()>,
    _writer: ImageWriter,
}

/// Certificate and key of a gateway, in a folder.
pub fn files(folder: &Folder, authority: &Authority) -> WebTls {
    let (cert_file, key_file) = folder.write_pair("gateway", &authority.host());
    WebTls { cert_file, key_file }
}

impl SecureWeb {
    pub async fn start() -> Self {
        Self::start_with(Authority::host).await
    }

    /// With this certificate.
    pub async fn start_with(make: impl FnOnce(&Authority) -> Pair) -> Self {
        let (folder, authority) = (Folder::new(), Authority::new("plant"));
        let (cert_file, key_file) = folder.write_pair("gateway", &make(&authority));
        let tls = WebTls { cert_file, key_file };
        folder.write("ca.pem", &authority.pem);
        let settings = WebSettings { listen: "127.0.0.1:0".parse().unwrap(), tls, ..WebSettings::default() };
        let desk = Desk::new(1).0;
        let (state, writer) = state(plant::table(1), desk.clone());
        let server = Server::bind(&settings, state).await.unwrap();
        assert_eq!(server.url(), format!("https://{}/", server.local_addr()));
        let (address, stop) = (server.local_addr(), CancellationToken::new());
        let task = tokio::spawn(server.run(stop.clone()));
        Self { folder, authority, address, desk, stop, task, _writer: writer }
    }

    pub async fn connect(&self) -> Result<TlsStream<TcpStream>, Reason> {
        let ca_file = Some(self.folder.write("trusted.pem", &self.authority.pem));
        connect(self.address, TlsClientSettings { ca_file, ..TlsClientSettings::default() }).await
    }

    /// Code and body.
    pub async fn get(&self, path: &str) -> Result<(u16, String), Reason> {
        let mut stream = self.connect().await?;
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        let asking = async {
            stream.write_all(request.as_bytes()).await?;
            let mut answer = String::new();
            stream.read_to_string(&mut answer).await?;
            Ok(answer)
        };
        let answer: String = asking.await.map_err(|error| Reason::of_handshake(&error))?;
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        Ok((head[9..12].parse().unwrap(), body.to_owned()))
    }
}

/// A client that looks at the certificate.
pub async fn connect(address: SocketAddr, files: TlsClientSettings) -> Result<TlsStream<TcpStream>, Reason> {
    let config = ClientKeeper::new("[client]", files, Clock::start()).current().unwrap();
    let stream = TcpStream::connect(address).await.unwrap();
    let host = rustls::pki_types::ServerName::try_from("127.0.0.1").unwrap();
    TlsConnector::from(config).connect(host, stream).await.map_err(|error| Reason::of_handshake(&error))
}
