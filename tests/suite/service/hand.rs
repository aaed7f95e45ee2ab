//! The haptic socket: grab, move, feel; be denied, lose the lease, be told of mistakes.

use super::*;

#[tokio::test(flavor = "multi_thread")]
async fn a_client_written_from_the_document_grabs_moves_and_feels() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    let device = json!({"max_force_n":3.3,"max_stiffness_n_per_m":400,"rate_hz":1000});
    hand.say(json!({"op":"hello","client":"test","device":device})).await;
    let granted = hand.grab("00").await;
    assert_eq!((&granted["particle"], &granted["lease_ms"]), (&json!([0, 0]), &json!(125.0)));
    let home = position_of(&granted);

    let mut models = Vec::new();
    for seq in 1..=20_u32 {
        let z = home[2] + 1e-4 * f64::from(seq);
        let pose = [home[0], home[1], z];
        if seq % 2 == 0 {
            hand.bytes(move_bytes(seq, 1000 + u64::from(seq), pose)).await;
        } else {
            hand.say(json!({"op":"move","seq":seq,"t_us":1000 + seq,"position_m":pose})).await;
        }
        loop {
            let model = hand.binary().await;
            assert_eq!((model.len(), model[0], u32_at(&model, 124)), (128, 0x81, 0));
            models.push(model);
            let model = models.last().unwrap();
            if u32_at(model, 24) == seq {
                assert_eq!(u64_at(model, 16), 1000 + u64::from(seq));
                assert!((f32_at(model, 40) - z as f32).abs() < 1e-6, "the hand is where it was moved to");
                break;
            }
            // A machine under load may be slow here; a holder that is heard keeps its lease.
            hand.say(json!({"op":"ping","t_us":5})).await;
        }
    }
    for (k, model) in models.iter().enumerate() {
        assert_eq!(u32_at(model, 4), k as u32 + 1, "models are numbered without gaps");
        assert_eq!(f32_at(model, 28), 125.0);
        for at in (32..112).step_by(4) {
            assert!(f32_at(model, at).is_finite(), "offset {at}");
        }
        assert!(f32_at(model, 104) > 0.0 && f32_at(model, 108) > 0.0 && u32_at(model, 116) > 0);
    }
    let times: Vec<u64> = models.iter().map(|m| u64_at(m, 8)).collect();
    assert!(times.is_sorted(), "states never go back");

    hand.say(json!({"op":"release"})).await;
    loop {
        let answer = hand.json().await;
        if answer["op"] == "released" {
            assert_eq!(answer["code"], "client");
            break;
        }
        assert!(answer["op"] == "pong" || answer["op"] == "status", "{answer}");
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn stiffness_is_clamped_to_the_device_and_says_so() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    let device = json!({"max_force_n":1,"max_stiffness_n_per_m":0.001,"rate_hz":1000});
    hand.say(json!({"op":"hello","client":"soft","device":device})).await;
    hand.grab("00").await;
    let model = hand.binary().await;
    assert_eq!(model[1] & 4, 4, "the clamp is flagged");
    let trace: f32 = [80, 92, 100].iter().map(|&at| f32_at(&model, at)).sum();
    assert!((0.0..=0.0031).contains(&trace), "{trace}");
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_hand_at_a_time_and_a_closed_socket_lets_go() {
    let server = Server::start().await;
    let mut first = server.hand("default").await;
    let mut second = server.hand("default").await;
    first.grab("00").await;
    second.say(json!({"op":"grab","at":{"corner":"IJ"}})).await;
    let denied = second.expect("denied").await;
    assert_eq!(denied["code"], "held_by_another");
    drop(first);
    assert_eq!(second.grab("IJ").await["particle"], json!([11, 11]));
    server
        .until("the state tells who is held", async || {
            let hand = &server.json("/v1/sessions/default/state").await["hand"];
            hand["particle"] == json!([11, 11]) || hand["held"] == json!(false)
        })
        .await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_holder_loses_its_grab_and_the_socket_stays() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    hand.grab("0J").await;
    let released = hand.expect("released").await;
    assert_eq!(released["code"], "silent");
    hand.bytes(move_bytes(1, 1, [0.0; 3])).await;
    assert_eq!(hand.expect("error").await["code"], "not_holding");
    hand.grab("0J").await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn pings_keep_a_grab_and_models_keep_coming() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    hand.grab("00").await;
    let mut pongs = 0;
    // Twice the lease in heartbeats of 50 ms, were nothing but heartbeats sent.
    while pongs < 6 {
        match hand.next().await {
            Message::Binary(model) => {
                assert_eq!(u64_at(&model, 16), 0, "no move yet");
                hand.say(json!({"op":"ping","t_us":77})).await;
            }
            Message::Text(text) => {
                let message: Value = serde_json::from_str(&text).unwrap();
                assert_ne!(message["op"], "released", "{message}");
                if message["op"] == "pong" {
                    assert_eq!(message["t_us"], 77);
                    pongs += 1;
                }
            }
            other => panic!("{other:?}"),
        }
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_mistake_is_named_and_changes_nothing() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    let text = |t: &str| Message::text(t.to_string());
    let free = [
        (text("not json"), "bad_message"),
        (text(r#"{"op":"fly"}"#), "bad_message"),
        (text(r#"{"op":"grab"}"#), "bad_message"),
        (text(r#"{"op":"grab","at":{"corner":"22"}}"#), "bad_message"),
        (text(r#"{"op":"move","seq":1,"t_us":1,"position_m":[null,0,0]}"#), "bad_message"),
        (text(r#"{"op":"move","seq":1,"t_us":1,"position_m":[1e999,0,0]}"#), "bad_message"),
        (text(r#"{"op":"hello","device":{"max_stiffness_n_per_m":-1}}"#), "bad_device"),
        (Message::binary(vec![1, 2, 3]), "bad_frame"),
        (Message::binary(vec![0x7f; 40]), "bad_frame"),
        (Message::binary(Vec::new()), "bad_frame"),
        (Message::binary(move_bytes(1, 1, [0.0; 3])), "not_holding"),
        (text(r#"{"op":"release"}"#), "not_holding"),
    ];
    for (message, code) in free {
        hand.ws.send(message.clone()).await.unwrap();
        let error = hand.expect("error").await;
        assert_eq!(error["code"], code, "{message:?}: {error}");
        assert!(error["message"].as_str().unwrap().len() > 10, "{error}");
    }
    hand.say(json!({"op":"grab","at":{"particle":[12, 0]}})).await;
    assert_eq!(hand.expect("denied").await["code"], "no_such_particle");

    let granted = hand.grab("00").await;
    let [x, y, z] = position_of(&granted);
    hand.bytes(move_bytes(5, 50, [x, y, z])).await;
    for (seq, position, code) in [
        (5, [x, y, z], "stale_seq"),
        (4, [x, y, z], "stale_seq"),
        (6, [f64::NAN, y, z], "not_finite"),
        (6, [x, f64::INFINITY, z], "not_finite"),
        (6, [x, y, 10.1], "too_far"),
        (6, [1e300, y, z], "too_far"),
    ] {
        hand.bytes(move_bytes(seq, 60, position)).await;
        assert_eq!(hand.expect("error").await["code"], code, "{seq} {position:?}");
        hand.say(json!({"op":"ping","t_us":1})).await;
        hand.expect("pong").await;
    }
    hand.bytes(move_bytes(6, 60, [x, y, z])).await;
    loop {
        let model = hand.binary().await;
        if u32_at(&model, 24) == 6 {
            assert_eq!(u64_at(&model, 16), 60, "refused moves left no trace");
            break;
        }
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_too_large_is_named_and_closes_the_socket() {
    let server = Server::start().await;
    for kind in ["haptic", "view"] {
        let mut socket = server.socket("default", kind, Some(&format!("kesi.{kind}.v1"))).await;
        assert_eq!(socket.json().await["op"], "hello");
        socket.text(&"x".repeat(5000)).await;
        assert_eq!(socket.expect("error").await["code"], "too_large");
        assert_eq!(socket.closed().await.0, 1009);
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn another_subprotocol_is_told_both_versions() {
    let server = Server::start().await;
    for (kind, asked) in
        [("haptic", Some("kesi.haptic.v9")), ("haptic", None), ("view", Some("chat")), ("view", None)]
    {
        let mut socket = server.socket("default", kind, asked).await;
        let (code, words) = socket.closed().await;
        assert_eq!(code, 1002);
        assert!(words.contains(&format!("kesi.{kind}.v1")), "{words}");
        assert!(words.contains(asked.unwrap_or("no subprotocol")), "{words}");
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn shutdown_reaches_every_socket() {
    let mut server = Server::start().await;
    let mut hand = server.hand("default").await;
    let mut other = server.hand("default").await;
    let mut viewer = server.viewer("default").await;
    hand.grab("00").await;
    server.begin_shutdown();
    assert_eq!(hand.expect("released").await["code"], "shutdown");
    for socket in [&mut hand, &mut other, &mut viewer] {
        assert_eq!(socket.closed().await.0, 1001);
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn ending_a_session_ends_its_clients_and_no_others() {
    let server = Server::start().await;
    let (status, body) = server.request("POST", "/v1/sessions", &[], "").await;
    assert_eq!(status, 201, "{body}");
    let id = serde_json::from_str::<Value>(&body).unwrap()["id"].as_str().unwrap().to_string();
    let mut hand = server.hand(&id).await;
    let mut viewer = server.viewer(&id).await;
    let mut bystander = server.viewer("default").await;
    hand.grab("00").await;
    let path = format!("/v1/sessions/{id}");
    assert_eq!(server.request("DELETE", &path, &[], "").await.0, 204);
    assert_eq!(hand.expect("released").await["code"], "session_ended");
    assert_eq!(hand.closed().await.0, 1000);
    assert_eq!(viewer.closed().await.0, 1000);
    assert_eq!(server.get(&path).await.0, 404);
    assert_eq!(bystander.binary().await[0], 0x82);
    server.shut_down().await;
}
