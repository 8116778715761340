//! The HTTP server \[IO\]: routes and headers; what it says is made in `status` and `metrics`.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{Path, Query, State, rejection::QueryRejection};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use super::health::HealthSource;
use super::listener::LimitedListener;
use super::metrics::{self, Metrics};
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
        Ok(Self { listener, address, router: router(state) })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Answers until `stop`, then lets open requests end for a second.
    pub async fn run(self, stop: CancellationToken) {
        let stopped = stop.clone().cancelled_owned();
        let serving = axum::serve(LimitedListener::new(self.listener), self.router)
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

fn router(state: WebState) -> Router {
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
        .layer(axum::middleware::map_response(with_headers))
        .with_state(Arc::new(state))
}

type Shared = State<Arc<WebState>>;

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

async fn ready(State(state): Shared) -> Response {
    let reasons = (state.health)().not_ready;
    let code = if reasons.is_empty() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    json(code, &Ready { ready: reasons.is_empty(), reasons })
}

async fn metrics_text(State(state): Shared) -> Response {
    let (health, now) = ((state.health)(), state.clock.now());
    let metrics = state.reader.read(|image| Metrics::new(&state.table, &state.about, image, health, now));
    text(metrics::CONTENT_TYPE, metrics.encode())
}

async fn map_json(State(state): Shared) -> Response {
    text("application/json", state.map_json.to_string())
}

async fn map_csv(State(state): Shared) -> Response {
    text("text/csv; charset=utf-8", state.map_csv.to_string())
}

async fn status(State(state): Shared) -> Response {
    let (health, now) = ((state.health)(), state.clock.now());
    let status = state.reader.read(|image| Status::new(&state.table, &state.about, image, health, now));
    json(StatusCode::OK, &status)
}

async fn node(State(state): Shared, Path(name): Path<String>) -> Response {
    let now = state.clock.now().instant;
    let index = state.table.find_node(&name);
    let view =
        index.and_then(|node| state.reader.read(|image| NodeView::new(&state.table, image, node, now)));
    match view {
        Some(view) => json(StatusCode::OK, &view),
        None => error(StatusCode::NOT_FOUND, "there is no such node; /api/v1/status lists them"),
    }
}

async fn alarms(State(state): Shared) -> Response {
    json(StatusCode::OK, &state.reader.read(|image| Alarms::new(&state.table, image)))
}

async fn events(State(state): Shared, query: Result<Query<EventsQuery>, QueryRejection>) -> Response {
    let Ok(Query(EventsQuery { after })) = query else {
        return error(StatusCode::BAD_REQUEST, "`after` is the sequence number of the last event you have");
    };
    json(StatusCode::OK, &state.reader.read(|image| Events::after(&state.table, image, after)))
}

fn json(code: StatusCode, body: &impl Serialize) -> Response {
    let Ok(body) = serde_json::to_string(body) else { return broken() };
    let mut response = text("application/json", body);
    *response.status_mut() = code;
    response
}

fn error(code: StatusCode, error: &str) -> Response {
    json(code, &Problem { error })
}

fn text(kind: &'static str, body: String) -> Response {
    ([(header::CONTENT_TYPE, HeaderValue::from_static(kind))], body).into_response()
}

/// Our own structs are always JSON; were one not, the server goes on.
fn broken() -> Response {
    StatusCode::INTERNAL_SERVER_ERROR.into_response()
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
