//! Live viewers: one rerun server for all sessions of the process, behind a queue of its own.
//!
//! The server may stall as a disk may; what does not fit its queue is dropped and counted, the start of a recording never is.

use super::RecordingError;
use rerun::{MemoryLimit, ServerOptions, grpc_server::GrpcServerSink, log::LogMsg, sink::LogSink as _};
use std::{
    io,
    net::{SocketAddr, TcpListener},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

/// Bytes that may wait for the server, over all sessions.
const QUEUE_BYTES: u64 = 32 << 20;

/// A way to the live server; clones lead to the same one, and with the last of them it closes.
#[derive(Clone, Debug)]
pub(super) struct Live {
    sender: mpsc::Sender<(LogMsg, u64)>,
    queued: Arc<AtomicU64>,
    pub address: SocketAddr,
}

impl Live {
    /// Listens at `address`; port 0 takes a free one.
    pub fn serve(address: SocketAddr, memory_bytes: u64) -> Result<Live, RecordingError> {
        let failed = |source| RecordingError::Serve { address, source };
        // rerun's server binds on a thread of its own and says nothing when it cannot: try first, look afterwards.
        let bound = TcpListener::bind(address).and_then(|l| l.local_addr()).map_err(failed)?;
        let options =
            ServerOptions { memory_limit: MemoryLimit::from_bytes(memory_bytes), ..ServerOptions::default() };
        let server = GrpcServerSink::new(&host(bound), bound.port(), options)
            .map_err(|e| failed(io::Error::other(e.to_string())))?;
        server.flush_blocking(Duration::from_secs(2)).map_err(|e| failed(io::Error::other(e.to_string())))?;
        let (sender, receiver) = mpsc::channel::<(LogMsg, u64)>();
        let queued = Arc::new(AtomicU64::new(0));
        let waiting = queued.clone();
        thread::Builder::new()
            .name("kesi-rerun-live".into())
            .spawn(move || {
                for (message, bytes) in receiver {
                    server.send(message);
                    waiting.fetch_sub(bytes, Ordering::Relaxed);
                }
            })
            .map_err(failed)?;
        Ok(Live { sender, queued, address: bound })
    }

    /// Sends the start of a recording, however full the queue is.
    pub fn send_preamble(&self, messages: &[LogMsg]) {
        for message in messages {
            let _closing = self.sender.send((message.clone(), 0));
        }
    }

    /// Sends data of `bytes`; false when it was dropped.
    pub fn send(&self, message: LogMsg, bytes: u64) -> bool {
        if self.queued.load(Ordering::Relaxed) + bytes > QUEUE_BYTES {
            return false;
        }
        self.queued.fetch_add(bytes, Ordering::Relaxed);
        self.sender.send((message, bytes)).is_ok()
    }
}

/// The address without the port, as rerun puts it before one.
fn host(address: SocketAddr) -> String {
    match address {
        SocketAddr::V4(a) => a.ip().to_string(),
        SocketAddr::V6(a) => format!("[{}]", a.ip()),
    }
}
