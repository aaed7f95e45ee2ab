//! The tick rate: told at the start, followed while ticks leave room, announced when it changes.

use super::*;

#[tokio::test(flavor = "multi_thread")]
async fn a_rate_that_changes_is_announced_to_every_client() {
    // A trial that counts a thousand solves a tick expects slow ticks; those of the falling sheet need a few and leave room.
    let change = |config: &mut Config| (config.session.solves, config.session.least_solves) = (1000, 1000);
    let server = Server::start_with(12, change).await;
    let mut hand = server.socket("default", "haptic", Some("kesi.haptic.v1")).await;
    let mut viewer = server.socket("default", "view", Some("kesi.view.v1")).await;
    let rate = |hello: &Value| hello["tick_hz"].as_f64().unwrap();
    let mut first = 0.0;
    for socket in [&mut hand, &mut viewer] {
        first = rate(&socket.json().await);
        let status = loop {
            let status = socket.expect("status").await;
            if status["code"] == "tick_rate" {
                break status;
            }
        };
        let words = format!(" instead of {first} ticks per second");
        assert_eq!(status["level"], "info");
        assert!(status["message"].as_str().unwrap().ends_with(&words), "{status}, after {first} Hz");
    }
    let now = rate(&server.socket("default", "haptic", Some("kesi.haptic.v1")).await.json().await);
    assert!(now > first, "{now} Hz");
    assert!(rate(&server.socket("default", "view", Some("kesi.view.v1")).await.json().await) > first);
    assert!(rate(&server.json("/v1/sessions/default").await) > first);
    assert!(rate(&server.json("/v1/sessions/default/state").await) > first);
    assert!(server.metric("kesi_tick_rate_hertz").await > first);
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rate_that_the_scene_gives_stays() {
    let server = Server::serve(Plan { tick_hz: Some(125.0), ..small_plan(12) }, |_| {}).await;
    let mut hand = server.socket("default", "haptic", Some("kesi.haptic.v1")).await;
    assert_eq!(hand.json().await["tick_hz"], 125.0);
    server.until("ticks have run", async || server.metric("kesi_steps_total").await > 200.0).await;
    assert_eq!(server.json("/v1/sessions/default").await["tick_hz"], 125.0);
    server.shut_down().await;
}
