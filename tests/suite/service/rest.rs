//! A cloth at rest: its session sleeps, and its clients do not notice.

use super::*;

/// Waits until the session's thread sleeps.
async fn until_resting(server: &Server) {
    server.until("the cloth is at rest", async || server.metric("kesi_resting").await == 1.0).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_resting_session_takes_no_step_until_a_command_comes() {
    let server = Server::start_with(8, |_| {}).await;
    until_resting(&server).await;
    let steps = server.metric("kesi_steps_total").await;
    // A viewer that comes now sees the present state, and then nothing, because nothing happens.
    let mut viewer = server.viewer("default").await;
    assert_eq!(viewer.binary().await[0], 0x82);
    let frame = viewer.binary().await;
    assert_eq!((frame[0], frame[1] & 2), (0x83, 2), "the frame says that the cloth rests");
    viewer.say(json!({"op":"ack","frame":u32_at(&frame, 4)})).await;
    assert_eq!(server.metric("kesi_steps_total").await, steps, "frames for viewers take no steps");
    assert_eq!(server.json("/v1/sessions/default/state").await["resting"], true);

    let mut hand = server.hand("default").await;
    let granted = hand.grab("00").await;
    let mut home = position_of(&granted);
    home[2] += 0.005;
    hand.bytes(move_bytes(1, 1, home)).await;
    let awake = viewer.binary().await;
    assert!(u64_at(&awake, 8) > u64_at(&frame, 8));
    assert!(server.metric("kesi_steps_total").await > steps);
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hand_on_a_resting_cloth_hears_models_of_the_same_state() {
    let server = Server::start_with(8, |_| {}).await;
    until_resting(&server).await;
    let mut hand = server.hand("default").await;
    hand.grab("00").await;
    let mut same = 0;
    let mut last = (0, 0);
    while same < 4 {
        let model = hand.binary().await;
        hand.say(json!({"op":"ping","t_us":0})).await;
        let (number, time) = (u32_at(&model, 4), u64_at(&model, 8));
        assert_eq!(number, last.0 + 1);
        same = if time == last.1 { same + 1 } else { 0 };
        last = (number, time);
        if same > 0 {
            assert_eq!(model[1] & 2, 2, "a repeated model is of a cloth at rest");
        }
    }
    server.shut_down().await;
}
