//! The view socket: hello, topology, frames; two in flight; late viewers.

use super::*;

/// Topology and first frame of a viewer that just came.
async fn first_picture(viewer: &mut Socket) -> (Vec<u8>, Vec<u8>) {
    (viewer.binary().await, viewer.binary().await)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_gets_hello_topology_and_frames_to_the_byte() {
    let server = Server::start().await;
    let mut viewer = server.socket("default", "view", Some("kesi.view.v1")).await;
    let hello = viewer.json().await;
    assert_eq!((&hello["op"], &hello["protocol"]), (&json!("hello"), &json!("kesi.view.v1")));
    assert_eq!((&hello["session"], &hello["scene"]["particles"]), (&json!("default"), &json!([12, 12])));
    assert!(hello["server"].as_str().unwrap().starts_with("kesi "));
    assert!(hello["fabric"]["name"].is_string() && hello["obstacles"].is_array());

    let (topology, frame) = first_picture(&mut viewer).await;
    assert_eq!((topology[0], frame[0]), (0x82, 0x83));
    let [v, t] = [u32_at(&topology, 8) as usize, u32_at(&topology, 12) as usize];
    assert_eq!((v, t, topology[16], topology[18]), (144, 2 * 11 * 11, 12, 12));
    assert_eq!(topology.len(), 24 + 4 * v + 12 * t + v.next_multiple_of(4));
    assert!((0..v).all(|k| u32_at(&topology, 24 + 4 * k) < 144));
    assert!((0..3 * t).all(|k| (u32_at(&topology, 24 + 4 * v + 4 * k) as usize) < v));
    let poses = hello["obstacles"].as_array().unwrap().len();
    assert_eq!(frame.len(), 96 + 12 * v + 28 * poses);
    assert_eq!(u32_at(&frame, 16), u32_at(&topology, 4), "the frame belongs to the epoch");
    assert_eq!(u32_at(&frame, 20) as usize, v);
    assert!((32..frame.len()).step_by(4).filter(|&at| at != 92).all(|at| f32_at(&frame, at).is_finite()));
    assert_eq!(frame[1] & 8, 0, "nobody holds");

    viewer.say(json!({"op":"ack","frame":u32_at(&frame, 4)})).await;
    let mut hand = server.hand("default").await;
    hand.grab("00").await;
    loop {
        let frame = viewer.binary().await;
        viewer.say(json!({"op":"ack","frame":u32_at(&frame, 4)})).await;
        if frame[1] & 8 == 8 {
            assert_eq!((frame[1] & 4, u32_at(&frame, 28)), (4, 0), "the hand holds particle 0");
            break;
        }
        hand.say(json!({"op":"ping","t_us":0})).await;
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_late_viewer_sees_the_present_state_at_once() {
    let server = Server::start().await;
    server.until("ticks have run", async || server.metric("kesi_steps_total").await > 30.0).await;
    let mut viewer = server.viewer("default").await;
    let (topology, frame) = first_picture(&mut viewer).await;
    assert_eq!((topology[0], frame[0]), (0x82, 0x83));
    assert!(u64_at(&frame, 8) > 0, "not the start");
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn at_most_two_frames_wait_for_acknowledgement_and_then_the_newest_comes() {
    // 250 Hz: 100 ticks are a while.
    let server = Server::serve(Plan { tick_hz: Some(250.0), ..small_plan(12) }, |_| {}).await;
    let mut viewer = server.viewer("default").await;
    viewer.say(json!({"op":"hello","rate_hz":60})).await;
    let (_, first) = first_picture(&mut viewer).await;
    let second = viewer.binary().await;
    server
        .until("a frame was skipped", async || server.metric("kesi_view_frames_skipped_total").await >= 1.0)
        .await;
    let steps = server.metric("kesi_steps_total").await;
    server.until("100 more ticks", async || server.metric("kesi_steps_total").await > steps + 100.0).await;
    assert_eq!(server.metric("kesi_view_frames_sent_total").await, 2.0);
    viewer.say(json!({"op":"ack","frame":u32_at(&second, 4)})).await;
    let third = viewer.binary().await;
    let [a, b, c] = [&first, &second, &third].map(|f| u64_at(f, 8));
    assert!(a < b && b + 300_000 < c, "{a} {b} {c}: the frame after the wait is of now, not of then");
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewers_mistakes_are_named() {
    let server = Server::start().await;
    let mut viewer = server.viewer("default").await;
    for (text, code) in [
        ("[]", "bad_message"),
        (r#"{"op":"grab"}"#, "bad_message"),
        (r#"{"op":"hello","rate_hz":0}"#, "bad_rate"),
        (r#"{"op":"hello","rate_hz":-5}"#, "bad_rate"),
    ] {
        viewer.text(text).await;
        assert_eq!(viewer.expect("error").await["code"], code, "{text}");
    }
    viewer.bytes(vec![0x83]).await;
    assert_eq!(viewer.expect("error").await["code"], "bad_frame");
    server.shut_down().await;
}
