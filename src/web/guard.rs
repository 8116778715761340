//! Who asks: tokens, passwords, sessions, and who guesses at them. \[IO\]

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::Response;
use tokio::sync::Semaphore;

use super::host::Hosts;
use super::login::{Failures, is_token};
use super::pace::Pace;
use super::secret_files::SecretFiles;
use super::server::error;
use super::sessions::{self, Holder, Secret, Sessions, Use};
use super::settings::{Readers, WebSettings};
use crate::gateway::command::{CommandSource, Desk, Grant};
use crate::time::Clock;
use crate::tls::random;

/// The longest body of a request in bytes.
pub const LONGEST_BODY: usize = 4_096;
/// Logins that may wait for their turn; one more is told to come again.
const MOST_WAITING: usize = 8;
/// What is answered whatever was wrong about a login.
const WRONG: Refused = (StatusCode::UNAUTHORIZED, "the name or the password is wrong");
const BUSY: Refused = (StatusCode::SERVICE_UNAVAILABLE, "too many log in at once; try again");
const BLOCKED: Refused =
    (StatusCode::TOO_MANY_REQUESTS, "too many failed logins from this address; wait a minute");

/// A request that goes no further, and why, in words for whoever made it.
pub type Refused = (StatusCode, &'static str);

/// The body of a request that came whole.
///
/// # Errors
/// It is too long, or broke off.
pub fn whole(body: Result<Bytes, BytesRejection>) -> Result<Bytes, Refused> {
    body.map_err(|rejection| match rejection.status() {
        StatusCode::PAYLOAD_TOO_LARGE => (StatusCode::PAYLOAD_TOO_LARGE, "a request has at most 4096 bytes"),
        _ => (StatusCode::BAD_REQUEST, "the request did not come whole"),
    })
}

/// The answer to it.
#[must_use]
pub fn refusal((code, why): Refused) -> Response {
    let mut response = error(code, why);
    let (name, value) = match code {
        StatusCode::UNAUTHORIZED => (header::WWW_AUTHENTICATE, "Bearer"),
        StatusCode::TOO_MANY_REQUESTS => (header::RETRY_AFTER, "60"),
        StatusCode::SERVICE_UNAVAILABLE => (header::RETRY_AFTER, "1"),
        _ => return response,
    };
    response.headers_mut().insert(name, HeaderValue::from_static(value));
    response
}

/// Knows who asks. There is one for a server; it outlives what the server shows.
#[derive(Debug)]
pub struct Guard {
    desk: Mutex<Desk>,
    clock: Clock,
    files: SecretFiles,
    hosts: Arc<Hosts>,
    is_tls: bool,
    plain_login: bool,
    read: Readers,
    cookie: String,
    pace: Mutex<Pace>,
    failures: Mutex<Failures>,
    sessions: Mutex<Sessions>,
    waiting: Arc<Semaphore>,
    /// One after the other: checking a password takes memory and a core, and each is to know of the failure before it.
    turn: Semaphore,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// The token of a request. The case of the scheme does not matter (RFC 9110, 11.1).
#[must_use]
pub fn token(headers: &HeaderMap) -> Option<&str> {
    let (scheme, token) = text(headers, header::AUTHORIZATION)?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("Bearer").then(|| token.trim_start_matches(' '))
}

impl Guard {
    /// For the gateway behind a desk. `gateway` is its name.
    #[must_use]
    pub fn new(settings: &WebSettings, gateway: &str, hosts: Arc<Hosts>, desk: Desk, clock: Clock) -> Self {
        let is_tls = !settings.tls.is_off();
        // Cookies are for a host with all its ports: two gateways on one host must not take each other's. A browser keeps one
        // with this prefix only where it came over TLS.
        let cookie = format!("{}cangate-{gateway}", if is_tls { "__Host-" } else { "" });
        Self {
            desk: Mutex::new(desk),
            clock,
            files: SecretFiles::new(clock),
            hosts,
            is_tls,
            plain_login: settings.plain_login,
            read: settings.read,
            cookie,
            pace: Mutex::default(),
            failures: Mutex::default(),
            sessions: Mutex::default(),
            waiting: Arc::new(Semaphore::new(MOST_WAITING)),
            turn: Semaphore::new(1),
        }
    }

    /// Who may ask stands at another desk from now on.
    pub fn set_desk(&self, desk: Desk) {
        *lock(&self.desk) = desk;
    }

    fn desk(&self) -> Desk {
        lock(&self.desk).clone()
    }

    /// Who may read.
    #[must_use]
    pub fn readers(&self) -> Readers {
        self.read
    }

    /// Whether anybody has a password.
    #[must_use]
    pub fn has_passwords(&self) -> bool {
        self.desk().access().passwords().next().is_some()
    }

    /// Whether a password from there is not heard by others on its way.
    #[must_use]
    pub fn takes_passwords(&self, peer: SocketAddr) -> bool {
        self.is_tls || self.plain_login || peer.ip().to_canonical().is_loopback()
    }

    /// Takes a request of an address; `false` where there were too many of it.
    #[must_use]
    pub fn is_in_pace(&self, peer: SocketAddr) -> bool {
        lock(&self.pace).take(self.clock.now().instant, peer.ip()).is_ok()
    }

    /// Tells the journal of a request that was refused.
    pub fn tell(&self, peer: SocketAddr, verb: &'static str, why: &str) {
        self.desk().refuse(CommandSource::web(peer.to_string()), verb, why.to_owned());
    }

    /// Who asks, by token or session.
    ///
    /// # Errors
    /// Nobody who is known, or from a page elsewhere.
    pub async fn who(
        &self,
        peer: SocketAddr,
        headers: &HeaderMap,
        usage: Use,
    ) -> Result<Arc<Grant>, Refused> {
        // Another kind of login is meant for a proxy before us.
        if let Some(token) = token(headers) {
            return self.of_token(peer, token).await;
        }
        let Some(secret) = self.secret(headers) else {
            return Err((
                StatusCode::UNAUTHORIZED,
                "this needs a login, or a token: Authorization: Bearer ...",
            ));
        };
        // The browser adds a cookie by itself, whoever made it ask.
        if usage == Use::Act && !self.is_from_our_page(headers) {
            return Err((StatusCode::FORBIDDEN, "a command comes from no other page"));
        }
        let over = (StatusCode::UNAUTHORIZED, "the session is over; log in again");
        self.of_session(&secret, usage).await.ok_or(over)
    }

    async fn of_token(&self, peer: SocketAddr, token: &str) -> Result<Arc<Grant>, Refused> {
        self.not_blocked(peer)?;
        let tokens = self.files.tokens(&self.desk().access()).await;
        // All are looked at, so that the time does not tell which of them it was.
        let found = tokens.into_iter().fold(None, |found, (grant, known)| {
            let is_it = is_token(token, &known);
            found.or_else(|| is_it.then_some(grant))
        });
        found.ok_or_else(|| {
            self.failed(peer);
            (StatusCode::UNAUTHORIZED, "this token is not known")
        })
    }

    async fn of_session(&self, secret: &Secret, usage: Use) -> Option<Arc<Grant>> {
        let now = self.clock.now().instant;
        let holder = lock(&self.sessions).find(now, secret, usage)?;
        self.still(secret, &holder).await
    }

    /// Who holds a session that could act; asking does not prolong it.
    pub async fn holder(&self, headers: &HeaderMap) -> Option<Arc<Grant>> {
        let secret = self.secret(headers)?;
        let holder = lock(&self.sessions).look(self.clock.now().instant, &secret)?;
        self.still(&secret, &holder).await
    }

    /// The access of a session, as it is now: a name that is gone, or has another password, has no session.
    async fn still(&self, secret: &Secret, holder: &Holder) -> Option<Arc<Grant>> {
        let access = self.desk().access();
        let (grant, place) = access.passwords().find(|(grant, _)| **grant.name() == *holder.name)?;
        if self.files.password(grant, place).await? == holder.password {
            return Some(Arc::clone(grant));
        }
        lock(&self.sessions).end(secret);
        None
    }

    /// Begins a session; gives what the browser has to keep.
    ///
    /// # Errors
    /// Name or password are wrong, or this is not the way or the time to try.
    pub async fn log_in(
        self: &Arc<Self>,
        peer: SocketAddr,
        name: String,
        password: String,
    ) -> Result<(Arc<Grant>, Secret), Refused> {
        if !self.takes_passwords(peer) {
            return Err((
                StatusCode::FORBIDDEN,
                "a password would cross the network unencrypted: [http.tls] is needed for it",
            ));
        }
        self.not_blocked(peer)?;
        let Ok(waiting) = Arc::clone(&self.waiting).try_acquire_owned() else { return Err(BUSY) };
        let guard = Arc::clone(self);
        // To its end, also where the client goes away: a failure counts all the same.
        let checking = tokio::spawn(async move {
            let _waiting = waiting;
            guard.check(peer, &name, password).await
        });
        checking.await.unwrap_or(Err(BUSY))
    }

    async fn check(
        &self,
        peer: SocketAddr,
        name: &str,
        password: String,
    ) -> Result<(Arc<Grant>, Secret), Refused> {
        let Ok(_turn) = self.turn.acquire().await else { return Err(BUSY) };
        self.not_blocked(peer)?;
        let (mut known, mut other) = (None, None);
        for (grant, hash) in self.files.passwords(&self.desk().access()).await {
            if **grant.name() == *name {
                known = Some((grant, hash));
            } else {
                other.get_or_insert(hash);
            }
        }
        // An unknown name takes as long as a known one: its password is held against that of another, in vain.
        let of = known.as_ref().map(|(_, hash)| hash.clone()).or(other);
        let is_right = match of {
            Some(of) => tokio::task::spawn_blocking(move || of.is_of(&password)).await.unwrap_or(false),
            None => false,
        };
        let Some((grant, password)) = known.filter(|_| is_right) else {
            self.failed(peer);
            return Err(WRONG);
        };
        let secret = random::bytes().map_err(|_| BUSY)?;
        let holder = Holder { name: Arc::clone(grant.name()), password };
        lock(&self.sessions).begin(self.clock.now().instant, secret, holder);
        tracing::info!(%peer, access = %grant.name(), "logged in");
        Ok((grant, secret))
    }

    /// Ends the session of a request, if there is one.
    pub fn log_out(&self, headers: &HeaderMap) {
        if let Some(secret) = self.secret(headers) {
            lock(&self.sessions).end(&secret);
        }
    }

    fn not_blocked(&self, peer: SocketAddr) -> Result<(), Refused> {
        let is_blocked = lock(&self.failures).is_blocked(self.clock.now().instant, peer.ip());
        if is_blocked { Err(BLOCKED) } else { Ok(()) }
    }

    fn failed(&self, peer: SocketAddr) {
        lock(&self.failures).note(self.clock.now().instant, peer.ip());
    }

    /// A page from elsewhere cannot send this content type without asking first, which is never granted; and its browser says
    /// where it is from.
    ///
    /// # Errors
    /// The content type is another, or the request is from elsewhere.
    pub fn check_form(&self, headers: &HeaderMap) -> Result<(), Refused> {
        let kind = text(headers, header::CONTENT_TYPE).unwrap_or_default();
        if kind.split(';').next().unwrap_or_default().trim() != "application/json" {
            return Err((StatusCode::UNSUPPORTED_MEDIA_TYPE, "the content type is application/json"));
        }
        if !headers.contains_key(header::ORIGIN) || self.is_our_origin(headers) {
            return Ok(());
        }
        Err((StatusCode::FORBIDDEN, "a command comes from no other page"))
    }

    /// Whether a browser says that our own page asks. One that says nothing of it is none.
    fn is_from_our_page(&self, headers: &HeaderMap) -> bool {
        let site = text(headers, HeaderName::from_static("sec-fetch-site"));
        if headers.contains_key(header::ORIGIN) {
            self.is_our_origin(headers) && site.is_none_or(|site| site == "same-origin")
        } else {
            site == Some("same-origin")
        }
    }

    fn is_our_origin(&self, headers: &HeaderMap) -> bool {
        let origin = text(headers, header::ORIGIN).and_then(|origin| origin.split_once("://"));
        let Some((scheme, host)) = origin else { return false };
        // A proxy before us may speak TLS where we do not.
        let is_scheme = scheme == "https" || (scheme == "http" && !self.is_tls);
        is_scheme && self.hosts.names_us(host) && text(headers, header::HOST) == Some(host)
    }

    fn secret(&self, headers: &HeaderMap) -> Option<Secret> {
        let cookies = headers.get_all(header::COOKIE).iter().filter_map(|cookies| cookies.to_str().ok());
        let pairs =
            cookies.flat_map(|cookies| cookies.split(';')).filter_map(|pair| pair.trim().split_once('='));
        let mut ours = pairs.filter(|(name, _)| *name == self.cookie);
        ours.find_map(|(_, value)| sessions::from_text(value))
    }

    /// What makes a browser keep the secret of a session, or without one, forget it.
    #[must_use]
    pub fn cookie(&self, secret: Option<&Secret>, headers: &HeaderMap) -> HeaderValue {
        let value = secret.map(sessions::to_text).unwrap_or_default();
        let lasts = if secret.is_some() { sessions::LONGEST.as_secs() } else { 0 };
        let behind_tls = text(headers, header::ORIGIN).is_some_and(|origin| origin.starts_with("https://"));
        let secure = if self.is_tls || behind_tls { "; Secure" } else { "" };
        let name = &self.cookie;
        let text = format!("{name}={value}; Path=/; HttpOnly; SameSite=Strict; Max-Age={lasts}{secure}");
        HeaderValue::try_from(text).unwrap_or(HeaderValue::from_static(""))
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::web::settings::WebTls;

    fn guard(settings: &WebSettings) -> Arc<Guard> {
        let hosts = Arc::new(Hosts::new("hall-1", &settings.allowed_hosts));
        Arc::new(Guard::new(settings, "hall-1", hosts, Desk::new(1).0, Clock::start()))
    }

    #[tokio::test]
    async fn cr_4_1_passwords_are_taken_unencrypted_from_this_host_only() {
        let plain = WebSettings::default();
        let tls = WebSettings {
            tls: WebTls { cert_file: PathBuf::from("c"), key_file: PathBuf::from("k") },
            ..WebSettings::default()
        };
        let anyway = WebSettings { plain_login: true, ..WebSettings::default() };
        for (peer, taken) in [
            ("127.0.0.1:1", [true, true, true]),
            ("127.9.9.9:1", [true, true, true]),
            ("[::1]:1", [true, true, true]),
            ("[::ffff:127.0.0.1]:1", [true, true, true]),
            ("10.0.0.5:1", [false, true, true]),
            ("[fd00::5]:1", [false, true, true]),
            ("[::ffff:10.0.0.5]:1", [false, true, true]),
            ("0.0.0.0:1", [false, true, true]),
        ] {
            let peer = peer.parse().unwrap();
            for (settings, taken) in [&plain, &tls, &anyway].into_iter().zip(taken) {
                let guard = guard(settings);
                assert_eq!(guard.takes_passwords(peer), taken, "{peer}");
                let refused = guard.log_in(peer, "maria".into(), "x".into()).await.unwrap_err();
                let code = if taken { StatusCode::UNAUTHORIZED } else { StatusCode::FORBIDDEN };
                assert_eq!(refused.0, code, "{peer}");
            }
        }
    }

    #[test]
    fn a_token_is_known_by_its_scheme_in_any_case() {
        for (value, found) in [
            ("Bearer abc", Some("abc")),
            ("bearer abc", Some("abc")),
            ("BEARER  abc", Some("abc")),
            ("Bearer", None),
            ("Bearers abc", None),
            ("Basic abc", None),
        ] {
            let headers = HeaderMap::from_iter([(header::AUTHORIZATION, HeaderValue::from_static(value))]);
            assert_eq!(token(&headers), found, "{value}");
        }
    }

    #[test]
    fn the_cookie_is_found_among_others_and_is_that_of_this_gateway() {
        let guard = guard(&WebSettings::default());
        let secret = [7; sessions::SECRET];
        let text = sessions::to_text(&secret);
        for (cookies, found) in [
            (vec![format!("cangate-hall-1={text}")], true),
            (vec![format!("a=b; cangate-hall-1={text}; c")], true),
            (vec!["a=b".to_owned(), format!("cangate-hall-1={text}")], true),
            (vec![format!("cangate-hall-1=short; cangate-hall-1={text}")], true),
            (vec![format!("cangate-hall-2={text}")], false),
            (vec![format!("xcangate-hall-1={text}")], false),
            (vec![format!("__Host-cangate-hall-1={text}")], false),
            (vec![], false),
        ] {
            let mut headers = HeaderMap::new();
            for cookie in &cookies {
                headers.append(header::COOKIE, HeaderValue::from_str(cookie).unwrap());
            }
            assert_eq!(guard.secret(&headers), found.then_some(secret), "{cookies:?}");
        }
        let behind_a_proxy =
            HeaderMap::from_iter([(header::ORIGIN, HeaderValue::from_static("https://hall-1"))]);
        for (headers, secure) in [(HeaderMap::new(), false), (behind_a_proxy, true)] {
            let cookie = guard.cookie(Some(&secret), &headers);
            assert_eq!(cookie.to_str().unwrap().ends_with("; Secure"), secure);
        }
    }
}
