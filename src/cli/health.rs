//! `cangate health`: asks a gateway over HTTP whether it is ready. \[IO\]
//!
//! An image made FROM scratch has no shell and no HTTP client, so the program asks itself. One request of HTTP 1.0 needs
//! no library. Over TLS the gateway of a configuration is asked on this host, whatever certificate it shows; the certificate
//! of one that is called by an address is looked at, with the authorities that the host trusts.

use std::fmt;
use std::io::{self, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream, ToSocketAddrs};
use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::{ClientConfig, ClientConnection, StreamOwned};

use super::args::HealthArguments;
use super::output::{print_error, print_line};
use super::{Exit, load};
use crate::config::DEFAULT_FILE;
use crate::tls::files::load_client;
use crate::tls::{Reason, TlsClientSettings, own_host};
use crate::web::WebSettings;

/// For the connection, and for each step of the answer.
const PATIENCE: Duration = Duration::from_secs(3);
/// An answer is not read beyond this many bytes.
const LONGEST_ANSWER: u64 = 16 * 1024;
/// What is asked when nothing else is.
const READY: &str = "/readyz";

/// Whether and how the other side has to show who it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scheme {
    /// Not at all.
    Http,
    /// By a certificate that is looked at.
    Https,
    /// By any certificate: it is on this host.
    HttpsHere,
}

impl Scheme {
    fn word(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::Https | Self::HttpsHere => "https",
        }
    }
}

/// `http://HOST[:PORT][/PATH]`, or the same with `https`; without a path `/readyz`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Url {
    scheme: Scheme,
    /// Host and port, as in `plant-a:8080` or `[::1]:80`.
    authority: String,
    /// Begins with `/`.
    path: String,
}

/// A text that is no such URL.
#[derive(Debug, thiserror::Error)]
#[error("write http://HOST:PORT/PATH or https://..., for example http://127.0.0.1:8080/readyz")]
pub struct UrlError;

impl FromStr for Url {
    type Err = UrlError;

    fn from_str(text: &str) -> Result<Self, UrlError> {
        let (scheme, rest, port) = match text.strip_prefix("https://") {
            Some(rest) => (Scheme::Https, rest, 443),
            None => (Scheme::Http, text.strip_prefix("http://").ok_or(UrlError)?, 80),
        };
        let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let odd = |character: char| character.is_whitespace() || character.is_control();
        if authority.is_empty() || authority.contains('@') || rest.contains(odd) {
            return Err(UrlError);
        }
        let has_port =
            authority.rsplit_once(':').is_some_and(|(host, _)| !host.contains(':') || host.ends_with(']'));
        let authority = if has_port { authority.to_owned() } else { format!("{authority}:{port}") };
        let path = if matches!(path, "" | "/") { READY } else { path };
        Ok(Self { scheme, authority, path: path.to_owned() })
    }
}

impl Url {
    /// `/readyz` of a gateway that listens there; one that listens everywhere is asked on this host.
    fn ready(listen: SocketAddr, scheme: Scheme) -> Self {
        let ip = match listen.ip() {
            ip if !ip.is_unspecified() => ip,
            IpAddr::V4(_) => IpAddr::V4(Ipv4Addr::LOCALHOST),
            IpAddr::V6(_) => IpAddr::V6(Ipv6Addr::LOCALHOST),
        };
        Self { scheme, authority: SocketAddr::new(ip, listen.port()).to_string(), path: READY.to_owned() }
    }

    fn host(&self) -> &str {
        let host = self.authority.rsplit_once(':').map_or(self.authority.as_str(), |(host, _)| host);
        host.trim_start_matches('[').trim_end_matches(']')
    }
}

impl fmt::Display for Url {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}{}", self.scheme.word(), self.authority, self.path)
    }
}

/// Asks, and says what came of it: 0 when the gateway is ready, 1 when not.
pub(super) fn run(arguments: &HealthArguments) -> Exit {
    let url = match &arguments.url {
        Some(url) => Ok(url.clone()),
        None => configured(arguments.config.as_deref()),
    };
    let url = match url {
        Ok(url) => url,
        Err(exit) => return exit,
    };
    match ask(&url) {
        Ok(answer) if answer.status == 200 => {
            print_line("ready");
            Exit::Ok
        }
        Ok(answer) => {
            print_error(&format!("{url} answers {}: {}", answer.status, answer.body));
            Exit::NotReady
        }
        Err(error) => {
            print_error(&format!("{url} does not answer: {error}"));
            Exit::NotReady
        }
    }
}

/// Where the gateway of a configuration listens. Without the default file, as in a demo, at the default address.
fn configured(file: Option<&Path>) -> Result<Url, Exit> {
    let default = Path::new(DEFAULT_FILE);
    let http = match file {
        None if matches!(default.try_exists(), Ok(false)) => WebSettings::default(),
        file => load::configuration(file.unwrap_or(default))?.settings.http,
    };
    let scheme = if http.tls.is_off() { Scheme::Http } else { Scheme::HttpsHere };
    Ok(Url::ready(http.listen, scheme))
}

/// Status and text of an answer.
#[derive(Debug, PartialEq, Eq)]
struct Answer {
    status: u16,
    body: String,
}

fn ask(url: &Url) -> io::Result<Answer> {
    let mut failed = io::Error::from(io::ErrorKind::NotFound);
    for address in url.authority.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, PATIENCE) {
            Ok(stream) => return connected(stream, url),
            Err(error) => failed = error,
        }
    }
    Err(failed)
}

fn connected(stream: TcpStream, url: &Url) -> io::Result<Answer> {
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let config = match url.scheme {
        Scheme::Http => return converse(stream, url),
        Scheme::Https => load_client(&TlsClientSettings::default()).map(|loaded| loaded.config),
        Scheme::HttpsHere => own_host::client(),
    };
    converse(secured(stream, config.map_err(io::Error::other)?, url)?, url)
}

fn secured(
    mut stream: TcpStream,
    config: ClientConfig,
    url: &Url,
) -> io::Result<StreamOwned<ClientConnection, TcpStream>> {
    let name = ServerName::try_from(url.host().to_owned()).map_err(io::Error::other)?;
    let mut connection = ClientConnection::new(Arc::new(config), name).map_err(io::Error::other)?;
    while connection.is_handshaking() {
        connection
            .complete_io(&mut stream)
            .map_err(|error| io::Error::other(Reason::of_handshake(&error).to_string()))?;
    }
    Ok(StreamOwned::new(connection, stream))
}

fn converse(mut stream: impl Read + Write, url: &Url) -> io::Result<Answer> {
    write!(stream, "GET {} HTTP/1.0\r\nHost: {}\r\nConnection: close\r\n\r\n", url.path, url.authority)?;
    let mut answer = Vec::new();
    stream.take(LONGEST_ANSWER).read_to_end(&mut answer)?;
    read(&String::from_utf8_lossy(&answer)).ok_or_else(|| io::Error::other("this is not HTTP"))
}

fn read(text: &str) -> Option<Answer> {
    let mut words = text.lines().next()?.split(' ');
    words.next().filter(|version| version.starts_with("HTTP/1."))?;
    let status = words.next()?.parse().ok()?;
    // Whatever is there is for a terminal or a log: nothing in it may command them.
    let body = text.split_once("\r\n\r\n").map_or("", |(_, body)| body);
    let body = body.trim().chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    Some(Answer { status, body })
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_url_needs_a_host_and_has_port_80_and_readyz_unless_it_says_more() {
        let parsed = |text: &str| text.parse::<Url>().ok().map(|url| (url.authority, url.path));
        assert_eq!("https://plant".parse::<Url>().unwrap().to_string(), "https://plant:443/readyz");
        assert_eq!("http://plant/livez".parse::<Url>().unwrap().to_string(), "http://plant:80/livez");
        assert_eq!("https://[::1]:8443".parse::<Url>().unwrap().host(), "::1");
        let some = |authority: &str, path: &str| Some((authority.to_owned(), path.to_owned()));
        assert_eq!(parsed("http://plant:8080/livez"), some("plant:8080", "/livez"));
        assert_eq!(parsed("http://plant"), some("plant:80", "/readyz"));
        assert_eq!(parsed("http://[::1]/"), some("[::1]:80", "/readyz"));
        assert_eq!(parsed("http://[::1]:8080"), some("[::1]:8080", "/readyz"));
        for wrong in [
            "plant:8080",
            "https://",
            "ftp://plant",
            "http://",
            "http:///readyz",
            "http://a b",
            "http://me@plant",
            "http://a/\r\nx",
        ] {
            assert_eq!(parsed(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_gateway_that_listens_everywhere_is_asked_on_this_host() {
        let asked = |listen: &str| Url::ready(listen.parse().unwrap(), Scheme::Http).authority;
        assert_eq!(asked("0.0.0.0:8080"), "127.0.0.1:8080");
        assert_eq!(asked("[::]:8080"), "[::1]:8080");
        assert_eq!(asked("10.0.0.5:80"), "10.0.0.5:80");
    }

    /// What is made of one answer of a server.
    fn after(answer: &'static [u8]) -> io::Result<Answer> {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = Url::ready(listener.local_addr().unwrap(), Scheme::Http);
        let server = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = Vec::new();
            while !request.ends_with(b"\r\n\r\n") {
                let mut byte = [0];
                stream.read_exact(&mut byte).unwrap();
                request.extend(byte);
            }
            // The asker may have heard enough.
            let _ = stream.write_all(answer);
            String::from_utf8(request).unwrap()
        });
        let answer = ask(&url);
        assert!(server.join().unwrap().starts_with("GET /readyz HTTP/1.0\r\n"));
        answer
    }

    #[test]
    fn the_status_decides_and_the_body_is_told_without_what_a_terminal_obeys() {
        let answer =
            after(b"HTTP/1.1 503 Service Unavailable\r\nX: y\r\n\r\n{\"ready\":\x1b[2Jfalse}\n").unwrap();
        assert_eq!(answer, Answer { status: 503, body: "{\"ready\": [2Jfalse}".to_owned() });
        assert_eq!(after(b"HTTP/1.0 200 OK\r\n\r\n").unwrap().status, 200);
    }

    #[test]
    fn what_is_not_http_is_no_answer() {
        for wrong in
            [&b""[..], b"\xFF\xFF", b"SSH-2.0-x\r\n", b"HTTP/1.1 many\r\n\r\n", b"HTTP/1.1 99999 x\r\n\r\n"]
        {
            assert!(after(wrong).is_err(), "{wrong:?}");
        }
    }
}
