//! Recordings: every session writes what it does to a `.rrd` file that the rerun viewer opens.
//!
//! ```text
//! tick thread ──record()──▶ queue (bytes bounded) ──▶ recording thread: encodes, writes ──▶ .rrd
//!               copies, µs                                   └──▶ queue (bytes bounded) ──▶ live viewers, if served
//! ```
//!
//! The tick never waits for a disk: what does not fit is dropped and counted ([`Status::dropped`]), and the first failure is
//! kept as a sentence ([`Status::error`]). [`Recordings`] is the folder, one per process; [`Recorder`] is one session's
//! recording. Without the feature `recording` the same names exist and [`Recordings::open`] says that it is not built in.

#[cfg(not(feature = "recording"))]
mod absent;
#[cfg(feature = "recording")]
mod folder;
#[cfg(feature = "recording")]
mod frames;
#[cfg(feature = "recording")]
mod layout;
#[cfg(feature = "recording")]
mod live;
#[cfg(feature = "recording")]
mod writer;
#[cfg(feature = "recording")]
mod recorder;

#[cfg(not(feature = "recording"))]
pub use absent::{Recorder, Recordings};
#[cfg(feature = "recording")]
pub use recorder::{Recorder, Recordings};

use std::{
    net::SocketAddr,
    path::PathBuf,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// Where recordings go and what they may cost.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Folder of the `.rrd` files; made when missing.
    pub dir: PathBuf,
    /// Bytes that all recordings of the folder may take together. The oldest files go first, at the start and while running;
    /// a session whose own recording grows past an eighth of this goes on in a new file, so that the cap holds for it too.
    pub disk_cap_bytes: u64,
    /// Bytes of one session that may wait for the disk; beyond it data is dropped and counted.
    pub queue_cap_bytes: u64,
    /// Mesh frames per simulated second at the most [Hz]. Scalars are recorded at every tick.
    pub mesh_hz: f64,
    /// Address where live rerun viewers may connect (`rerun rerun+http://ADDR/proxy`): one server for all sessions of the
    /// process, each of them a recording of its own in the viewer.
    pub serve: Option<SocketAddr>,
    /// Memory that the live server keeps for viewers that connect late [bytes].
    pub serve_memory_bytes: u64,
    /// How long the end of a session may wait for its recording to reach the disk.
    pub finish_within: Duration,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            dir: PathBuf::from("recordings"),
            disk_cap_bytes: 2 << 30,
            queue_cap_bytes: 64 << 20,
            mesh_hz: 10.0,
            serve: None,
            serve_memory_bytes: 256 << 20,
            finish_within: Duration::from_secs(2),
        }
    }
}

/// Why recordings cannot be made. Sessions go on without them.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The binary was built without rerun.
    #[error(
        "recording is not built in: build with the feature `recording`, or switch it off with `--record off`"
    )]
    NotBuiltIn,
    /// The folder cannot be made, listed or written to.
    #[error("recordings folder {}: {source}", .path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A recording's file cannot be made.
    #[error("recording {}: {source}", .path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The address for live viewers cannot be listened on.
    #[error("live rerun viewers at {address}: {source}")]
    Serve {
        /// The address asked for.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// An option is out of its range.
    #[error("{key} = {got}: must be {allowed}")]
    Option {
        /// Field of [`Options`].
        key: &'static str,
        /// The value given.
        got: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// rerun refused to set the recording up.
    #[error("rerun: {0}")]
    Rerun(String),
}

/// How a recording is doing; cheap to clone, readable from every thread, valid after the session's end.
#[derive(Clone, Debug, Default)]
pub struct Status(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    path: Mutex<Option<PathBuf>>,
    written: AtomicU64,
    dropped: AtomicU64,
    error: Mutex<Option<String>>,
}

impl Status {
    /// The file being written now; `None` when the recording does not go to a file.
    pub fn path(&self) -> Option<PathBuf> {
        self.0.path.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
    /// Bytes written so far, over all files of the session.
    pub fn written_bytes(&self) -> u64 {
        self.0.written.load(Ordering::Relaxed)
    }
    /// Pieces (a tick's scalars, a mesh frame, an event, or an encoded batch of them) that were dropped because a queue was full
    /// or the file had failed.
    pub fn dropped(&self) -> u64 {
        self.0.dropped.load(Ordering::Relaxed)
    }
    /// The first failure, as a sentence; `None` while all is well. After it nothing more is written.
    pub fn error(&self) -> Option<String> {
        self.0.error.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[cfg(feature = "recording")]
impl Status {
    fn move_to(&self, path: PathBuf) {
        *self.0.path.lock().unwrap_or_else(PoisonError::into_inner) = Some(path);
    }
    fn wrote(&self, bytes: u64) {
        self.0.written.fetch_add(bytes, Ordering::Relaxed);
    }
    fn drop_one(&self) {
        self.0.dropped.fetch_add(1, Ordering::Relaxed);
    }
    fn fail(&self, what: String) {
        self.0.error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(what);
    }
}
