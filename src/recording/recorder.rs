//! One session's recording as the tick thread sees it: copies into a bounded channel, never waits.

use super::{Options, RecordingError, Status};
use crate::world::World;
use std::path::Path;

/// The recordings folder of this process: makes recorders, keeps the disk cap, owns the live server.
#[derive(Debug)]
pub struct Recordings {
    options: Options,
}

impl Recordings {
    /// Opens the folder (making it when missing), prunes it to its cap, and listens for live viewers if asked to.
    ///
    /// Errors: an option out of range, a folder that cannot be written to, an address that is taken.
    pub fn open(options: Options) -> Result<Recordings, RecordingError> {
        Ok(Recordings { options })
    }

    /// Starts the recording of a session: the file `{session}-{UTC time}.rrd`, the fabric, obstacles and mesh, the layout.
    ///
    /// Call it on any thread before the first step; it may take some milliseconds.
    pub fn start(&self, session: &str, world: &World) -> Result<Recorder, RecordingError> {
        let _ = (session, world);
        Ok(Recorder { status: Status::default() })
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.options.dir
    }
}

/// One session's recording. Belongs to the tick thread; dropping it ends the recording as [`Recorder::finish`] does.
#[derive(Debug)]
pub struct Recorder {
    status: Status,
}

impl Recorder {
    /// Records the world as it is after a step that took `tick_ms` of wall time [ms].
    ///
    /// Takes microseconds and never blocks: scalars at every call, the mesh when a frame is due.
    pub fn record(&mut self, world: &World, tick_ms: f64) {
        let _ = (world, tick_ms);
    }

    /// Records a line of text (a grab, a lease lost, a refused command) at the time of the last recorded step.
    pub fn event(&mut self, text: &str) {
        let _ = text;
    }

    /// How the recording is doing; the handle stays valid after the end.
    pub fn status(&self) -> Status {
        self.status.clone()
    }

    /// Ends the recording: what waits is written, then the file's footer, within [`Options::finish_within`].
    pub fn finish(self) {}
}
