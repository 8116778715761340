//! `POST /api/v1/commands/{verb}` \[IO\]: requests of clients that have a token, or logged in.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::body::Bytes;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde_json::Value as Json;

use super::guard::{Guard, Refused, refusal};
use super::server::json;
use super::sessions::Use;
use crate::gateway::command::request::{self, Reply, VERBS};
use crate::gateway::command::{Authority, CommandSource, Desk, Outcome};
use crate::mapping::TagTable;

/// Where requests are handed in.
#[derive(Debug)]
pub struct Commands {
    desk: Desk,
    table: Arc<TagTable>,
    guard: Arc<Guard>,
}

impl Commands {
    /// For the gateway behind a desk; `guard` knows who asks.
    #[must_use]
    pub fn new(desk: Desk, table: Arc<TagTable>, guard: Arc<Guard>) -> Self {
        Self { desk, table, guard }
    }

    /// The same at another desk, with what there is now.
    #[must_use]
    pub fn at(&self, desk: Desk, table: Arc<TagTable>) -> Self {
        self.guard.set_desk(desk.clone());
        Self { desk, table, guard: Arc::clone(&self.guard) }
    }

    /// Carries a request out and answers it. `body`: as far as it came.
    pub async fn answer(
        &self,
        peer: SocketAddr,
        verb: &str,
        headers: &HeaderMap,
        body: Result<Bytes, Refused>,
    ) -> Response {
        let known = VERBS.into_iter().find(|known| *known == verb);
        let source = CommandSource::web(peer.to_string());
        let refuse = |source: CommandSource, (code, why): Refused| {
            self.desk.refuse(source, known.unwrap_or("command"), why.to_owned());
            refusal((code, why))
        };
        let grant = match self.guard.who(peer, headers, Use::Act).await {
            Ok(grant) => grant,
            Err(refused) => return refuse(source, refused),
        };
        let mut source = source;
        source.access = Some(Arc::clone(grant.name()));
        if let Err(refused) = self.guard.check_form(headers) {
            return refuse(source, refused);
        }
        let Some(verb) = known else {
            return refuse(source, (StatusCode::NOT_FOUND, "there is no such command; see docs/commands.md"));
        };
        let body = match body {
            Ok(body) => body,
            Err(refused) => return refuse(source, refused),
        };
        let Ok(Json::Object(members)) = serde_json::from_slice(&body) else {
            return refuse(source, (StatusCode::BAD_REQUEST, "a command is a JSON object"));
        };
        if members.contains_key("transaction") || members.contains_key("expires") {
            let why = "`transaction` and `expires` are for MQTT: an answer here is that of its request";
            return refuse(source, (StatusCode::BAD_REQUEST, why));
        }
        match request::read(verb, &members, &self.table) {
            Ok(action) => {
                let outcome = self.desk.ask(source, &Authority::Grant(grant), action).await;
                json(status(&outcome), &Reply::new(verb, outcome))
            }
            Err(reply) => {
                self.desk.refuse(source, verb, reply.message.clone());
                let unknown = reply.result.starts_with("unknown");
                json(if unknown { StatusCode::NOT_FOUND } else { StatusCode::BAD_REQUEST }, &reply)
            }
        }
    }
}

fn status(outcome: &Outcome) -> StatusCode {
    match outcome {
        Outcome::Done | Outcome::Read(_) => StatusCode::OK,
        Outcome::Unknown => StatusCode::NOT_FOUND,
        Outcome::Rejected(_) => StatusCode::BAD_REQUEST,
        Outcome::Forbidden(_) => StatusCode::FORBIDDEN,
        Outcome::Busy | Outcome::NodeUnavailable => StatusCode::SERVICE_UNAVAILABLE,
        Outcome::Timeout => StatusCode::GATEWAY_TIMEOUT,
        Outcome::Aborted(_) | Outcome::Failed(_) => StatusCode::BAD_GATEWAY,
    }
}
