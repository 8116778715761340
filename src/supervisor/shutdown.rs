//! SIGTERM and SIGINT: the order to stop, and when it comes again, to stop at once; SIGHUP: to read the files again. \[IO\]

use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

/// An order to stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Order {
    Terminate,
    Interrupt,
}

impl Order {
    fn name(self) -> &'static str {
        match self {
            Self::Terminate => "SIGTERM",
            Self::Interrupt => "SIGINT",
        }
    }

    /// What a shell shows of a process that this signal ended: 128 and its number.
    fn exit_code(self) -> i32 {
        match self {
            Self::Terminate => 143,
            Self::Interrupt => 130,
        }
    }
}

/// Cancels `stop` at the first SIGTERM or SIGINT; at the second the process ends at once.
///
/// # Errors
/// The system refuses signal handlers.
pub fn on_signal(stop: CancellationToken) -> std::io::Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    // The second order is the last that matters.
    let (give, orders) = mpsc::channel(2);
    tokio::spawn(async move {
        loop {
            let order = tokio::select! {
                _ = terminate.recv() => Order::Terminate,
                _ = interrupt.recv() => Order::Interrupt,
            };
            if give.send(order).await.is_err() {
                return;
            }
        }
    });
    tokio::spawn(async move {
        if let Some(again) = obey(orders, stop).await {
            std::process::exit(again.exit_code());
        }
    });
    Ok(())
}

/// Each SIGHUP asks for the configuration to be read again; several that come while one is dealt with are one.
///
/// # Errors
/// The system refuses the signal handler.
pub fn on_hang_up() -> std::io::Result<mpsc::Receiver<()>> {
    let mut hang_up = signal(SignalKind::hangup())?;
    let (ask, asked) = mpsc::channel(1);
    tokio::spawn(async move {
        while hang_up.recv().await.is_some() {
            if matches!(ask.try_send(()), Err(mpsc::error::TrySendError::Closed(()))) {
                return;
            }
        }
    });
    Ok(asked)
}

/// Stops at the first order; returns at the second.
async fn obey(mut orders: mpsc::Receiver<Order>, stop: CancellationToken) -> Option<Order> {
    let first = orders.recv().await?;
    info!("{}: stopping; the devices on the bus keep running", first.name());
    stop.cancel();
    let again = orders.recv().await?;
    warn!("{} again: ending at once", again.name());
    Some(again)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_first_order_stops_and_only_a_second_one_ends_at_once() {
        let (give, orders) = mpsc::channel(2);
        let stop = CancellationToken::new();
        let obeying = tokio::spawn(obey(orders, stop.clone()));
        give.send(Order::Terminate).await.unwrap();
        stop.cancelled().await;
        assert!(!obeying.is_finished());
        give.send(Order::Interrupt).await.unwrap();
        assert_eq!(obeying.await.unwrap(), Some(Order::Interrupt));
    }
}
