//! Routes and JSON answers. Errors are a status plus a code for programs and a sentence for people.

use super::{App, assets, guard, haptic, view};
use crate::{
    fabric::{FabricFile, Library},
    protocol::{
        http::{Failure, FailureDetail, Push, SessionList},
        schema,
    },
    runner::{End, Request},
    scene::Scene,
    session::{CreateError, Plan, Session},
};
use axum::{
    Json, Router,
    body::{Body, Bytes},
    extract::{DefaultBodyLimit, Path, State, rejection::BytesRejection},
    http::{HeaderMap, StatusCode, Uri, header},
    middleware::from_fn_with_state,
    response::{IntoResponse, Response},
    routing::{get, post},
};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use schemars::{JsonSchema, schema_for};
use serde::Serialize;
use std::sync::Arc;
use tokio_util::io::ReaderStream;

/// Largest body of a request [bytes].
const BODY_LIMIT: usize = 256 * 1024;

/// An answer that is no success: status, code, sentence.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Fail(pub StatusCode, pub &'static str, pub String);

impl IntoResponse for Fail {
    fn into_response(self) -> Response {
        let Fail(status, code, message) = self;
        let body = Failure { error: FailureDetail { code: code.into(), message } };
        (status, Json(body)).into_response()
    }
}

impl From<CreateError> for Fail {
    fn from(e: CreateError) -> Fail {
        let (status, code) = match e {
            CreateError::TooMany(_) => (StatusCode::SERVICE_UNAVAILABLE, "too_many_sessions"),
            CreateError::Refused { .. } => (StatusCode::UNPROCESSABLE_ENTITY, "bad_scene"),
            CreateError::Thread(_) => (StatusCode::INTERNAL_SERVER_ERROR, "no_thread"),
        };
        Fail(status, code, e.to_string())
    }
}

type Shared = State<Arc<App>>;
type Answer<T> = Result<T, Fail>;

/// All routes.
pub(super) fn router(app: Arc<App>) -> Router {
    Router::new()
        .route("/healthz", get(async || "alive\n"))
        .route("/readyz", get(ready))
        .route("/metrics", get(metrics))
        .route("/v1/schema", get(schema_document))
        .route("/v1/fabrics", get(fabrics))
        .route("/v1/sessions", get(list).post(create))
        .route("/v1/sessions/{id}", get(one).delete(end))
        .route("/v1/sessions/{id}/state", get(state))
        .route("/v1/sessions/{id}/obstacles/{name}", post(push))
        .route("/v1/sessions/{id}/recording", get(recording))
        .route("/v1/sessions/{id}/haptic", get(haptic::open))
        .route("/v1/sessions/{id}/view", get(view::open))
        .fallback(other)
        .method_not_allowed_fallback(wrong_method)
        .layer(DefaultBodyLimit::max(BODY_LIMIT))
        .layer(from_fn_with_state(Arc::clone(&app), guard::check))
        .with_state(app)
}

/// The session with this id, alive or ended; 404 says which ids there are.
pub(super) fn find(app: &App, id: &str) -> Answer<Arc<Session>> {
    app.sessions.get(id).ok_or_else(|| {
        let ids: Vec<String> = app.sessions.all().iter().map(|s| s.id.clone()).collect();
        let message = format!("session id is {id:?}, there are: {}", ids.join(", "));
        Fail(StatusCode::NOT_FOUND, "no_such_session", message)
    })
}

/// The session with this id, if it is alive.
pub(super) fn find_alive(app: &App, id: &str) -> Answer<Arc<Session>> {
    let session = find(app, id)?;
    match session.ended() {
        None => Ok(session),
        Some(End::Failed(words)) => {
            Err(Fail(StatusCode::GONE, "session_failed", format!("session {id} failed: {words}")))
        }
        Some(_) => Err(Fail(StatusCode::GONE, "session_ended", format!("session {id} has ended"))),
    }
}

async fn ready(State(app): Shared) -> Answer<&'static str> {
    let serving = app.sessions.all().iter().any(|s| s.ended().is_none());
    if app.leaving.is_cancelled() || !serving {
        return Err(Fail(StatusCode::SERVICE_UNAVAILABLE, "not_ready", "no session is being served".into()));
    }
    Ok("ready\n")
}

async fn metrics(State(app): Shared) -> Response {
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    ([(header::CONTENT_TYPE, kind)], app.metrics.text()).into_response()
}

async fn schema_document() -> Response {
    let (scene, fabrics) = (schema_for!(Scene).to_value(), schema_for!(FabricList).to_value());
    Json(schema::document(scene, fabrics)).into_response()
}

/// Answer of `GET /v1/fabrics`.
#[derive(Serialize, JsonSchema)]
struct FabricList {
    /// Every fabric, by name.
    fabrics: Vec<FabricFile>,
}

async fn fabrics() -> Answer<Json<FabricList>> {
    let library = Library::default();
    let files: Result<_, _> = library.names().iter().map(|name| library.read(name)).collect();
    let fabrics = files.map_err(|e| Fail(StatusCode::INTERNAL_SERVER_ERROR, "bad_fabric", e.to_string()))?;
    Ok(Json(FabricList { fabrics }))
}

async fn list(State(app): Shared) -> Json<SessionList> {
    Json(SessionList { sessions: app.sessions.all().iter().map(|s| s.summary()).collect() })
}

async fn one(State(app): Shared, Path(id): Path<String>) -> Answer<Response> {
    Ok(Json(find(&app, &id)?.summary()).into_response())
}

async fn state(State(app): Shared, Path(id): Path<String>) -> Answer<Response> {
    Ok(Json(find_alive(&app, &id)?.state()).into_response())
}

async fn end(State(app): Shared, Path(id): Path<String>) -> Answer<StatusCode> {
    let session = find(&app, &id)?;
    app.sessions.delete(&id);
    let _ = session.shared.stopped.subscribe().wait_for(|gone| *gone).await;
    Ok(StatusCode::NO_CONTENT)
}

async fn create(
    State(app): Shared,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Answer<Response> {
    let body = body.map_err(|e| Fail(e.status(), "bad_body", format!("{e}; allowed: {BODY_LIMIT} bytes")))?;
    if app.leaving.is_cancelled() {
        return Err(Fail(StatusCode::SERVICE_UNAVAILABLE, "shutdown", "the server is shutting down".into()));
    }
    let toml =
        headers.get(header::CONTENT_TYPE).is_some_and(|t| t.as_bytes().starts_with(b"application/toml"));
    let making = Arc::clone(&app);
    let session = tokio::task::spawn_blocking(move || {
        let plan = plan(&making, &body, toml)?;
        making.sessions.create(plan).map_err(Fail::from)
    })
    .await
    .map_err(|e| Fail(StatusCode::INTERNAL_SERVER_ERROR, "failed", e.to_string()))??;
    let place = format!("/v1/sessions/{}", session.id);
    Ok((StatusCode::CREATED, [(header::LOCATION, place)], Json(session.summary())).into_response())
}

/// What a body asks for: nothing, the name of a built-in scene, or a scene.
fn plan(app: &App, body: &[u8], toml: bool) -> Answer<Plan> {
    let bad = |message: String| Fail(StatusCode::UNPROCESSABLE_ENTITY, "bad_scene", message);
    if body.trim_ascii().is_empty() {
        return Ok(app.plan.clone());
    }
    let scene = if toml {
        let text = std::str::from_utf8(body).map_err(|e| bad(format!("scene: {e}")))?;
        Scene::from_toml("scene", text).map_err(|e| bad(e.to_string()))?
    } else if let Ok(name) = serde_json::from_slice::<String>(body) {
        Scene::named(&name).map_err(|e| bad(format!("{e}, or a whole scene")))?
    } else {
        serde_json::from_slice(body).map_err(|e| bad(format!("scene: {e}")))?
    };
    Plan::of(&scene).map_err(bad)
}

async fn push(
    State(app): Shared,
    Path((id, name)): Path<(String, String)>,
    body: Result<Bytes, BytesRejection>,
) -> Answer<StatusCode> {
    let body = body.map_err(|e| Fail(e.status(), "bad_body", format!("{e}; allowed: {BODY_LIMIT} bytes")))?;
    let bad = |message: String| Fail(StatusCode::UNPROCESSABLE_ENTITY, "bad_push", message);
    let session = find_alive(&app, &id)?;
    let names: Vec<&str> = session.hello.obstacles.iter().map(|o| o.name.as_str()).collect();
    let obstacle = names.iter().position(|n| *n == name).ok_or_else(|| {
        let message = format!("obstacle is {name:?}, there are: {}", names.join(", "));
        Fail(StatusCode::NOT_FOUND, "no_such_obstacle", message)
    })?;
    let Push { position_m, rotation_xyzw, duration_s: duration } =
        serde_json::from_slice(&body).map_err(|e| bad(format!("push: {e}")))?;
    let [x, y, z, w] = rotation_xyzw;
    let turn = Quaternion::new(w, x, y, z);
    if !(turn.norm().is_finite() && turn.norm() > 1e-9) {
        return Err(bad(format!("rotation_xyzw is {rotation_xyzw:?}, allowed: finite, not all zero")));
    }
    if !position_m.iter().all(|v| v.abs() <= 10.0) {
        return Err(bad(format!("position_m is {position_m:?}, allowed: -10 to 10")));
    }
    if !(0.0..=3600.0).contains(&duration) {
        return Err(bad(format!("duration_s is {duration}, allowed: 0 to 3600")));
    }
    let pose = Isometry3::from_parts(Translation3::from(position_m), UnitQuaternion::from_quaternion(turn));
    let (reply, answer) = tokio::sync::oneshot::channel();
    let request = Request::Push { obstacle, pose, duration, reply };
    let busy = |_| Fail(StatusCode::SERVICE_UNAVAILABLE, "busy", format!("session {id} has too much to do"));
    session.shared.mailbox.post(request).map_err(busy)?;
    match answer.await {
        Ok(Ok(())) => Ok(StatusCode::ACCEPTED),
        Ok(Err(refused)) => Err(bad(refused)),
        Err(_) => Err(Fail(StatusCode::GONE, "session_ended", format!("session {id} has ended"))),
    }
}

async fn recording(State(app): Shared, Path(id): Path<String>) -> Answer<Response> {
    let session = find(&app, &id)?;
    let missing = |why: &str| Fail(StatusCode::NOT_FOUND, "no_recording", format!("session {id}: {why}"));
    let status = session.recording.as_ref().ok_or_else(|| missing("is not recorded"))?;
    let path = status.path().ok_or_else(|| missing("its recording does not go to a file"))?;
    let file =
        tokio::fs::File::open(&path).await.map_err(|e| missing(&format!("its file cannot be read: {e}")))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_string()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\"")),
    ];
    Ok((headers, Body::from_stream(ReaderStream::new(file))).into_response())
}

async fn other(uri: Uri) -> Answer<Response> {
    assets::serve(&uri)
        .ok_or_else(|| Fail(StatusCode::NOT_FOUND, "no_such_path", format!("path is {:?}", uri.path())))
}

async fn wrong_method(uri: Uri) -> Fail {
    let message = format!("{:?} does not take this method", uri.path());
    Fail(StatusCode::METHOD_NOT_ALLOWED, "wrong_method", message)
}
