//! A broker that misbehaves on purpose: one script for each connection, the last one for all that follow.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

/// What the broker does with one connection.
#[derive(Clone, Debug)]
pub enum Script {
    /// CONNACK, and a PUBACK for every message.
    Good,
    /// As `Good`, but the connection ends after so many messages, the last of them not acknowledged.
    CloseAfter(usize),
    /// Messages are acknowledged in groups of this size, the newest first.
    OutOfOrder(usize),
    /// CONNACK, PINGRESP, but never a PUBACK.
    NeverAcknowledge,
    /// Acknowledges what was never sent.
    WrongAcknowledge,
    /// Reads, and says nothing at all.
    Silent,
    /// Refuses with this code.
    Refuse(u8),
    /// Sends these bytes in place of, or after, the CONNACK.
    Garbage { after_connack: bool, bytes: Vec<u8> },
}

/// A message as it came.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    pub connection: usize,
    pub topic: String,
    pub payload: String,
    pub qos: u8,
    pub retain: bool,
}

/// A packet that is not a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Control {
    Connect(Vec<u8>),
    Disconnect,
}

#[derive(Debug, Default)]
pub struct Seen {
    pub connections: usize,
    /// Of those: over.
    pub closed: usize,
    pub messages: Vec<Received>,
    pub control: Vec<(usize, Control)>,
}

pub struct FakeBroker {
    pub address: SocketAddr,
    seen: Arc<Mutex<Seen>>,
    task: JoinHandle<()>,
}

impl FakeBroker {
    pub async fn start(scripts: Vec<Script>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let seen = Arc::new(Mutex::new(Seen::default()));
        let shared = Arc::clone(&seen);
        let task = tokio::spawn(async move {
            let mut connections = tokio::task::JoinSet::new();
            loop {
                let (stream, _) = listener.accept().await.unwrap();
                let number = {
                    let mut seen = shared.lock().unwrap();
                    seen.connections += 1;
                    seen.connections - 1
                };
                let script = scripts[number.min(scripts.len() - 1)].clone();
                let seen = Arc::clone(&shared);
                connections.spawn(async move {
                    serve(stream, number, script, &seen).await;
                    seen.lock().unwrap().closed += 1;
                });
            }
        });
        Self { address, seen, task }
    }

    pub fn seen<T>(&self, look: impl FnOnce(&Seen) -> T) -> T {
        look(&self.seen.lock().unwrap())
    }

    /// Payloads of a topic in the order in which they came, with the connection that brought them.
    pub fn payloads(&self, topic: &str) -> Vec<(usize, String)> {
        self.seen(|seen| {
            let of_topic = seen.messages.iter().filter(|message| message.topic.ends_with(topic));
            of_topic.map(|message| (message.connection, message.payload.clone())).collect()
        })
    }
}

impl Drop for FakeBroker {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Reads one packet: its first byte and its body.
pub async fn read_packet(stream: &mut (impl AsyncRead + Unpin)) -> Option<(u8, Vec<u8>)> {
    let first = stream.read_u8().await.ok()?;
    let mut length = 0usize;
    for shift in [0, 7, 14, 21] {
        let byte = stream.read_u8().await.ok()?;
        length |= usize::from(byte & 0x7F) << shift;
        if byte & 0x80 == 0 {
            break;
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).await.ok()?;
    Some((first, body))
}

/// A PUBLISH and its packet id.
pub fn read_publish(connection: usize, first: u8, body: &[u8]) -> (Received, [u8; 2]) {
    let qos = (first >> 1) & 3;
    let length = usize::from(u16::from_be_bytes([body[0], body[1]]));
    let id = body[2 + length..].first_chunk::<2>().copied().unwrap_or_default();
    let payload = 2 + length + if qos == 0 { 0 } else { 2 };
    let message = Received {
        connection,
        topic: String::from_utf8(body[2..2 + length].to_vec()).unwrap(),
        payload: String::from_utf8(body[payload..].to_vec()).unwrap(),
        qos,
        retain: first & 1 == 1,
    };
    (message, id)
}

async fn serve(mut stream: TcpStream, connection: usize, script: Script, seen: &Mutex<Seen>) -> Option<()> {
    let mut held = Vec::new();
    let mut messages = 0;
    loop {
        let (first, body) = read_packet(&mut stream).await?;
        match first >> 4 {
            1 => {
                seen.lock().unwrap().control.push((connection, Control::Connect(body)));
                match &script {
                    Script::Silent => {}
                    Script::Refuse(code) => stream.write_all(&[0x20, 2, 0, *code]).await.ok()?,
                    Script::Garbage { after_connack, bytes } => {
                        if *after_connack {
                            stream.write_all(&[0x20, 2, 0, 0]).await.ok()?;
                        }
                        stream.write_all(bytes).await.ok()?;
                    }
                    _ => stream.write_all(&[0x20, 2, 0, 0]).await.ok()?,
                }
            }
            3 => {
                let (message, id) = read_publish(connection, first, &body);
                let qos = message.qos;
                seen.lock().unwrap().messages.push(message);
                messages += 1;
                held.push(id);
                let group = match &script {
                    Script::CloseAfter(limit) if messages >= *limit => return None,
                    Script::Good | Script::CloseAfter(_) => 1,
                    Script::OutOfOrder(group) => *group,
                    Script::WrongAcknowledge => {
                        stream.write_all(&[0x40, 2, 0xEE, 0xEE]).await.ok()?;
                        usize::MAX
                    }
                    _ => usize::MAX,
                };
                if held.len() >= group {
                    for [high, low] in held.drain(..).rev() {
                        if qos == 1 {
                            stream.write_all(&[0x40, 2, high, low]).await.ok()?;
                        }
                    }
                }
            }
            12 => stream.write_all(&[0xD0, 0]).await.ok()?,
            14 => {
                seen.lock().unwrap().control.push((connection, Control::Disconnect));
                return None;
            }
            _ => {}
        }
    }
}
