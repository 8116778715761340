//! The HTTP server \[IO\]: routes and headers; what it says is made in `status` and `metrics`.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio::sync::Mutex;
use tokio_util::sync::CancellationToken;

use super::health::HealthSource;
use super::host::Hosts;
use super::listener::LimitedListener;
use super::metrics::{self, Metrics};
use super::recent::Recent;
use super::settings::WebSettings;
use super::status::{About, Alarms, Events, NodeView, Status};
use crate::mapping::TagTable;
use crate::process_image::ImageReader;
use crate::time::Clock;

/// Description of the interface.
pub const OPENAPI: &str = include_str!("openapi.json");
/// The page; `{nonce}` is replaced at each request.
const PAGE: &str = include_str!("page/index.html");
/// Every route, as in [`OPENAPI`].
pub const ROUTES: [&str; 11] = [
    "/",
    "/livez",
    "/readyz",
    "/metrics",
    "/map.json",
    "/map.csv",
    "/api/v1/status",
    "/api/v1/nodes/{name}",
    "/api/v1/alarms",
    "/api/v1/events",
    "/api/v1/openapi.json",
];
/// Time that open requests get at a stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);

/// What the server shows.
#[derive(Clone)]
pub struct WebState {
    /// What there is.
    pub table: Arc<TagTable>,
    /// How it is.
    pub reader: ImageReader,
    /// For ages.
    pub clock: Clock,
    /// What does not change.
    pub about: About,
    /// The rest of the program.
    pub health: HealthSource,
    /// `/map.json`.
    pub map_json: Arc<str>,
    /// `/map.csv`.
    pub map_csv: Arc<str>,
}

/// The server could not be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen on http://{address}: {source}; is the port taken? Set `listen` in `[http]`")]
pub struct WebError {
    address: SocketAddr,
    source: std::io::Error,
}

/// A bound server.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    router: Router,
    clock: Clock,
}

impl Server {
    /// Binds the address. Nothing is answered before [`run`](Self::run).
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn bind(settings: &WebSettings, state: WebState) -> Result<Self, WebError> {
        let failed = |source| WebError { address: settings.listen, source };
        let listener = TcpListener::bind(settings.listen).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let (hosts, clock) = (Hosts::new(&state.table.gateway, &settings.allowed_hosts), state.clock);
        Ok(Self { listener, address, router: router(state, hosts), clock })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Answers until `stop`, then lets open requests end for a second.
    pub async fn run(self, stop: CancellationToken) {
        let stopped = stop.clone().cancelled_owned();
        let serving = axum::serve(LimitedListener::new(self.listener, self.clock), self.router)
            .with_graceful_shutdown(stopped)
            .into_future();
        let patience = async {
            stop.cancelled().await;
            tokio::time::sleep(STOP_TIMEOUT).await;
        };
        tokio::select! {
            // It ends at a stop only: accept errors are handled by the listener.
            _ = serving => {}
            () = patience => {}
        }
    }
}

fn router(state: WebState, hosts: Hosts) -> Router {
    let hosts = Arc::new(hosts);
    Router::new()
        .route("/", get(page))
        .route("/livez", get(|| async { json(StatusCode::OK, &Live { alive: true }) }))
        .route("/readyz", get(ready))
        .route("/metrics", get(metrics_text))
        .route("/map.json", get(map_json))
        .route("/map.csv", get(map_csv))
        .route("/api/v1/status", get(status))
        .route("/api/v1/nodes/{name}", get(node))
        .route("/api/v1/alarms", get(alarms))
        .route("/api/v1/events", get(events))
        .route("/api/v1/openapi.json", get(|| async { text("application/json", OPENAPI.to_owned()) }))
        .fallback(|| async {
            error(StatusCode::NOT_FOUND, "there is no such page; see /api/v1/openapi.json")
        })
        .method_not_allowed_fallback(|| async {
            error(StatusCode::METHOD_NOT_ALLOWED, "everything here is read with GET; nothing can be changed")
        })
        .layer(axum::middleware::from_fn_with_state(hosts, only_for_us))
        .layer(axum::middleware::map_response(with_headers))
        .with_state(Arc::new(Site { state, recent: Answers::default() }))
}

type Shared = State<Arc<Site>>;

/// What the routes share.
struct Site {
    state: WebState,
    recent: Answers,
}

/// The last answers of the routes that copy the whole image. Behind a lock each, so that of many who ask at once one
/// makes the answer and the others wait for it.
#[derive(Default)]
struct Answers {
    status: Mutex<Recent<Bytes>>,
    alarms: Mutex<Recent<Bytes>>,
    metrics: Mutex<Recent<Bytes>>,
}

#[derive(Serialize)]
struct Live {
    alive: bool,
}

#[derive(Serialize)]
struct Ready {
    ready: bool,
    reasons: Vec<String>,
}

#[derive(Serialize)]
struct Problem<'a> {
    error: &'a str,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EventsQuery {
    #[serde(default)]
    after: u64,
}

async fn page() -> Response {
    let nonce = uuid::Uuid::new_v4().simple().to_string();
    let policy = format!(
        "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    );
    let mut response = text("text/html; charset=utf-8", PAGE.replace("{nonce}", &nonce));
    if let Ok(policy) = HeaderValue::try_from(policy) {
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    response
}

/// Refuses what was meant for somebody else; browsers always say for whom.
async fn only_for_us(State(hosts): State<Arc<Hosts>>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST);
    if host.is_none_or(|host| host.to_str().is_ok_and(|host| hosts.names_us(host))) {
        return next.run(request).await;
    }
    error(
        StatusCode::MISDIRECTED_REQUEST,
        "this gateway does not know that name as its own: use its address, or add the name to `allowed_hosts` in [http]",
    )
}

async fn ready(State(site): Shared) -> Response {
    let reasons = (site.state.health)().not_ready;
    let code = if reasons.is_empty() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    json(code, &Ready { ready: reasons.is_empty(), reasons })
}

async fn metrics_text(State(site): Shared) -> Response {
    let WebState { table, reader, about, clock, health, .. } = &site.state;
    let now = clock.now();
    let made = site.recent.metrics.lock().await.get(now.instant, || {
        let health = health();
        reader.read(|image| Metrics::new(table, about, image, health, now)).encode().into()
    });
    text(metrics::CONTENT_TYPE, made)
}

async fn map_json(State(site): Shared) -> Response {
    text("application/json", site.state.map_json.to_string())
}

async fn map_csv(State(site): Shared) -> Response {
    text("text/csv; charset=utf-8", site.state.map_csv.to_string())
}

async fn status(State(site): Shared) -> Response {
    let WebState { table, reader, about, clock, health, .. } = &site.state;
    let now = clock.now();
    let made = site.recent.status.lock().await.get(now.instant, || {
        let health = health();
        bytes(&reader.read(|image| Status::new(table, about, image, health, now)))
    });
    text("application/json", made)
}

async fn node(State(site): Shared, name: Result<Path<String>, PathRejection>) -> Response {
    let state = &site.state;
    let now = state.clock.now().instant;
    // What is no text is no name either.
    let index = name.ok().and_then(|Path(name)| state.table.find_node(&name));
    let view =
        index.and_then(|node| state.reader.read(|image| NodeView::new(&state.table, image, node, now)));
    match view {
        Some(view) => json(StatusCode::OK, &view),
        None => error(StatusCode::NOT_FOUND, "there is no such node; /api/v1/status lists them"),
    }
}

async fn alarms(State(site): Shared) -> Response {
    let WebState { table, reader, clock, .. } = &site.state;
    let made = site
        .recent
        .alarms
        .lock()
        .await
        .get(clock.now().instant, || bytes(&reader.read(|image| Alarms::new(table, image))));
    text("application/json", made)
}

async fn events(State(site): Shared, query: Result<Query<EventsQuery>, QueryRejection>) -> Response {
    let Ok(Query(EventsQuery { after })) = query else {
        return error(StatusCode::BAD_REQUEST, "`after` is the sequence number of the last event you have");
    };
    let WebState { table, reader, .. } = &site.state;
    json(StatusCode::OK, &reader.read(|image| Events::after(table, image, after)))
}

fn json(code: StatusCode, body: &impl Serialize) -> Response {
    let mut response = text("application/json", bytes(body));
    *response.status_mut() = code;
    response
}

/// Our own structs are always JSON; were one not, the answer would be empty and the server would go on.
fn bytes(body: &impl Serialize) -> Bytes {
    serde_json::to_vec(body).unwrap_or_default().into()
}

fn error(code: StatusCode, error: &str) -> Response {
    json(code, &Problem { error })
}

fn text(kind: &'static str, body: impl Into<Bytes>) -> Response {
    ([(header::CONTENT_TYPE, HeaderValue::from_static(kind))], body.into()).into_response()
}

/// What every answer carries: values are of now, and are nothing but what their type says.
async fn with_headers(mut response: Response) -> Response {
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CACHE_CONTROL, "no-store"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers
        .entry(header::CONTENT_SECURITY_POLICY)
        .or_insert(HeaderValue::from_static("default-src 'none'; frame-ancestors 'none'"));
    response
}
