//! Serial lines without a module: a made-up table, an image that the test fills, a desk at which the test sits.

use std::net::SocketAddr;
use std::sync::Arc;

use cangate::gateway::Command;
use cangate::gateway::command::{Action, CommandSource, Desk, Outcome};
use cangate::mapping::{LineDef, LineMqtt, LineTcp, TagTable};
use cangate::process_image::{
    ImageReader, ImageWriter, LineIndex, NodeIndex, Revision, SerialLine, process_image,
};
use cangate::slots::AllowList;
use cangate::time::Timestamp;
use tokio::sync::{mpsc, oneshot};

use super::{PATIENCE, plant};

/// Line 1 of the first engine of `plant`.
pub fn line() -> LineDef {
    LineDef {
        node: NodeIndex(0),
        channel: 0,
        number: 1,
        description: String::new(),
        tcp: None,
        mqtt: LineMqtt::default(),
        text: None,
    }
}

/// A port of any free number on this host, at which everybody may write.
pub fn tcp() -> LineTcp {
    let listen = SocketAddr::from(([127, 0, 0, 1], 0));
    LineTcp { listen, allow: AllowList::default(), max_connections: 8, write: true }
}

/// The table of `plant` with two engines, and these lines.
pub fn table(lines: Vec<LineDef>) -> Arc<TagTable> {
    let mut table = (*plant::table(2)).clone();
    table.lines = lines;
    Arc::new(table)
}

/// The gateway's end: what lines receive, and what is asked of them.
pub struct Bench {
    pub writer: ImageWriter,
    pub reader: ImageReader,
    pub desk: Desk,
    pub commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
}

/// What was asked for: who, which line, the bytes, and where the answer goes.
pub struct Asked {
    pub source: CommandSource,
    pub line: LineIndex,
    pub bytes: Vec<u8>,
    reply: oneshot::Sender<Outcome>,
}

impl Asked {
    pub fn answer(self, outcome: Outcome) {
        // Who asked may have gone.
        let _ = self.reply.send(outcome);
    }
}

impl Bench {
    /// All lines are open.
    pub fn new(table: &TagTable) -> Self {
        let mut image = plant::image(table);
        let mut line = SerialLine::default();
        line.open = true;
        image.lines = vec![line; table.lines.len()];
        let (writer, reader) = process_image(image);
        let (desk, commands) = Desk::new(32);
        Self { writer, reader, desk, commands }
    }

    /// Changes a line.
    pub fn change(&mut self, line: usize, change: impl FnOnce(&mut SerialLine)) {
        self.writer.apply(|image| {
            image.revision = Revision(image.revision.0 + 1);
            change(&mut image.lines[line]);
        });
    }

    /// Bytes come in on line 0.
    pub fn receive(&mut self, bytes: &[u8]) {
        self.change(0, |line| line.append(bytes));
    }

    /// A message came in on line 0, at so many milliseconds.
    pub fn message(&mut self, millis: i64, bytes: &[u8], end: &'static str) {
        self.change(0, |line| {
            line.append(bytes);
            line.append_message(Timestamp::from_millis(millis), bytes.to_vec(), end);
        });
    }

    pub fn open(&mut self, open: bool) {
        self.change(0, |line| line.open = open);
    }

    /// Waits for what is asked next.
    pub async fn asked(&mut self) -> Asked {
        let asked = tokio::time::timeout(PATIENCE, self.commands.recv()).await.expect("nothing is asked");
        let (Command { source, action, .. }, reply) = asked.unwrap();
        let Action::SerialSend { line, bytes } = action else { panic!("{action:?}") };
        Asked { source, line, bytes, reply }
    }

    /// Takes bytes, and answers that they went out, until there are so many.
    pub async fn take(&mut self, count: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        while bytes.len() < count {
            let asked = self.asked().await;
            bytes.extend(&asked.bytes);
            asked.answer(Outcome::Done);
        }
        bytes
    }

    /// Whether nothing is asked that was not looked at.
    pub fn is_quiet(&mut self) -> bool {
        self.commands.try_recv().is_err()
    }
}
