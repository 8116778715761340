//! Tests of the SDO client: its rules one by one, and against a server on a bus that loses, repeats and delays frames.

mod blocks;
mod faults;
mod rules;
mod server;

use self::server::{Abilities, Server};
use super::{
    AbortCode, ProtocolError, Refused, SdoAction, SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings,
    TransferId,
};
use crate::can::{CanFrame, CanId};
use crate::canopen::NodeId;
use crate::canopen::object::ObjectId;
use crate::time::Instant;

const NAME: ObjectId = ObjectId::new(0x1008, 0);
const TIMER: ObjectId = ObjectId::new(0x1800, 5);

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn client(settings: SdoSettings) -> SdoClient {
    SdoClient::new(NodeId::new(1).unwrap(), settings)
}

/// All outputs: frames in candump notation, results as their id and outcome.
fn outputs(client: &mut SdoClient) -> Vec<String> {
    let mut texts = Vec::new();
    while let Some(output) = client.poll_output() {
        texts.push(match output {
            SdoOutput::Transmit(frame) => frame.to_string(),
            SdoOutput::Done(id, Ok(data)) => format!("{} {data:02X?}", id.0),
            SdoOutput::Done(id, Err(error)) => format!("{} {error:?}", id.0),
        });
    }
    texts
}

fn ask(client: &mut SdoClient, millis: u64, id: u64, request: SdoRequest) -> Vec<String> {
    client.request(at(millis), TransferId(id), request).unwrap();
    outputs(client)
}

fn answer(client: &mut SdoClient, millis: u64, frame: &str) -> Vec<String> {
    client.handle_answer(at(millis), &frame.parse().unwrap());
    outputs(client)
}

fn wait(client: &mut SdoClient, millis: u64) -> Vec<String> {
    client.handle_timeout(at(millis));
    outputs(client)
}

/// Talks to a server until nothing is to be sent.
fn converse(client: &mut SdoClient, server: &mut Server, request: SdoRequest) -> Result<Vec<u8>, SdoError> {
    let mut now = at(0);
    if let Some((at, _)) = client.poll_timeout() {
        now = at;
    }
    client.request(now, TransferId(0), request).unwrap();
    for _ in 0..100_000 {
        match client.poll_output() {
            Some(SdoOutput::Transmit(frame)) => {
                for payload in server.handle(frame.data().try_into().unwrap()) {
                    let frame = CanFrame::data_frame(CanId::Standard(0x581), &payload).unwrap();
                    client.handle_answer(now, &frame);
                }
            }
            Some(SdoOutput::Done(_, result)) => return result,
            None => {
                now = now.max(client.poll_timeout().unwrap().0);
                client.handle_timeout(now);
            }
        }
    }
    panic!("no end");
}
