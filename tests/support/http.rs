//! One request of HTTP and its answer, over whatever stream.

use serde_json::Value;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

/// What is answered.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer {
    pub code: u16,
    pub head: String,
    pub body: String,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }

    /// What a browser keeps, as it sends it back.
    pub fn cookie(&self) -> String {
        let set = self.head.lines().find_map(|line| line.strip_prefix("set-cookie: ")).unwrap();
        format!("Cookie: theme=dark; {}\r\n", set.split(';').next().unwrap())
    }
}

/// Asks and hears the answer, which carries the careful headers.
pub async fn converse(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    line: &str,
    headers: &str,
    body: &str,
) -> Answer {
    let length = body.len();
    let request = format!(
        "{line} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}Content-Length: {length}\r\n\r\n{body}"
    );
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).await.unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    for header in ["nosniff", "no-store", "frame-ancestors 'none'", "no-referrer"] {
        assert!(head.contains(header), "{header}: {head}");
    }
    // The time of day is no part of what is answered.
    let lines = head.lines().filter(|line| !line.starts_with("date: "));
    let head = lines.collect::<Vec<_>>().join("\r\n");
    Answer { code: head[9..12].parse().unwrap(), head, body: body.to_owned() }
}
