//! The HTTP server \[IO\]: routes and headers; what it says is made in `status` and `metrics`.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::extract::{ConnectInfo, DefaultBodyLimit, FromRef, Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio::sync::Mutex;
use tokio_util::sync::CancellationToken;

use super::commands::Commands;
use super::guard::{self, Guard};
use super::health::HealthSource;
use super::host::Hosts;
use super::line::Security;
use super::listener::{LimitedListener, Peer};
use super::login_routes;
use super::metrics::{self, Metrics};
use super::recent::Recent;
use super::settings::WebSettings;
use super::status::{About, Alarms, Events, NodeView, Status};
use crate::gateway::command::Desk;
use crate::mapping::TagTable;
use crate::process_image::{Current, ImageReader};
use crate::time::Clock;
use crate::tls::TlsError;

/// Description of the interface.
pub const OPENAPI: &str = include_str!("openapi.json");
/// The page; `{nonce}` is replaced at each request.
const PAGE: &str = include_str!("page/index.html");
/// Every route, as in [`OPENAPI`].
pub const ROUTES: [&str; 15] = [
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
    "/api/v1/commands/{verb}",
    "/api/v1/login",
    "/api/v1/logout",
    "/api/v1/session",
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
    /// Where commands are handed in.
    pub desk: Desk,
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
pub enum WebError {
    /// The address.
    #[error("cannot listen on http://{address}: {source}; is the port taken? Set `listen` in `[http]`")]
    Listen {
        /// As configured.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// A file of `[http.tls]`.
    #[error("the page cannot be served over TLS: {0}")]
    Files(#[from] TlsError),
}

/// A bound server.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    security: Option<Arc<Security>>,
    router: Router,
    shown: Shown,
    clock: Clock,
}

/// What a server shows, to exchange it while it runs: each request is answered from one piece.
#[derive(Clone, Debug)]
pub struct Shown(Current<Site>);

impl Shown {
    /// Requests from now on are answered from this. Who is logged in stays so as long as the access tables let him, and who failed
    /// to log in too often is shut out as before.
    pub fn set(&self, state: WebState) {
        let commands = self.0.get().commands.at(state.desk.clone(), Arc::clone(&state.table));
        self.0.set(Site { state, recent: Answers::default(), commands });
    }
}

impl Server {
    /// Binds the address. Nothing is answered before [`run`](Self::run).
    ///
    /// # Errors
    /// The address cannot be bound, or a file of `[http.tls]` cannot be used.
    pub async fn bind(settings: &WebSettings, state: WebState) -> Result<Self, WebError> {
        let security = match settings.tls.files() {
            Some(files) => Some(Arc::new(Security::prepare(files, state.clock).await?)),
            None => None,
        };
        let failed = |source| WebError::Listen { address: settings.listen, source };
        let listener = TcpListener::bind(settings.listen).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let hosts = Arc::new(Hosts::new(&state.table.gateway, &settings.allowed_hosts));
        let (gateway, desk, clock) = (&state.table.gateway, state.desk.clone(), state.clock);
        let guard = Arc::new(Guard::new(settings, gateway, Arc::clone(&hosts), desk, clock));
        let commands = Commands::new(state.desk.clone(), Arc::clone(&state.table), Arc::clone(&guard));
        let shown = Shown(Current::new(Site { state, recent: Answers::default(), commands }));
        let router = router(shown.0.clone(), hosts, guard);
        Ok(Self { listener, address, security, router, shown, clock })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Where the page is, for the log.
    #[must_use]
    pub fn url(&self) -> String {
        let scheme = if self.security.is_some() { "https" } else { "http" };
        format!("{scheme}://{}/", self.address)
    }

    /// What it shows.
    #[must_use]
    pub fn shown(&self) -> Shown {
        self.shown.clone()
    }

    /// Answers until `stop`, then lets open requests end for a second.
    pub async fn run(self, stop: CancellationToken) {
        let stopped = stop.clone().cancelled_owned();
        let service = self.router.into_make_service_with_connect_info::<Peer>();
        let serving = axum::serve(LimitedListener::new(self.listener, self.security, self.clock), service)
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

fn router(shown: Current<Site>, hosts: Arc<Hosts>, guard: Arc<Guard>) -> Router {
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
        .route("/api/v1/commands/{verb}", post(command).layer(DefaultBodyLimit::max(guard::LONGEST_BODY)))
        .merge(login_routes::routes(Arc::clone(&guard)))
        .fallback(|| async {
            error(StatusCode::NOT_FOUND, "there is no such page; see /api/v1/openapi.json")
        })
        .method_not_allowed_fallback(|| async {
            error(
                StatusCode::METHOD_NOT_ALLOWED,
                "everything here is read with GET; only commands and logins are sent with POST",
            )
        })
        .layer(axum::middleware::from_fn_with_state(Arc::clone(&guard), login_routes::may_read))
        .layer(axum::middleware::from_fn_with_state(hosts, only_for_us))
        .layer(axum::middleware::from_fn_with_state(guard, login_routes::in_pace))
        .layer(axum::middleware::map_response(with_headers))
        .with_state(shown)
}

type Shared = State<Arc<Site>>;

impl FromRef<Current<Site>> for Arc<Site> {
    fn from_ref(current: &Current<Site>) -> Self {
        current.get()
    }
}

/// What the routes share.
struct Site {
    state: WebState,
    recent: Answers,
    commands: Commands,
}

impl std::fmt::Debug for Site {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Site").finish_non_exhaustive()
    }
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
        "default-src 'none'; img-src data:; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; \
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

async fn command(
    State(site): Shared,
    ConnectInfo(Peer(peer)): ConnectInfo<Peer>,
    verb: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    // What is no text is no command either.
    let verb = verb.map(|Path(verb)| verb).unwrap_or_default();
    site.commands.answer(peer, &verb, &headers, guard::whole(body)).await
}

pub(super) fn json(code: StatusCode, body: &impl Serialize) -> Response {
    let mut response = text("application/json", bytes(body));
    *response.status_mut() = code;
    response
}

/// Our own structs are always JSON; were one not, the answer would be empty and the server would go on.
fn bytes(body: &impl Serialize) -> Bytes {
    serde_json::to_vec(body).unwrap_or_default().into()
}

pub(super) fn error(code: StatusCode, error: &str) -> Response {
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
