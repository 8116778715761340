//! A program under test or a foreign one, with its output.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::wait::wait_for;

/// One line of output.
#[derive(Clone, Debug)]
pub struct Line {
    /// When it was read.
    pub at: Instant,
    /// Without its end.
    pub text: String,
}

type Lines = Arc<Mutex<Vec<Line>>>;

/// A running program. Killed when dropped; when a test fails, the end of its output is shown.
pub struct Process {
    name: String,
    child: Child,
    stdout: Lines,
    stderr: Lines,
}

impl Process {
    /// Starts it with all three streams in our hands.
    pub fn start(name: &str, command: &mut Command) -> Self {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("{name}: {command:?}: {error}"));
        let stdout = collect(child.stdout.take().unwrap());
        let stderr = collect(child.stderr.take().unwrap());
        Self { name: name.to_owned(), child, stdout, stderr }
    }

    /// Lines of its standard output from number `from` on, counted from 0.
    pub fn stdout(&self, from: usize) -> Vec<Line> {
        self.stdout.lock().unwrap().get(from..).unwrap_or_default().to_vec()
    }

    /// How many lines of standard output there are.
    pub fn stdout_count(&self) -> usize {
        self.stdout.lock().unwrap().len()
    }

    /// All lines of its standard error.
    pub fn stderr(&self) -> Vec<Line> {
        self.stderr.lock().unwrap().clone()
    }

    /// Writes a line to its standard input.
    pub fn say(&mut self, line: &str) {
        let stdin = self.child.stdin.as_mut().unwrap();
        writeln!(stdin, "{line}").and_then(|()| stdin.flush()).unwrap();
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(i32::try_from(self.child.id()).unwrap());
        kill(pid, signal).unwrap();
    }

    /// Waits for its end.
    pub fn wait(&mut self) -> ExitStatus {
        let name = self.name.clone();
        wait_for(format!("the end of {name}"), || self.child.try_wait().unwrap())
    }

    /// Asks it to end and waits.
    pub fn terminate(&mut self) -> ExitStatus {
        self.signal(Signal::SIGTERM);
        self.wait()
    }

    /// Ends it without asking.
    pub fn kill(&mut self) {
        self.signal(Signal::SIGKILL);
        self.wait();
    }

    /// Whether it is still there.
    pub fn runs(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            for (stream, lines) in [("stdout", &self.stdout), ("stderr", &self.stderr)] {
                let lines = lines.lock().unwrap();
                let last = &lines[lines.len().saturating_sub(25)..];
                eprintln!("--- {} {stream}, last {} of {} lines", self.name, last.len(), lines.len());
                for line in last {
                    eprintln!("{}", line.text);
                }
            }
        }
    }
}

fn collect(stream: impl Read + Send + 'static) -> Lines {
    let lines = Lines::default();
    let into = lines.clone();
    std::thread::spawn(move || {
        for text in BufReader::new(stream).split(b'\n').map_while(Result::ok) {
            let text = String::from_utf8_lossy(&text).into_owned();
            into.lock().unwrap().push(Line { at: Instant::now(), text });
        }
    });
    lines
}

/// Runs a program to its end: whether it went well, standard output, standard error.
pub fn run(program: &str, arguments: &[&str]) -> (bool, String, String) {
    let output = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .unwrap_or_else(|error| panic!("{program}: {error}"));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.success(), text(&output.stdout), text(&output.stderr))
}

/// A TCP port of 127.0.0.1 at which nobody listens, given to nobody else.
pub fn free_port() -> u16 {
    super::ports::free_address().port()
}
