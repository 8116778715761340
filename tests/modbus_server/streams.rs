//! Requests as a stream of bytes: cut anywhere, sent together, never finished, or no Modbus at all.

use std::time::Duration;

use cangate::modbus::{End, ModbusSettings};

use crate::support::modbus::{frame, serve};
use crate::support::registers::pdu;

fn impatient() -> ModbusSettings {
    ModbusSettings { partial_frame_timeout_ms: 100, send_timeout_ms: 100, ..ModbusSettings::default() }
}

#[tokio::test]
async fn a_request_may_be_cut_at_every_byte() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    client.0.set_nodelay(true).unwrap();
    let request = frame(0x0102, 1, &pdu(4, 100, 2));
    for cut in 1..request.len() {
        client.send(&request[..cut]).await;
        tokio::time::sleep(Duration::from_millis(2)).await;
        client.send(&request[cut..]).await;
        assert_eq!(client.receive().await, Some((0x0102, 1, vec![4, 4, 4, 0xE7, 4, 0xE7])), "cut at {cut}");
    }
}

#[tokio::test]
async fn f32_a_request_may_dribble_in_byte_by_byte() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    client.0.set_nodelay(true).unwrap();
    for byte in frame(3, 1, &pdu(4, 100, 1)) {
        client.send(&[byte]).await;
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    assert_eq!(client.receive().await, Some((3, 1, vec![4, 2, 4, 0xE7])));
}

#[tokio::test]
async fn f33_pipelined_requests_are_all_answered_in_order() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    // Transaction ids are the client's business: none, the highest, and one twice.
    let ids: Vec<u16> = (0..500_u16).map(|n| if n % 7 == 0 { 0xFFFF } else { n % 100 }).collect();
    let mut burst = Vec::new();
    for (place, id) in ids.iter().enumerate() {
        let unit = if place % 3 == 0 { 99 } else { 247 };
        burst.extend(frame(*id, unit, &pdu(4, 0, u16::try_from(place % 100 + 1).unwrap())));
    }
    let half = frame(0xAAAA, 247, &pdu(4, 90, 1));
    burst.extend(&half[..5]);
    client.send(&burst).await;
    for (place, id) in ids.iter().enumerate() {
        let (transaction, unit, answer) = client.receive().await.unwrap();
        assert_eq!(transaction, *id);
        if place % 3 == 0 {
            assert_eq!((unit, answer), (99, vec![0x84, 0x0B]));
        } else {
            assert_eq!((unit, answer.len()), (247, 2 + 2 * (place % 100 + 1)));
        }
    }
    client.send(&half[5..]).await;
    assert_eq!(client.receive().await, Some((0xAAAA, 247, vec![4, 2, 0x12, 0x34])));
    assert_eq!(server.counters.values().requests, 501);
}

#[tokio::test]
async fn f31_half_a_request_and_silence_ends_the_session_and_only_that() {
    let server = serve(impatient()).await;
    let (mut silent, mut other) = (server.client().await, server.client().await);
    silent.send(&frame(1, 1, &pdu(4, 0, 1))[..6]).await;
    silent.closed().await;
    server.until(|counters| counters.ended(End::PartialFrame) == 1).await;
    assert!(other.works().await, "a client without a request under way may be silent as long as it likes");
}

#[tokio::test]
async fn a_complete_request_before_an_incomplete_one_is_answered() {
    let server = serve(impatient()).await;
    let mut client = server.client().await;
    client.send(&[frame(1, 247, &pdu(4, 90, 1)), vec![0, 2, 0]].concat()).await;
    assert_eq!(client.receive().await, Some((1, 247, vec![4, 2, 0x12, 0x34])));
    client.closed().await;
}

#[tokio::test]
async fn f34_a_length_that_cannot_be_ends_the_session_at_once() {
    let server = serve(ModbusSettings::default()).await;
    let lengths: [u16; 5] = [0, 1, 255, 256, 65_535];
    for length in lengths {
        let mut client = server.client().await;
        let [high, low] = length.to_be_bytes();
        client.send(&[frame(1, 247, &pdu(4, 90, 1)), vec![0, 2, 0, 0, high, low]].concat()).await;
        assert!(client.receive().await.is_some(), "what came before is answered");
        client.closed().await;
    }
    server.until(|counters| counters.ended(End::Malformed) == 5 && counters.open == 0).await;
}

#[tokio::test]
async fn f35_a_frame_of_another_protocol_is_discarded_and_the_session_stays() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    let mut foreign = frame(1, 247, &pdu(4, 90, 1));
    foreign[2] = 1;
    client.send(&foreign).await;
    assert!(client.works().await);
    assert_eq!(server.counters.values().foreign_frames, 1);
}

#[tokio::test]
async fn p17_a_client_that_does_not_read_is_closed_and_others_do_not_notice() {
    let server = serve(impatient()).await;
    let mut deaf = server.client().await;
    let burst = frame(1, 247, &pdu(4, 200, 125)).repeat(1000);
    let asking = tokio::spawn(async move {
        // Ends when the server closes: nothing else stops it.
        while tokio::io::AsyncWriteExt::write_all(&mut deaf.0, &burst).await.is_ok() {}
    });
    let mut other = server.client().await;
    let mut rounds = 0;
    while server.counters.values().ended(End::SlowClient) == 0 {
        assert!(other.works().await, "while the deaf one blocks its own connection");
        rounds += 1;
    }
    assert!(rounds > 0);
    asking.await.unwrap();
}

#[tokio::test]
async fn a_reset_in_the_middle_of_a_request_frees_the_place() {
    let server = serve(ModbusSettings::default()).await;
    let mut client = server.client().await;
    assert!(client.works().await);
    client.send(&[0, 1, 0]).await;
    client.0.set_zero_linger().unwrap();
    drop(client);
    server.until(|counters| counters.open == 0 && counters.accepted == 1).await;
}

#[tokio::test]
async fn the_idle_time_out_is_off_unless_asked_for() {
    let server = serve(ModbusSettings { idle_timeout_s: 1, ..ModbusSettings::default() }).await;
    let mut client = server.client().await;
    assert!(client.works().await);
    client.closed().await;
    server.until(|counters| counters.ended(End::Idle) == 1).await;
    assert_eq!(ModbusSettings::default().idle_timeout(), None);
}
