//! The viewer page, embedded in the binary from `web/dist`.

use axum::{
    body::Body,
    http::{StatusCode, Uri, header},
    response::{IntoResponse, Response},
};
use rust_embed::Embed;

#[derive(Embed)]
#[folder = "$CARGO_MANIFEST_DIR/web/dist"]
struct Dist;

/// What `GET /` answers when the viewer was not built.
const MISSING: &str = "<!doctype html><meta charset=utf-8><title>kesi</title>\
<body style='font:16px system-ui;max-width:40em;margin:4em auto'><h1>kesi</h1>\
<p>The server runs, but the viewer is not built into it. Run <code>make web</code>, then build again.</p>\
<p>Without it: <a href='/v1/sessions/default/state'>state</a> &middot; <a href='/v1/schema'>schema</a> &middot; \
<a href='/metrics'>metrics</a></p></body>";

/// Answers a path of the viewer; `None` when there is no such file.
pub(super) fn serve(uri: &Uri) -> Option<Response> {
    let path = uri.path().trim_start_matches('/');
    let path = if path.is_empty() { "index.html" } else { path };
    match Dist::get(path) {
        Some(file) => {
            // Vite puts a hash of the content into the names below assets/.
            let keep =
                if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" };
            let headers = [
                (header::CONTENT_TYPE, content_type(path)),
                (header::CACHE_CONTROL, keep),
                (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            ];
            Some((headers, Body::from(file.data.into_owned())).into_response())
        }
        None if path == "index.html" => {
            let html = [(header::CONTENT_TYPE, content_type(path)), (header::CACHE_CONTROL, "no-cache")];
            Some((StatusCode::OK, html, MISSING).into_response())
        }
        None => None,
    }
}

fn content_type(path: &str) -> &'static str {
    match path.rsplit('.').next().unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" | "map" | "webmanifest" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        "ico" => "image/x-icon",
        "woff2" => "font/woff2",
        "wasm" => "application/wasm",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}
