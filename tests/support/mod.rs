//! What several tests need.
pub mod conversation;
pub mod fake_broker;
pub mod http;
pub mod lines;
pub mod modbus;
pub mod mosquitto;
pub mod mqtt_client;
pub mod pki;
pub mod plant;
pub mod ports;
pub mod registers;
pub mod secure_modbus;
pub mod secure_web;

use std::time::Duration;

/// How long a test waits for what has to happen, however slow the machine.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Tries again and again until there is an answer; fails loudly when there is none in [`PATIENCE`].
pub async fn until<T>(what: &str, mut attempt: impl AsyncFnMut() -> Option<T>) -> T {
    let tries = async {
        loop {
            if let Some(answer) = attempt().await {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let answer = tokio::time::timeout(PATIENCE, tries).await;
    answer.unwrap_or_else(|_| panic!("not within {} s: {what}", PATIENCE.as_secs()))
}
pub mod world;
