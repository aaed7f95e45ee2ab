//! JSON Schema of every JSON message, made from the types themselves.

use super::{haptic, http, view};
use schemars::schema_for;
use serde_json::{Value, json};

/// One object: a schema per direction and socket, and per HTTP body. `scene` is the schema of a scene.
pub fn document(scene: Value) -> Value {
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
            "error": schema_for!(http::Failure),
            "scene": scene,
            "session": schema_for!(http::SessionSummary),
            "sessions": schema_for!(http::SessionList),
            "state": schema_for!(http::State),
        },
    })
}
