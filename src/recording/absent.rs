//! The recording API of a build without rerun: opening says so, and a recorder cannot exist.

use super::{Options, RecordingError, Status};
use crate::world::World;
use std::{convert::Infallible, io::Write, net::SocketAddr, path::Path};

/// The recordings folder; never opens in this build.
#[derive(Debug)]
pub struct Recordings(Infallible);

impl Recordings {
    /// Says [`RecordingError::NotBuiltIn`].
    pub fn open(_options: Options) -> Result<Recordings, RecordingError> {
        Err(RecordingError::NotBuiltIn)
    }
    /// Starts the recording of a session: the file `{session}-{UTC time}.rrd`.
    pub fn start(&self, _session: &str, _world: &World) -> Result<Recorder, RecordingError> {
        match self.0 {}
    }
    /// Starts a recording that goes to a writer.
    pub fn start_into(
        &self,
        _session: &str,
        _world: &World,
        _output: Box<dyn Write + Send>,
    ) -> Result<Recorder, RecordingError> {
        match self.0 {}
    }
    /// Where live viewers connect.
    pub fn serving(&self) -> Option<SocketAddr> {
        match self.0 {}
    }
    /// The folder.
    pub fn dir(&self) -> &Path {
        match self.0 {}
    }
}

/// One session's recording; does not exist in this build.
#[derive(Debug)]
pub struct Recorder(Infallible);

impl Recorder {
    /// Records a step.
    pub fn record(&mut self, _world: &World, _tick_ms: f64) {
        match self.0 {}
    }
    /// Records an event.
    pub fn event(&mut self, _text: &str) {
        match self.0 {}
    }
    /// How the recording is doing.
    pub fn status(&self) -> Status {
        match self.0 {}
    }
    /// Ends the recording.
    pub fn finish(self) {
        match self.0 {}
    }
}
