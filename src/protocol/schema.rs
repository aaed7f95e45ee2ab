//! JSON Schema of every JSON message, made from the types themselves.

use super::{haptic, http, view};
use schemars::schema_for;
use serde_json::{Value, json};

/// One object: a schema per direction and socket, and per HTTP body, each complete in itself. The schemas of a `scene` and of the
/// list of `fabrics` come from those who own the types.
pub fn document(scene: Value, fabrics: Value) -> Value {
    json!({
        "title": "kesi, wire protocol version 1",
        "haptic": {
            "protocol": super::HAPTIC,
            "client": schema_for!(haptic::ClientMessage),
            "server": schema_for!(haptic::ServerMessage),
        },
        "view": {
            "protocol": super::VIEW,
            "client": schema_for!(view::ViewerMessage),
            "server": schema_for!(view::ServerMessage),
        },
        "http": {
            "create": create(&scene),
            "error": schema_for!(http::Failure),
            "fabrics": fabrics,
            "push": schema_for!(http::Push),
            "scene": scene,
            "session": schema_for!(http::SessionSummary),
            "sessions": schema_for!(http::SessionList),
            "state": schema_for!(http::State),
        },
    })
}

/// The schema of a request for a session: the name of a built-in scene, or a whole scene.
fn create(scene: &Value) -> Value {
    let mut whole = scene.clone();
    let definitions = whole.as_object_mut().and_then(|s| s.remove("$defs"));
    json!({
        "title": "Body of POST /v1/sessions",
        "anyOf": [{ "description": "Name of a built-in scene.", "type": "string" }, whole],
        "$defs": definitions.unwrap_or_else(|| json!({})),
    })
}
