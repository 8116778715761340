//! `/api/v1/login`, `/api/v1/logout`, `/api/v1/session`, and who may read at all \[IO\].

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::Response;
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};

use super::guard::{self, Guard, LONGEST_BODY, Refused, refusal};
use super::listener::Peer;
use super::server::{error, json};
use super::sessions::Use;
use super::settings::Readers;
use crate::gateway::command::Grant;

/// What watchdogs ask.
const HEALTH: [&str; 2] = ["/livez", "/readyz"];
/// What can be asked for by whoever may not read: what shows no value, and what tells whether the process lives.
const OPEN: [&str; 7] =
    ["/", "/livez", "/readyz", "/api/v1/openapi.json", "/api/v1/login", "/api/v1/logout", "/api/v1/session"];

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Login {
    name: String,
    password: String,
}

/// `/api/v1/session`
#[derive(Debug, Serialize)]
struct Session<'a> {
    v: u8,
    /// `none`: nobody has a password; `needs_tls`: not from here; `offered`.
    login: &'static str,
    read: Readers,
    name: Option<&'a str>,
    role: Option<&'static str>,
}

impl<'a> Session<'a> {
    fn new(guard: &Guard, peer: SocketAddr, grant: Option<&'a Grant>) -> Self {
        let login = match (guard.has_passwords(), guard.takes_passwords(peer)) {
            (false, _) => "none",
            (true, false) => "needs_tls",
            (true, true) => "offered",
        };
        let role = grant.map(|grant| grant.role().word());
        Self { v: 1, login, read: guard.readers(), name: grant.map(|grant| &**grant.name()), role }
    }
}

/// The routes of this file.
pub(super) fn routes<S: Clone + Send + Sync + 'static>(guard: Arc<Guard>) -> Router<S> {
    Router::new()
        .route("/api/v1/login", post(log_in).layer(DefaultBodyLimit::max(LONGEST_BODY)))
        .route("/api/v1/logout", post(log_out).layer(DefaultBodyLimit::max(LONGEST_BODY)))
        .route("/api/v1/session", get(session))
        .with_state(guard)
}

async fn session(
    State(guard): State<Arc<Guard>>,
    ConnectInfo(Peer(peer)): ConnectInfo<Peer>,
    headers: HeaderMap,
) -> Response {
    let grant = guard.holder(&headers).await;
    json(StatusCode::OK, &Session::new(&guard, peer, grant.as_deref()))
}

async fn log_in(
    State(guard): State<Arc<Guard>>,
    ConnectInfo(Peer(peer)): ConnectInfo<Peer>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    match try_log_in(&guard, peer, &headers, body).await {
        Ok(response) => response,
        Err(refused) => {
            // Not even the name is told: it may be a password that was typed into the wrong field.
            guard.tell(peer, "login", refused.1);
            refusal(refused)
        }
    }
}

async fn try_log_in(
    guard: &Arc<Guard>,
    peer: SocketAddr,
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Refused> {
    guard.check_form(headers)?;
    let Ok(Login { name, password }) = serde_json::from_slice(&guard::whole(body)?) else {
        return Err((StatusCode::BAD_REQUEST, "a login is {\"name\":\"...\",\"password\":\"...\"}"));
    };
    let (grant, secret) = guard.log_in(peer, name, password).await?;
    // One that the browser had before is over: it would be forgotten there, and live on here.
    guard.log_out(headers);
    let mut response = json(StatusCode::OK, &Session::new(guard, peer, Some(&grant)));
    response.headers_mut().insert(header::SET_COOKIE, guard.cookie(Some(&secret), headers));
    Ok(response)
}

async fn log_out(
    State(guard): State<Arc<Guard>>,
    ConnectInfo(Peer(peer)): ConnectInfo<Peer>,
    headers: HeaderMap,
) -> Response {
    if let Err(refused) = guard.check_form(&headers) {
        return refusal(refused);
    }
    guard.log_out(&headers);
    let mut response = json(StatusCode::OK, &Session::new(&guard, peer, None));
    response.headers_mut().insert(header::SET_COOKIE, guard.cookie(None, &headers));
    response
}

/// Lets those read who may. Whoever sends something is looked at where it goes to.
pub(super) async fn may_read(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let is_open = OPEN.contains(&request.uri().path());
    let sends = request.method() == Method::POST;
    if guard.readers() == Readers::Anyone || is_open || sends {
        return next.run(request).await;
    }
    let Some(ConnectInfo(Peer(peer))) = request.extensions().get::<ConnectInfo<Peer>>().copied() else {
        return refusal((StatusCode::UNAUTHORIZED, "this needs a login"));
    };
    let headers = request.headers();
    match guard.who(peer, headers, Use::Read).await {
        Ok(_) => next.run(request).await,
        Err(refused) => {
            // A page whose session is over asks on by itself; a wrong token is somebody's mistake.
            if guard::token(headers).is_some() {
                guard.tell(peer, "read", refused.1);
            }
            refusal(refused)
        }
    }
}

/// Refuses who asks too often. Those that ask whether the process lives are never kept out.
pub(super) async fn in_pace(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let peer = request.extensions().get::<ConnectInfo<Peer>>().copied();
    let Some(ConnectInfo(Peer(peer))) = peer.filter(|_| !HEALTH.contains(&request.uri().path())) else {
        return next.run(request).await;
    };
    if guard.is_in_pace(peer) {
        return next.run(request).await;
    }
    let mut response =
        error(StatusCode::TOO_MANY_REQUESTS, "too many requests from this address; wait a second");
    response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
    response
}
