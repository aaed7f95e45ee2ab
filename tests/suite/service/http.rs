//! The HTTP interface: sessions, snapshots, schema, metrics, and who is kept out.

use super::*;

/// Checks an answer that is no success, and returns its message.
fn failure((status, body): (u16, String), expected: u16, code: &str) -> String {
    assert_eq!(status, expected, "{body}");
    let body: Value = serde_json::from_str(&body).unwrap();
    assert_eq!(body["error"]["code"], code);
    body["error"]["message"].as_str().unwrap().to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_are_made_listed_and_ended() {
    let server = Server::start_with(8, |config| config.limits.sessions = 2).await;
    assert_eq!(server.get("/healthz").await.0, 200);
    let list = server.json("/v1/sessions").await;
    assert_eq!(list["sessions"][0]["id"], "default");
    let (status, body) = server.request("POST", "/v1/sessions", &[], "").await;
    let made: Value = serde_json::from_str(&body).unwrap();
    assert_eq!((status, &made["particles"]), (201, &json!([8, 8])));
    let full = server.request("POST", "/v1/sessions", &[], "").await;
    assert!(failure(full, 503, "too_many_sessions").contains('2'));
    let path = format!("/v1/sessions/{}", made["id"].as_str().unwrap());
    assert_eq!(server.json(&path).await["id"], made["id"]);
    assert_eq!(server.request("DELETE", &path, &[], "").await.0, 204);
    assert!(failure(server.get(&path).await, 404, "no_such_session").contains("default"));
    assert_eq!(server.request("POST", "/v1/sessions", &[], "").await.0, 201);
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_snapshot_has_every_field_of_the_document() {
    let server = Server::start().await;
    let state = server.json("/v1/sessions/default/state").await;
    for key in ["time_s", "step", "residual_n", "energy_j", "max_penetration_m", "solve_ms"] {
        assert!(state[key].is_number(), "{key}: {state}");
    }
    for key in ["total", "newton", "stretch", "bend", "shear"] {
        assert!(state["cost"][key].is_number(), "cost.{key}: {state}");
    }
    assert!(state["resting"].is_boolean());
    assert_eq!(state["particles_total"], 144);
    assert!(state["particles_active"].as_u64().unwrap() + state["particles_ghost"].as_u64().unwrap() <= 144);
    server
        .until("there is a hand", async || {
            let hand = &server.json("/v1/sessions/default/state").await["hand"];
            let vector = |key: &str| hand[key].as_array().is_some_and(|v| v.len() == 3);
            hand["force_error_n"].is_number()
                && ["position_m", "force_n", "stiffness_n_per_m"].into_iter().all(vector)
        })
        .await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mesh_too_coarse_for_its_fabric_is_warned_of_with_one_that_would_do() {
    // 0.3 m of denim-a, which bends over 17.4 mm: 13 particles lie 25 mm apart.
    let server = Server::start_with(13, |_| {}).await;
    let session = server.json("/v1/sessions/default").await;
    let warning = session["warnings"][0].as_str().unwrap();
    for part in ["hang", "[13, 13]", "25.0 mm", "17.4 mm", "denim-a", "[70, 70]"] {
        assert!(warning.contains(part), "{part}: {warning}");
    }
    assert_eq!(server.json("/v1/sessions/default/state").await["warnings"], session["warnings"]);
    let (status, made) = server.request("POST", "/v1/sessions", &[], "\"hang\"").await;
    let made: Value = serde_json::from_str(&made).unwrap();
    assert_eq!((status, &made["warnings"]), (201, &json!([])), "39 × 39 particles are enough");
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn mistakes_get_a_status_a_code_and_a_sentence() {
    let server = Server::start().await;
    failure(server.get("/v1/sessions/none").await, 404, "no_such_session");
    failure(server.get("/v1/sessions/none/state").await, 404, "no_such_session");
    failure(server.get("/v1/sessions/default/recording").await, 404, "no_recording");
    failure(server.get("/v1/nothing").await, 404, "no_such_path");
    failure(server.request("PUT", "/v1/sessions", &[], "").await, 405, "wrong_method");
    failure(server.request("DELETE", "/v1/sessions/none", &[], "").await, 404, "no_such_session");
    let post = async |body: &str| server.request("POST", "/v1/sessions", &[], body).await;
    assert!(failure(post("{").await, 422, "bad_scene").contains("scene"));
    assert!(failure(post("\"nosuch\"").await, 422, "bad_scene").contains("nosuch"));
    failure(post(r#"{"particles":[1,1]}"#).await, 422, "bad_scene");
    failure(post(&" ".repeat(300_000)).await, 413, "bad_body");
    assert_eq!(server.json("/v1/sessions").await["sessions"].as_array().unwrap().len(), 1);
    server.shut_down().await;
}

/// The drape's box sent up into its sheet: the frames carry it there, and the cloth goes along.
#[tokio::test(flavor = "multi_thread")]
async fn an_obstacle_is_pushed_into_the_cloth() {
    let scene = Scene { particles: [12, 12], ..Scene::built_in("drape").unwrap() };
    let server = Server::serve(Plan::of(&scene).unwrap(), |_| {}).await;
    let path = "/v1/sessions/default/obstacles/box";
    let turn = [0.0, 0.0, (0.4_f64).sin(), (0.4_f64).cos()];
    let mut viewer = server.socket("default", "view", Some("kesi.view.v1")).await;
    let from = viewer.json().await["obstacles"][0]["position_m"].clone();
    let to = [from[0].as_f64().unwrap(), from[1].as_f64().unwrap(), from[2].as_f64().unwrap() + 0.05];
    let body = json!({"position_m": to, "rotation_xyzw": turn.map(|c| 2.0 * c), "duration_s": 0.2});
    let (status, answer) = server.request("POST", path, &[], &body.to_string()).await;
    assert_eq!(status, 202, "{answer}");
    let arrived = async {
        loop {
            let frame = viewer.binary().await;
            if frame[0] != 0x83 {
                continue;
            }
            viewer.say(json!({"op":"ack","frame":u32_at(&frame, 4)})).await;
            let vertices = u32_at(&frame, 20) as usize;
            assert_eq!(u32_at(&frame, 92), 1, "one obstacle");
            let pose: [f32; 7] = std::array::from_fn(|k| f32_at(&frame, 96 + 12 * vertices + 4 * k));
            let goal: Vec<f32> = to.iter().chain(&turn).map(|v| *v as f32).collect();
            if pose.iter().zip(&goal).all(|(a, b)| (a - b).abs() < 1e-6) {
                let heights = (0..vertices).map(|v| f32_at(&frame, 96 + 12 * v + 8));
                return heights.fold(f32::NEG_INFINITY, f32::max);
            }
        }
    };
    let top = timeout(PATIENCE, arrived).await.expect("the box arrives");
    // Half a side of 6 cm above its middle.
    assert!(f64::from(top) > to[2] + 0.06, "the cloth lies on the box: {top}");
    let state = server.json("/v1/sessions/default/state").await;
    assert_eq!(state["max_penetration_m"], 0.0);
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_push_that_makes_no_sense_is_refused_by_name() {
    let scene = Scene { particles: [8, 8], ..Scene::built_in("drape").unwrap() };
    let server = Server::serve(Plan::of(&scene).unwrap(), |_| {}).await;
    let push = async |session: &str, name: &str, body: &str| {
        server.request("POST", &format!("/v1/sessions/{session}/obstacles/{name}"), &[], body).await
    };
    let good = r#"{"position_m":[0,0,0.06]}"#;
    failure(push("none", "box", good).await, 404, "no_such_session");
    let message = failure(push("default", "ball", good).await, 404, "no_such_obstacle");
    assert!(message.contains("ball") && message.contains("there are: box"), "{message}");
    for (body, words) in [
        ("{", ["push", ""]),
        (r#"{"position_m":[0,0]}"#, ["length 2", "length 3"]),
        (r#"{"position_m":[0,0,0],"speed":1}"#, ["speed", "duration_s"]),
        (r#"{"position_m":[0,0,11]}"#, ["position_m is [0.0, 0.0, 11.0]", "-10 to 10"]),
        (
            r#"{"position_m":[0,0,0],"rotation_xyzw":[0,0,0,0]}"#,
            ["rotation_xyzw is [0.0, 0.0, 0.0, 0.0]", "not all zero"],
        ),
        (r#"{"position_m":[0,0,0],"duration_s":-1}"#, ["duration_s is -1", "0 to 3600"]),
        (r#"{"position_m":[0,0,0],"duration_s":3601}"#, ["duration_s is 3601", "0 to 3600"]),
    ] {
        let message = failure(push("default", "box", body).await, 422, "bad_push");
        assert!(words.iter().all(|w| message.contains(w)), "{body}: {message}");
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn schema_metrics_and_page_are_served() {
    let server = Server::start().await;
    let schema = server.json("/v1/schema").await;
    let text = schema.to_string();
    for word in [
        "held_by_another",
        "position_m",
        "nearest_m",
        "particles_active",
        "stale_seq",
        "rate_hz",
        "rotation_xyzw",
    ] {
        assert!(text.contains(word), "{word} is not in the schema");
    }
    server.until("ticks are counted", async || server.metric("kesi_tick_seconds_count").await > 2.0).await;
    let (_, metrics) = server.get("/metrics").await;
    for name in
        ["kesi_steps_total", "kesi_missed_ticks_total", "kesi_solves_total", "kesi_viewers", "kesi_resting"]
    {
        assert!(metrics.contains(&format!("{name}{{session=\"default\"}}")), "{name}: {metrics}");
    }
    assert!(
        metrics.contains("kesi_phase_seconds_total{session=\"default\",phase=\"gradient\"}"),
        "{metrics}"
    );
    let (status, page) = server.get("/").await;
    assert!(status == 200 && page.contains("<html") | page.contains("<!doctype html"), "{page}");
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn fabrics_are_listed_with_their_kind_and_source() {
    let server = Server::start().await;
    let list = server.json("/v1/fabrics").await;
    let fabrics = list["fabrics"].as_array().unwrap();
    let denim = fabrics.iter().find(|f| f["name"] == "denim-a").expect("the default fabric");
    assert!(
        denim["source"].is_string() && denim["quantities"].as_array().is_some_and(|q| q.len() > 10),
        "{denim}"
    );
    for fabric in fabrics {
        assert!(
            ["measured", "digitised", "from_parameters"].map(Value::from).contains(&fabric["kind"]),
            "{fabric}"
        );
    }
    server.shut_down().await;
}

#[cfg(feature = "recording")]
#[tokio::test(flavor = "multi_thread")]
async fn the_recording_so_far_is_served() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().to_str().unwrap().to_string();
    let server = Server::start_with(8, |config| config.record = folder).await;
    server
        .until("something is recorded", async || {
            let (status, body) = server.get("/v1/sessions/default/recording").await;
            status == 200 && body.contains("RRF")
        })
        .await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_other_sites_are_kept_out() {
    let allowed = "https://cloth.example";
    let server = Server::start_with(8, |config| config.allow_origin.push(allowed.into())).await;
    let own = format!("http://{}", server.address);
    let get = async |headers: &[(&str, &str)]| server.request("GET", "/v1/sessions", headers, "").await;
    assert_eq!(get(&[("Origin", &own)]).await.0, 200);
    assert_eq!(get(&[("Origin", allowed)]).await.0, 200);
    failure(get(&[("Origin", "http://evil.example")]).await, 403, "origin_refused");
    failure(get(&[("Origin", "null")]).await, 403, "origin_refused");
    failure(get(&[("Host", "evil.example")]).await, 403, "host_refused");
    assert_eq!(get(&[("Host", "localhost:1")]).await.0, 200);

    let socket = async |origin: &str| {
        server.try_socket("default", "haptic", Some("kesi.haptic.v1"), &[("Origin", origin)]).await
    };
    assert!(socket(&own).await.is_ok());
    assert!(socket(allowed).await.is_ok());
    let Err(Error::Http(refused)) = socket("http://evil.example").await else { panic!("expected a refusal") };
    assert_eq!(refused.status().as_u16(), 403);
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_takes_so_many_clients_and_room_is_given_back() {
    let server = Server::start_with(8, |config| config.limits.clients_per_session = 2).await;
    let first = server.viewer("default").await;
    let _second = server.hand("default").await;
    let third = async || server.try_socket("default", "view", Some("kesi.view.v1"), &[]).await;
    let Err(Error::Http(refused)) = third().await else { panic!("expected a refusal") };
    assert_eq!(refused.status().as_u16(), 503);
    drop(first);
    server.until("the place is free", async || third().await.is_ok()).await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_say_who_solves_them() {
    let asked = Server::start_with(8, |config| config.session.solver = kesi::config::Solver::Multigrid).await;
    let state = asked.json("/v1/sessions/default/state").await;
    assert_eq!(state["solver"], "multigrid");
    asked.shut_down().await;
    let measured = Server::start().await;
    let state = measured.json("/v1/sessions/default/state").await;
    assert!(["fronts", "multigrid"].contains(&state["solver"].as_str().unwrap()), "{state}");
    measured.shut_down().await;
}
