//! What the server says, and what the document tells clients to say, against the schema that the server itself serves.

use super::*;

/// What is wrong with a value by a schema, as far as the keywords go that schemas of Rust types are made of; any other keyword
/// is a fault of the check itself. `root` holds the definitions.
fn faults(root: &Value, schema: &Value, value: &Value) -> Result<(), String> {
    let wrong = |why: &str| Err(format!("{value} is not {why}"));
    let list = |v: &Value| v.as_array().cloned().unwrap_or_else(|| vec![v.clone()]);
    let rules = match schema {
        Value::Bool(true) => return Ok(()),
        Value::Object(rules) => rules,
        other => return Err(format!("the schema is {other}")),
    };
    for (keyword, rule) in rules {
        match keyword.as_str() {
            "$schema" | "$defs" | "title" | "description" | "default" | "format" => {}
            "$ref" => {
                let name = rule.as_str().unwrap().strip_prefix("#/$defs/").expect("a definition");
                faults(root, &root["$defs"][name], value)?;
            }
            "type" => {
                let is = |name: &Value| match name.as_str().unwrap() {
                    "null" => value.is_null(),
                    "boolean" => value.is_boolean(),
                    "object" => value.is_object(),
                    "array" => value.is_array(),
                    "string" => value.is_string(),
                    "number" => value.is_number(),
                    "integer" => value.is_i64() || value.is_u64(),
                    other => panic!("type {other}"),
                };
                if !list(rule).iter().any(is) {
                    return wrong(&format!("of type {rule}"));
                }
            }
            "const" if value != rule => return wrong(&rule.to_string()),
            "enum" if !list(rule).contains(value) => return wrong(&format!("one of {rule}")),
            "const" | "enum" => {}
            "oneOf" | "anyOf" => {
                let tried: Vec<_> = list(rule).iter().map(|s| faults(root, s, value)).collect();
                let fitting = tried.iter().filter(|t| t.is_ok()).count();
                if fitting == 0 || keyword == "oneOf" && fitting > 1 {
                    return wrong(&format!("of one kind among {tried:?}"));
                }
            }
            "allOf" => list(rule).iter().try_for_each(|s| faults(root, s, value))?,
            "required" => {
                if let Some(key) = list(rule).iter().find(|k| value.get(k.as_str().unwrap()).is_none()) {
                    return wrong(&format!("complete without {key}"));
                }
            }
            "properties" => {
                for (key, schema) in rule.as_object().unwrap() {
                    value
                        .get(key)
                        .map_or(Ok(()), |v| faults(root, schema, v))
                        .map_err(|e| format!("{key}: {e}"))?;
                }
            }
            "additionalProperties" => {
                assert_eq!(*rule, json!(false));
                let known = &schema["properties"];
                if let Some(key) = value.as_object().and_then(|v| v.keys().find(|k| known.get(k).is_none())) {
                    return wrong(&format!("allowed the field {key}"));
                }
            }
            "items" | "prefixItems" => {
                for (k, item) in value.as_array().into_iter().flatten().enumerate() {
                    let schema = if keyword == "items" { Some(rule) } else { rule.get(k) };
                    schema.map_or(Ok(()), |s| faults(root, s, item)).map_err(|e| format!("[{k}]: {e}"))?;
                }
            }
            "minItems" | "maxItems" => {
                let (got, bound) = (value.as_array().map(|v| v.len() as u64), rule.as_u64().unwrap());
                let fits = got.is_none_or(|n| if keyword == "minItems" { n >= bound } else { n <= bound });
                if !fits {
                    return wrong(&format!("of {keyword} {bound}"));
                }
            }
            "minimum" if value.as_f64().is_some_and(|v| v < rule.as_f64().unwrap()) => {
                return wrong(&format!("at least {rule}"));
            }
            "maximum" if value.as_f64().is_some_and(|v| v > rule.as_f64().unwrap()) => {
                return wrong(&format!("at most {rule}"));
            }
            "minimum" | "maximum" => {}
            other => panic!("the check does not know the keyword {other}: {rule}"),
        }
    }
    Ok(())
}

/// The served schema.
struct Schema(Value);

impl Schema {
    async fn of(server: &Server) -> Schema {
        Schema(server.json("/v1/schema").await)
    }

    fn says(&self, part: &str, name: &str, value: &Value) -> Result<(), String> {
        let schema = &self.0[part][name];
        assert!(schema.is_object(), "no schema of {part}.{name}");
        faults(schema, schema, value)
    }

    #[track_caller]
    fn fits(&self, part: &str, name: &str, value: &Value) {
        self.says(part, name, value).unwrap_or_else(|e| panic!("{part}.{name}: {e}"));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_http_body_fits_the_schema() {
    let server = Server::start().await;
    let schema = Schema::of(&server).await;
    for (path, name) in [
        ("/v1/fabrics", "fabrics"),
        ("/v1/sessions", "sessions"),
        ("/v1/sessions/default", "session"),
        ("/v1/sessions/default/state", "state"),
    ] {
        let body = server.json(path).await;
        schema.fits("http", name, &body);
        // The check can fail: without any one of its fields the body is another.
        for key in body.as_object().unwrap().keys().filter(|key| *key != "hand") {
            let mut less = body.clone();
            less.as_object_mut().unwrap().remove(key);
            assert!(schema.says("http", name, &less).is_err(), "{path} without {key}");
        }
    }
    let (_, body) = server.get("/v1/sessions/none").await;
    schema.fits("http", "error", &serde_json::from_str(&body).unwrap());

    // Every built-in scene as JSON is what the schema calls a scene, and makes a session.
    for name in Scene::names() {
        let scene = serde_json::to_value(Scene::built_in(name).unwrap()).unwrap();
        schema.fits("http", "scene", &scene);
        schema.fits("http", "create", &scene);
    }
    let scene = json!({"name":"small","particles":[8,8],"hand":{"corner":"00"}});
    for request in [json!("hang"), scene] {
        schema.fits("http", "create", &request);
        let (status, body) = server.request("POST", "/v1/sessions", &[], &request.to_string()).await;
        assert_eq!(status, 201, "{body}");
        schema.fits("http", "session", &serde_json::from_str(&body).unwrap());
    }
    for wrong in [json!(3), json!({"particles":[8]}), json!({"no_such_field":1})] {
        assert!(schema.says("http", "create", &wrong).is_err(), "{wrong}");
        assert_eq!(server.request("POST", "/v1/sessions", &[], &wrong.to_string()).await.0, 422, "{wrong}");
    }
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_message_of_the_haptic_socket_fits_the_schema() {
    // A thousand ticks a second of a large sheet, none longer than a millisecond: it runs slow, and says so.
    let slow = Plan { tick_hz: Some(1000.0), ..small_plan(60) };
    let server = Server::serve(slow, |config| config.session.longest_step_s = 0.001).await;
    let schema = Schema::of(&server).await;
    let mut hand = server.socket("default", "haptic", Some("kesi.haptic.v1")).await;
    let hear = async |hand: &mut Socket, op: &str| {
        let hearing = async {
            loop {
                let message = hand.json().await;
                schema.fits("haptic", "server", &message);
                if message["op"] == op {
                    break;
                }
            }
        };
        timeout(PATIENCE, hearing).await.unwrap_or_else(|_| panic!("waited in vain for {op}"));
    };
    hear(&mut hand, "hello").await;
    let mut other = server.hand("default").await;
    for (message, answer) in [
        (
            json!({"op":"hello","client":"c","device":{"max_force_n":3.3,"max_stiffness_n_per_m":400,"rate_hz":1000}}),
            None,
        ),
        (json!({"op":"grab","at":{"nearest_m":[0,1,2]}}), Some("granted")),
        (json!({"op":"grab","at":{"particle":[1,0]}}), Some("granted")),
        (json!({"op":"ping","t_us":7}), Some("pong")),
        (json!({"op":"move","seq":1,"t_us":1,"position_m":[99,0,0]}), Some("error")),
        (json!({"op":"release","let_go":true}), Some("released")),
        (json!({"op":"grab","at":{"corner":"00"}}), Some("granted")),
    ] {
        schema.fits("haptic", "client", &message);
        hand.say(message).await;
        if let Some(op) = answer {
            hear(&mut hand, op).await;
        }
    }
    for wrong in
        [json!({"op":"grab"}), json!({"op":"grab","at":{"corner":"22"}}), json!({"op":"fly"}), json!([])]
    {
        assert!(schema.says("haptic", "client", &wrong).is_err(), "{wrong}");
    }
    // Again if the first hand was silent for too long meanwhile, as on a machine under load.
    let asks = async |hand: &mut Socket| {
        hand.say(json!({"op":"grab","at":{"corner":"00"}})).await;
        loop {
            let answer = hand.json().await;
            schema.fits("haptic", "server", &answer);
            if answer["op"] == "granted" || answer["op"] == "denied" {
                return answer;
            }
        }
    };
    let denied = async { while asks(&mut hand).await["op"] == asks(&mut other).await["op"] {} };
    timeout(PATIENCE, denied).await.expect("one hand at a time");
    hear(&mut other, "status").await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_message_of_the_view_socket_fits_the_schema() {
    let server = Server::start().await;
    let schema = Schema::of(&server).await;
    let (status, body) = server.request("POST", "/v1/sessions", &[], "\"drape\"").await;
    assert_eq!(status, 201, "{body}");
    let drape = serde_json::from_str::<Value>(&body).unwrap()["id"].as_str().unwrap().to_string();
    for session in ["default", &drape] {
        let mut viewer = server.socket(session, "view", Some("kesi.view.v1")).await;
        schema.fits("view", "server", &viewer.json().await);
        for message in [json!({"op":"hello","rate_hz":30}), json!({"op":"ack","frame":1})] {
            schema.fits("view", "client", &message);
            viewer.say(message).await;
        }
        viewer.say(json!({"op":"hello","rate_hz":0})).await;
        schema.fits("view", "server", &viewer.expect("error").await);
    }
    server.shut_down().await;
}
