//! Listens for each line that has a TCP port; wakes the connections. \[IO\]

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use nix::sys::socket::{setsockopt, sockopt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::connection::{self, Client, Line, News};
use super::end;
use super::seat::Seat;
use super::told::Told;
use crate::gateway::command::Desk;
use crate::mapping::{BusDef, LineDef, TagTable};
use crate::process_image::{ImageReader, LineIndex, ProcessImage};
use crate::slots::{BindError, Clients, Limits, Place, ServerName, Service, listening};
use crate::time::Clock;

/// The TCP ports of all serial lines; they listen already.
#[derive(Debug)]
pub struct Server {
    doors: Vec<Door>,
    reader: ImageReader,
}

/// The TCP port of one line.
#[derive(Debug)]
struct Door {
    name: ServerName,
    listener: TcpListener,
    address: SocketAddr,
    limits: Limits,
    port: Port,
}

/// What each connection to it is served with.
#[derive(Debug)]
struct Port {
    line: Line,
    news: watch::Sender<News>,
    /// Connections so far: the number of the last.
    connections: AtomicU64,
}

/// Bytes that the system holds of what a client is given: with more, a client that takes nothing would look for minutes
/// like one that takes all.
const SEND_BUFFER: usize = 65_536;

impl Server {
    /// Listens for every line of the table that has a TCP port.
    ///
    /// # Errors
    /// The first address that cannot be listened on.
    pub async fn bind(
        table: &TagTable,
        desk: &Desk,
        reader: &ImageReader,
        clock: Clock,
    ) -> Result<Self, BindError> {
        let mut doors = Vec::new();
        for (index, def) in table.lines.iter().enumerate() {
            let Some(tcp) = &def.tcp else { continue };
            let node = table.node(def.node).map_or("", |node| node.name.as_str());
            let name = ServerName {
                what: format!("serial line {} of `{node}`", def.number),
                table: format!("[node.{node}.channel.{}]", def.number),
            };
            let listener = listening::bind(&name, tcp.listen).await?;
            let address = listener.local_addr().unwrap_or(tcp.listen);
            let line = Line {
                name: name.what.clone(),
                index: LineIndex(index),
                mute: mute(table, def),
                seat: Seat::default(),
                told: Told::default().into(),
                reader: reader.clone(),
                desk: desk.clone(),
                clock,
            };
            let port =
                Port { line, news: watch::Sender::new(News::default()), connections: AtomicU64::new(0) };
            let limits = Limits { allow: tcp.allow.clone(), ..Limits::places(tcp.max_connections.into()) };
            doors.push(Door { name, listener, address, limits, port });
        }
        Ok(Self { doors, reader: reader.clone() })
    }

    /// Each line that has a port: its name for people, and where it listens; port 0 has become a real one.
    pub fn addresses(&self) -> impl Iterator<Item = (&str, SocketAddr)> {
        self.doors.iter().map(|door| (door.name.what.as_str(), door.address))
    }

    /// Serves until `stop`. Connections end with it.
    ///
    /// # Panics
    /// Where serving a client panicked, which is a bug of ours: it ends the server, and the supervisor tells.
    pub async fn run(self, stop: CancellationToken) {
        if self.doors.is_empty() {
            return stop.cancelled().await;
        }
        let mut doors = JoinSet::new();
        let mut ports = Vec::new();
        for Door { name, listener, limits, port, .. } in self.doors {
            let port = Arc::new(port);
            ports.push(Arc::clone(&port));
            let clients = Clients::new(name, limits, stop.clone());
            doors.spawn(listening::serve(vec![listener], clients, port));
        }
        let waking = tokio::spawn(wake(self.reader, ports));
        while let Some(ended) = doors.join_next().await {
            if let Err(error) = ended
                && let Ok(panic) = error.try_into_panic()
            {
                std::panic::resume_unwind(panic);
            }
        }
        waking.abort();
    }
}

/// Tells the connections what is new of their lines, until the writer of the image is gone. One reader for all, so that a
/// change of a value somewhere does not wake every connection.
async fn wake(mut reader: ImageReader, ports: Vec<Arc<Port>>) {
    let indices: Vec<LineIndex> = ports.iter().map(|port| port.line.index).collect();
    loop {
        // The image is looked at once for all.
        let all: Vec<News> =
            reader.read(|image| indices.iter().map(|index| news_of(image, *index)).collect());
        for (Port { line, news, .. }, now) in ports.iter().map(|port| &**port).zip(all) {
            let mut opened = None;
            news.send_if_modified(|told| {
                opened = (told.open != now.open).then_some(now.open);
                std::mem::replace(told, now) != now
            });
            match opened {
                Some(true) => tracing::info!("{}: open", line.name),
                Some(false) => {
                    tracing::warn!("{}: closed; what clients send waits until it is open again", line.name);
                }
                None => {}
            }
        }
        if !reader.changed().await {
            return;
        }
    }
}

fn news_of(image: &ProcessImage, line: LineIndex) -> News {
    let line = image.lines.get(line.0);
    line.map_or_else(News::default, |line| News { open: line.open, received: line.cursor() })
}

/// Why nothing that clients send ever goes out. A line of a passive gateway never opens: who waited for that would wait for ever.
fn mute(table: &TagTable, def: &LineDef) -> Option<&'static str> {
    let bus = table.node(def.node).and_then(|node| table.buses.get(node.bus.0));
    if bus.is_some_and(BusDef::is_passive) {
        return Some("the gateway is passive on this bus");
    }
    def.tcp.as_ref().is_some_and(|tcp| !tcp.write).then_some("`write` is off")
}

impl Service for Port {
    async fn serve(&self, stream: TcpStream, peer: SocketAddr, place: Place) -> &'static str {
        let line = &self.line;
        if let Err(error) = setsockopt(&stream, sockopt::SndBuf, &SEND_BUFFER) {
            tracing::debug!(%peer, %error, "{}: the send buffer stays as it is", line.name);
        }
        let number = self.connections.fetch_add(1, Ordering::Relaxed).saturating_add(1);
        let cursor = line.reader.read(|image| news_of(image, line.index)).received;
        let client = Client { number, peer, cursor, news: self.news.subscribe() };
        let end = connection::serve(stream, client, line, &place).await;
        end::tell(line, peer, &end);
        end.word()
    }
}
