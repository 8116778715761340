//! A real broker (mosquitto) and a real subscriber (mosquitto_sub).

use std::fs;
use std::net::TcpStream;
use std::process::Command;
use std::time::Instant;

use serde_json::Value;
use tempfile::TempDir;

use super::process::{Process, free_port, run};
use super::wait::{wait_for, wait_until};

/// mosquitto on a port of its own.
pub struct Broker {
    /// Where it listens.
    pub port: u16,
    folder: TempDir,
    process: Process,
}

impl Broker {
    /// Starts it and waits until it listens.
    pub fn start() -> Self {
        let folder = TempDir::new().unwrap();
        let port = free_port();
        let settings = format!(
            "listener {port} 127.0.0.1\nallow_anonymous true\nuser root\npersistence false\nlog_type error\n"
        );
        fs::write(folder.path().join("mosquitto.conf"), settings).unwrap();
        let process = Self::spawn(&folder, port);
        Self { port, folder, process }
    }

    fn spawn(folder: &TempDir, port: u16) -> Process {
        let file = folder.path().join("mosquitto.conf");
        let process = Process::start("mosquitto", Command::new("mosquitto").arg("-c").arg(file));
        wait_until("mosquitto to listen", || TcpStream::connect(("127.0.0.1", port)).is_ok());
        process
    }

    /// Kills it with signal 9: it can say goodbye to nobody and save nothing.
    pub fn kill(&mut self) {
        self.process.kill();
    }

    /// Starts it again after [`kill`](Self::kill), empty.
    pub fn restart(&mut self) {
        self.process = Self::spawn(&self.folder, self.port);
    }

    /// Publishes with mosquitto_pub.
    pub fn publish(&self, topic: &str, payload: &str) {
        let port = self.port.to_string();
        let (good, _, stderr) =
            run("mosquitto_pub", &["-h", "127.0.0.1", "-p", &port, "-t", topic, "-m", payload, "-q", "1"]);
        assert!(good, "mosquitto_pub: {stderr}");
    }
}

/// A message as the subscriber saw it.
#[derive(Clone, Debug)]
pub struct Message {
    /// When.
    pub at: Instant,
    /// Whether the broker had kept it from before the subscription.
    pub retained: bool,
    /// Its topic, below base and gateway name where it has them.
    pub topic: String,
    /// Its payload.
    pub payload: Value,
}

/// mosquitto_sub on all topics.
pub struct Subscriber {
    process: Process,
    prefix: String,
}

impl Subscriber {
    /// Subscribes to everything. `prefix`, for example `cangate/hall-1/`, is cut off topics that have it.
    pub fn start(broker: &Broker, prefix: &str) -> Self {
        let port = broker.port.to_string();
        let mut command = Command::new("mosquitto_sub");
        command.args(["-h", "127.0.0.1", "-p", &port, "-q", "0", "-t", "#", "-F", "%r %t %p"]);
        let subscriber =
            Self { process: Process::start("mosquitto_sub", &mut command), prefix: prefix.to_owned() };
        subscriber.wait_until_subscribed(broker);
        subscriber
    }

    /// Waits until what is published arrives, for example after the broker came back.
    pub fn wait_until_subscribed(&self, broker: &Broker) {
        let before = self.count();
        wait_until("mosquitto_sub to be subscribed", || {
            broker.publish("probe", "0");
            self.since(before).iter().any(|message| message.topic == "probe")
        });
    }

    /// How many messages came so far.
    pub fn count(&self) -> usize {
        self.process.stdout_count()
    }

    /// Messages from number `from` on.
    pub fn since(&self, from: usize) -> Vec<Message> {
        let read = |text: &str| {
            let (retained, rest) = text.split_once(' ')?;
            let (topic, payload) = rest.split_once(' ')?;
            let topic = topic.strip_prefix(self.prefix.as_str()).unwrap_or(topic).to_owned();
            let payload = serde_json::from_str(payload).unwrap_or_else(|_| Value::String(payload.to_owned()));
            Some((retained == "1", topic, payload))
        };
        self.process
            .stdout(from)
            .iter()
            .filter_map(|line| {
                let (retained, topic, payload) = read(&line.text)?;
                Some(Message { at: line.at, retained, topic, payload })
            })
            .collect()
    }

    /// Messages of a topic from number `from` on.
    pub fn of(&self, topic: &str, from: usize) -> Vec<Message> {
        self.since(from).into_iter().filter(|message| message.topic == topic).collect()
    }

    /// Waits for a message of a topic that is as wanted, from number `from` on.
    pub fn wait_for(&self, topic: &str, from: usize, wanted: impl Fn(&Value) -> bool) -> Message {
        wait_for(format!("a message {topic} as wanted; so far {:?}", self.of(topic, from).last()), || {
            self.of(topic, from).into_iter().find(|message| wanted(&message.payload))
        })
    }

    /// Waits for an event of a name.
    pub fn wait_for_event(&self, name: &str, from: usize) -> Message {
        self.wait_for("event", from, |payload| payload["name"] == name)
    }
}
