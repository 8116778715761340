//! `cangate nmt`: sends one NMT command. \[IO\]

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::Exit;
use super::output::{block_on, print_error, print_line};
use super::session::{Session, SessionError, check_company};
use super::tool_args::{NmtArguments, NodeTarget};
use crate::can::BusEvent;
use crate::can::interface::Interface;
use crate::canopen::NmtRequest;
use crate::time::Clock;

/// How long a frame has to come back from a bus on which it cannot leave.
const SETTLE: Duration = Duration::from_millis(200);

/// Sends the command.
pub(super) fn run(arguments: &NmtArguments) -> Exit {
    let request = NmtRequest::from(arguments.command);
    if let Err(text) = check(request, arguments.node, arguments.yes) {
        print_error(&text);
        return Exit::Usage;
    }
    block_on(async {
        let sent = match check_company(&arguments.interface) {
            Ok(()) => send(&arguments.interface, request, arguments.node, Clock::start()).await,
            Err(error) => Err(error),
        };
        match sent {
            Ok(text) => {
                print_line(&text);
                Exit::Ok
            }
            Err(error) => {
                print_error(&error.to_string());
                error.exit()
            }
        }
    })
}

/// Stopping or resetting a whole plant must be meant.
fn check(request: NmtRequest, target: NodeTarget, yes: bool) -> Result<(), String> {
    let harmless = match request {
        NmtRequest::Start | NmtRequest::EnterPreOperational => true,
        NmtRequest::Stop | NmtRequest::ResetNode | NmtRequest::ResetCommunication => false,
    };
    if harmless || yes || target.0.is_some() {
        return Ok(());
    }
    Err(format!(
        "`{} all` acts on every device of the bus, also on those that you do not think of; add --yes if it is meant",
        word(request)
    ))
}

fn word(request: NmtRequest) -> &'static str {
    match request {
        NmtRequest::Start => "start",
        NmtRequest::Stop => "stop",
        NmtRequest::EnterPreOperational => "pre-operational",
        NmtRequest::ResetNode => "reset-node",
        NmtRequest::ResetCommunication => "reset-communication",
    }
}

/// Sends one frame; says which.
async fn send(
    interface: &Interface,
    request: NmtRequest,
    target: NodeTarget,
    clock: Clock,
) -> Result<String, SessionError> {
    let mut session = Session::open(interface, false, clock, CancellationToken::new()).await?;
    let frame = request.frame(target.0);
    session.send(frame)?;
    let deadline = clock.now().instant + SETTLE;
    while let Some(event) = session.next(deadline).await? {
        if let BusEvent::NotSent { frame, .. } = event {
            return Err(SessionError::NotSent { interface: session.interface().to_owned(), frame });
        }
    }
    session.close().await?;
    Ok(format!(
        "sent to {target}: {} ({frame}); nodes do not confirm it, `cangate scan` shows their states",
        word(request)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::BusReader;
    use crate::can::virtual_bus;

    #[tokio::test(start_paused = true)]
    async fn one_frame_is_sent_and_told() {
        let clock = Clock::start();
        let (mut reader, _writer) = virtual_bus::join("nmt-one", clock);
        let interface = "virtual:nmt-one".parse().unwrap();
        let text = send(&interface, NmtRequest::Start, "5".parse().unwrap(), clock).await.unwrap();
        assert!(text.starts_with("sent to node 5: start (000#0105)"), "{text}");
        let mut frames = Vec::new();
        let silence = tokio::time::timeout(Duration::from_secs(5), async {
            loop {
                if let BusEvent::Frame { frame, .. } = reader.recv().await.unwrap() {
                    frames.push(frame.to_string());
                }
            }
        });
        assert!(silence.await.is_err());
        assert_eq!(frames, ["000#0105"]);
    }

    #[test]
    fn stopping_or_resetting_all_nodes_must_be_confirmed() {
        let (all, one) = (NodeTarget(None), "1".parse().unwrap());
        for request in [NmtRequest::Stop, NmtRequest::ResetNode, NmtRequest::ResetCommunication] {
            let error = check(request, all, false).unwrap_err();
            assert!(error.contains("--yes"), "{error}");
            assert_eq!(check(request, all, true), Ok(()));
            assert_eq!(check(request, one, false), Ok(()));
        }
        assert_eq!(check(NmtRequest::Start, all, false), Ok(()));
        assert_eq!(check(NmtRequest::EnterPreOperational, all, false), Ok(()));
    }
}
