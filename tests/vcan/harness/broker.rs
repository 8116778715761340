//! A real broker (mosquitto) and a real subscriber (mosquitto_sub).

use std::fs;
use std::net::TcpStream;
use std::process::Command;
use std::time::Instant;

use serde_json::Value;
use tempfile::TempDir;

use super::process::{Process, free_port};
use super::wait::{wait_for, wait_until};

/// mosquitto on a port of its own.
pub struct Broker {
    /// Where it listens.
    pub port: u16,
    /// The network namespace that it and its clients are in; `None` = that of the test.
    namespace: Option<&'static str>,
    folder: TempDir,
    process: Process,
}

/// A program, in a network namespace where one is named.
fn program(namespace: Option<&str>, name: &str) -> Command {
    let Some(namespace) = namespace else { return Command::new(name) };
    let mut command = Command::new("ip");
    command.args(["netns", "exec", namespace, name]);
    command
}

impl Broker {
    /// Starts it and waits until it listens.
    pub fn start() -> Self {
        let port = free_port();
        let broker = Self::spawn_new(port, None, &format!("listener {port} 127.0.0.1\n"));
        broker.wait_until_it_listens();
        broker
    }

    /// Starts it in a network namespace, where it listens on this address and on 127.0.0.1. A [`Subscriber`] finds it there.
    pub fn start_in(namespace: &'static str, address: &str) -> Self {
        let port = 1883;
        let listeners = format!("listener {port} 127.0.0.1\nlistener {port} {address}\n");
        let broker = Self::spawn_new(port, Some(namespace), &listeners);
        wait_until("mosquitto to listen", || broker.try_publish("probe", "0"));
        broker
    }

    fn spawn_new(port: u16, namespace: Option<&'static str>, listeners: &str) -> Self {
        let folder = TempDir::new().unwrap();
        let settings =
            format!("{listeners}allow_anonymous true\nuser root\npersistence false\nlog_type error\n");
        fs::write(folder.path().join("mosquitto.conf"), settings).unwrap();
        let process = Self::spawn(&folder, namespace);
        Self { port, namespace, folder, process }
    }

    fn spawn(folder: &TempDir, namespace: Option<&str>) -> Process {
        let file = folder.path().join("mosquitto.conf");
        Process::start("mosquitto", program(namespace, "mosquitto").arg("-c").arg(file))
    }

    fn wait_until_it_listens(&self) {
        wait_until("mosquitto to listen", || TcpStream::connect(("127.0.0.1", self.port)).is_ok());
    }

    /// Kills it with signal 9: it can say goodbye to nobody and save nothing.
    pub fn kill(&mut self) {
        self.process.kill();
    }

    /// Starts it again after [`kill`](Self::kill), empty.
    pub fn restart(&mut self) {
        self.process = Self::spawn(&self.folder, self.namespace);
        self.wait_until_it_listens();
    }

    /// Publishes with mosquitto_pub.
    pub fn publish(&self, topic: &str, payload: &str) {
        assert!(self.try_publish(topic, payload), "mosquitto_pub {topic}");
    }

    fn try_publish(&self, topic: &str, payload: &str) -> bool {
        let port = self.port.to_string();
        let arguments = ["-h", "127.0.0.1", "-p", &port, "-t", topic, "-m", payload, "-q", "1"];
        program(self.namespace, "mosquitto_pub").args(arguments).output().unwrap().status.success()
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
        let mut command = program(broker.namespace, "mosquitto_sub");
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
            broker.try_publish("probe", "0");
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
