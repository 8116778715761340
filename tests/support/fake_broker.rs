//! A broker that misbehaves on purpose: one script for each connection, the last one for all that follow. It speaks MQTT 3.1.1
//! or 5, as it is spoken to.

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
    /// As `Good`, with a retained message of this many bytes on whatever is subscribed.
    LargeRetained(usize),
    /// Messages are acknowledged in groups of this size, the newest first.
    OutOfOrder(usize),
    /// CONNACK, PINGRESP, but never a PUBACK.
    NeverAcknowledge,
    /// Acknowledges what was never sent.
    WrongAcknowledge,
    /// Reads, and says nothing at all.
    Silent,
    /// Speaks MQTT 3.1.1 only, says so, and ends the connection.
    OldVersion,
    /// Refuses with this code.
    Refuse(u8),
    /// With these properties in the CONNACK of MQTT 5; as `Good`, or else as `NeverAcknowledge`.
    Properties { good: bool, bytes: Vec<u8> },
    /// As `Good`, but what goes to topics that end so is acknowledged with this reason of MQTT 5.
    RefuseMessages(&'static str, u8),
    /// As `Good`, but after so many messages the session is ended with this reason of MQTT 5.
    DisconnectAfter(usize, u8),
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
    /// Of MQTT 5, as they came.
    pub properties: Vec<u8>,
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
    /// Topics of all subscriptions; each is granted.
    pub subscribed: Vec<String>,
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

/// A PUBLISH of MQTT 3.1.1, and its packet id.
pub fn read_publish(connection: usize, first: u8, body: &[u8]) -> (Received, [u8; 2]) {
    read_publish_of(4, connection, first, body)
}

fn read_publish_of(level: u8, connection: usize, first: u8, body: &[u8]) -> (Received, [u8; 2]) {
    let qos = (first >> 1) & 3;
    let length = usize::from(u16::from_be_bytes([body[0], body[1]]));
    let id = body[2 + length..].first_chunk::<2>().copied().unwrap_or_default();
    let rest = &body[2 + length + if qos == 0 { 0 } else { 2 }..];
    let (properties, payload) = if level == 5 { split_properties(rest) } else { rest.split_at(0) };
    let message = Received {
        connection,
        topic: String::from_utf8(body[2..2 + length].to_vec()).unwrap(),
        payload: String::from_utf8(payload.to_vec()).unwrap(),
        qos,
        retain: first & 1 == 1,
        properties: properties.to_vec(),
    };
    (message, id)
}

/// Properties of MQTT 5, and what stands behind them. There are less than 16 KiB of them.
fn split_properties(bytes: &[u8]) -> (&[u8], &[u8]) {
    let low = usize::from(bytes[0] & 0x7F);
    let (length, rest) = if bytes[0] & 0x80 == 0 {
        (low, &bytes[1..])
    } else {
        (low | usize::from(bytes[1]) << 7, &bytes[2..])
    };
    rest.split_at(length)
}

/// The topics of a SUBSCRIBE.
fn read_subscribe(level: u8, body: &[u8]) -> Vec<String> {
    let mut topics = Vec::new();
    let mut rest = if level == 5 { split_properties(&body[2..]).1 } else { &body[2..] };
    while let [high, low, after @ ..] = rest {
        let (topic, after) = after.split_at(usize::from(u16::from_be_bytes([*high, *low])));
        topics.push(String::from_utf8(topic.to_vec()).unwrap());
        // The quality of service.
        rest = &after[1..];
    }
    topics
}

/// A retained PUBLISH, quality of service 0, of so many bytes.
fn retained(level: u8, topic: &str, length: usize) -> Vec<u8> {
    let no_properties: &[u8] = if level == 5 { &[0] } else { &[] };
    let mut rest = 2 + topic.len() + no_properties.len() + length;
    let mut packet = vec![0x31];
    while rest > 0x7F {
        packet.push(u8::try_from(rest & 0x7F).unwrap() | 0x80);
        rest >>= 7;
    }
    packet.push(u8::try_from(rest).unwrap());
    packet.extend(u16::try_from(topic.len()).unwrap().to_be_bytes());
    packet.extend(topic.as_bytes());
    packet.extend(no_properties);
    packet.resize(packet.len() + length, b'x');
    packet
}

/// A CONNACK with a code; `properties` only with MQTT 5.
fn connack(level: u8, code: u8, properties: &[u8]) -> Vec<u8> {
    if level != 5 {
        return vec![0x20, 2, 0, code];
    }
    let length = u8::try_from(properties.len()).unwrap();
    let mut packet = vec![0x20, 3 + length, 0, code, length];
    packet.extend(properties);
    packet
}

/// A PUBACK; a `reason` that is not 0 is told with MQTT 5 only.
fn puback([high, low]: [u8; 2], reason: u8) -> Vec<u8> {
    if reason == 0 { vec![0x40, 2, high, low] } else { vec![0x40, 3, high, low, reason] }
}

async fn serve(mut stream: TcpStream, connection: usize, script: Script, seen: &Mutex<Seen>) -> Option<()> {
    let mut held = Vec::new();
    let mut messages = 0;
    // Of the protocol: 4 is MQTT 3.1.1.
    let mut level = 4;
    loop {
        let (first, body) = read_packet(&mut stream).await?;
        match first >> 4 {
            1 => {
                level = body[6];
                seen.lock().unwrap().control.push((connection, Control::Connect(body)));
                match &script {
                    Script::Silent => {}
                    Script::OldVersion => {
                        stream.write_all(&connack(4, 1, &[])).await.ok()?;
                        return None;
                    }
                    Script::Refuse(code) => stream.write_all(&connack(level, *code, &[])).await.ok()?,
                    Script::Garbage { after_connack, bytes } => {
                        if *after_connack {
                            stream.write_all(&connack(level, 0, &[])).await.ok()?;
                        }
                        stream.write_all(bytes).await.ok()?;
                    }
                    Script::Properties { bytes, .. } => {
                        stream.write_all(&connack(level, 0, bytes)).await.ok()?;
                    }
                    _ => stream.write_all(&connack(level, 0, &[])).await.ok()?,
                }
            }
            3 => {
                let (message, id) = read_publish_of(level, connection, first, &body);
                let qos = message.qos;
                let reason = match &script {
                    Script::RefuseMessages(topic, reason) if message.topic.ends_with(topic) => *reason,
                    _ => 0,
                };
                seen.lock().unwrap().messages.push(message);
                messages += 1;
                held.push((id, reason));
                let group = match &script {
                    Script::CloseAfter(limit) if messages >= *limit => return None,
                    Script::DisconnectAfter(limit, reason) if messages >= *limit => {
                        stream.write_all(&[0xE0, 2, *reason, 0]).await.ok()?;
                        // A connection that ends with bytes unread is reset, and with it goes what was written.
                        while read_packet(&mut stream).await.is_some() {}
                        return None;
                    }
                    Script::OutOfOrder(group) => *group,
                    Script::WrongAcknowledge => {
                        stream.write_all(&[0x40, 2, 0xEE, 0xEE]).await.ok()?;
                        usize::MAX
                    }
                    Script::NeverAcknowledge
                    | Script::Properties { good: false, .. }
                    | Script::Silent
                    | Script::OldVersion
                    | Script::Refuse(_)
                    | Script::Garbage { .. } => usize::MAX,
                    Script::Good
                    | Script::CloseAfter(_)
                    | Script::LargeRetained(_)
                    | Script::Properties { good: true, .. }
                    | Script::RefuseMessages(..)
                    | Script::DisconnectAfter(..) => 1,
                };
                if held.len() >= group {
                    for (id, reason) in held.drain(..).rev() {
                        if qos == 1 {
                            stream.write_all(&puback(id, reason)).await.ok()?;
                        }
                    }
                }
            }
            8 => {
                let topics = read_subscribe(level, &body);
                let no_properties: &[u8] = if level == 5 { &[0] } else { &[] };
                let length = 2 + no_properties.len() + topics.len();
                let mut answer = vec![0x90, u8::try_from(length).unwrap(), body[0], body[1]];
                answer.extend(no_properties);
                answer.resize(answer.len() + topics.len(), 1);
                let topic = topics.first().cloned().unwrap_or_default();
                seen.lock().unwrap().subscribed.extend(topics);
                stream.write_all(&answer).await.ok()?;
                if let Script::LargeRetained(length) = script {
                    stream.write_all(&retained(level, &topic, length)).await.ok()?;
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
