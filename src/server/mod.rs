//! HTTP and WebSocket endpoints around sessions. The caller owns the port and the signal that ends it.

mod assets;
mod feel;
mod guard;
mod haptic;
mod http;
mod link;
mod view;

use crate::{
    config::Settings,
    metrics::Metrics,
    recording::{Options, Recordings},
    runner::End,
    session::{CreateError, DEFAULT, Plan, Sessions},
};
use axum::serve::ListenerExt;
use std::{sync::Arc, time::Duration};
use tokio::{
    net::{TcpListener, TcpStream},
    time::timeout,
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

/// Bytes that may wait in the kernel before a write waits too: some thirty force models.
#[cfg(any(target_os = "linux", target_os = "android"))]
const UNSENT: u32 = 4096;

/// Why a server did not start, or ended.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The session `default` could not be made.
    #[error("session `default`: {0}")]
    Session(#[from] CreateError),
    /// The port failed.
    #[error("{0}")]
    Io(#[from] std::io::Error),
}

/// What every handler reaches.
#[derive(Debug)]
struct App {
    settings: Settings,
    /// What an empty `POST /v1/sessions` makes.
    plan: Plan,
    sessions: Sessions,
    metrics: Arc<Metrics>,
    guard: guard::Guard,
    /// Cancelled when shutdown begins.
    leaving: CancellationToken,
    /// Sockets still open: graceful shutdown of HTTP does not see upgraded connections.
    sockets: TaskTracker,
}

/// Serves on `listener` until `shutdown` completes, then ends sessions and sockets under a deadline.
pub async fn run(
    listener: TcpListener,
    settings: Settings,
    plan: Plan,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let guard = guard::Guard::new(listener.local_addr()?, &settings.config.allow_origin);
    let metrics = Arc::new(Metrics::default());
    let recordings = recordings(&settings);
    let app = Arc::new(App {
        sessions: Sessions::new(settings.clone(), Arc::clone(&metrics), recordings),
        settings,
        plan,
        metrics,
        guard,
        leaving: CancellationToken::new(),
        sockets: TaskTracker::new(),
    });
    let first = Arc::clone(&app);
    tokio::task::spawn_blocking(move || first.sessions.create_as(DEFAULT, first.plan.clone()))
        .await
        .map_err(std::io::Error::other)??;

    let listener = listener.tap_io(|stream| {
        if let Err(e) = prompt(stream) {
            tracing::debug!("a connection's options: {e}");
        }
    });
    let serving = axum::serve(listener, http::router(Arc::clone(&app)))
        .with_graceful_shutdown(app.leaving.clone().cancelled_owned())
        .into_future();
    let mut serving = std::pin::pin!(serving);
    tokio::select! {
        ended = &mut serving => return Ok(ended?),
        () = shutdown => {}
    }
    let patience = Duration::from_secs_f64(app.settings.config.limits.shutdown_timeout_s);
    let drained = timeout(patience, async {
        drain(&app).await;
        serving.await
    });
    match drained.await {
        Ok(ended) => Ok(ended?),
        Err(_) => {
            tracing::warn!("shutdown: gave up on {} open sockets after {patience:?}", app.sockets.len());
            Ok(())
        }
    }
}

/// Options of a connection whose messages are worth something only while they are new: each leaves at once, and few wait in the
/// kernel. Without the bound it takes megabytes for a client that does not read, and minutes go by before a write stalls.
fn prompt(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    #[cfg(any(target_os = "linux", target_os = "android"))]
    socket2::SockRef::from(stream).set_tcp_notsent_lowat(UNSENT)?;
    Ok(())
}

/// Ends every session, and waits until their sockets are closed and their threads are gone.
async fn drain(app: &App) {
    tracing::info!("shutting down");
    app.leaving.cancel();
    let sessions = app.sessions.all();
    sessions.iter().for_each(|s| s.shared.finish(End::Shutdown));
    app.sockets.close();
    app.sockets.wait().await;
    for session in sessions {
        let _ = session.shared.stopped.subscribe().wait_for(|gone| *gone).await;
    }
}

/// The recordings folder; a server that cannot record says so and serves all the same.
fn recordings(settings: &Settings) -> Option<Recordings> {
    let dir = settings.record.clone()?;
    let options = Options { dir, serve: settings.rerun_serve, ..Options::default() };
    Recordings::open(options).inspect_err(|e| tracing::error!("sessions are not recorded: {e}")).ok()
}
