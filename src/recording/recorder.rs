//! One session's recording as the tick thread sees it: copies into a bounded queue, never waits.

use super::{
    Options, RecordingError, Status,
    folder::Folder,
    frames::{Event, Frame, Moment, Remeshed, Row, single},
    layout,
    live::Live,
    writer::{Item, Recording, Target},
};
use crate::world::World;
use rerun::log::LogMsg;
use std::{
    io::Write,
    net::SocketAddr,
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{self, Receiver, RecvTimeoutError, Sender},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

/// The recordings folder of this process: makes recorders, keeps the disk cap, owns the live server.
#[derive(Debug)]
pub struct Recordings {
    options: Options,
    folder: Arc<Folder>,
    live: Option<Live>,
}

impl Recordings {
    /// Opens the folder (making it when missing), prunes it to its cap, and listens for live viewers if asked to.
    ///
    /// Errors: an option out of range, a folder that cannot be written to, an address that is taken.
    pub fn open(options: Options) -> Result<Recordings, RecordingError> {
        let refused = |key, got: String, allowed| RecordingError::Option { key, got, allowed };
        if !(options.mesh_hz > 0.0 && options.mesh_hz <= 1000.0) {
            return Err(refused("mesh_hz", options.mesh_hz.to_string(), "above 0 and at most 1000"));
        }
        if options.disk_cap_bytes < 1 << 20 {
            return Err(refused(
                "disk_cap_bytes",
                options.disk_cap_bytes.to_string(),
                "at least 1048576 (1 MiB)",
            ));
        }
        if options.queue_cap_bytes < 1 << 20 {
            return Err(refused(
                "queue_cap_bytes",
                options.queue_cap_bytes.to_string(),
                "at least 1048576 (1 MiB)",
            ));
        }
        let folder = Arc::new(Folder::open(options.dir.clone(), options.disk_cap_bytes)?);
        let live = options.serve.map(|at| Live::serve(at, options.serve_memory_bytes)).transpose()?;
        Ok(Recordings { options, folder, live })
    }

    /// Starts the recording of a session: the file `{session}-{UTC time}.rrd`, what it says once, the cloth as it is now.
    ///
    /// Call it on any thread before the first step; it takes some milliseconds.
    pub fn start(&self, session: &str, world: &World) -> Result<Recorder, RecordingError> {
        let (path, file) = self.folder.create(session)?;
        let status = Status::default();
        status.move_to(path.clone());
        let target = Target::Folder { folder: self.folder.clone(), session: session.to_owned(), path };
        self.spawn(session, world, target, status, Box::new(file))
    }

    /// Starts a recording that goes to a writer instead of a file: a pipe, a socket, memory. It may block as it likes.
    pub fn start_into(
        &self,
        session: &str,
        world: &World,
        output: Box<dyn Write + Send>,
    ) -> Result<Recorder, RecordingError> {
        self.spawn(session, world, Target::Writer, Status::default(), output)
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.folder.dir
    }

    /// Where live viewers connect, when they are served.
    pub fn serving(&self) -> Option<SocketAddr> {
        self.live.as_ref().map(|live| live.address)
    }

    fn spawn(
        &self,
        session: &str,
        world: &World,
        target: Target,
        status: Status,
        output: Box<dyn Write + Send>,
    ) -> Result<Recorder, RecordingError> {
        let failed = |e: &dyn std::fmt::Display| RecordingError::Rerun(e.to_string());
        let preamble = layout::preamble(session, world).map_err(|e| failed(&e))?;
        let store = preamble
            .iter()
            .map(LogMsg::store_id)
            .find(|id| id.is_recording())
            .ok_or_else(|| failed(&"no recording among its first messages"))?
            .clone();
        let (items, received) = mpsc::channel();
        let (spares_out, spares) = mpsc::channel();
        let (ended_out, ended) = mpsc::channel();
        let queued = Arc::new(AtomicU64::new(0));
        let recording = Recording {
            target,
            preamble,
            store,
            triangles: world.grid().triangles(),
            obstacles: layout::obstacle_paths(world),
            live: self.live.clone(),
            status: status.clone(),
            queued: queued.clone(),
            spares: spares_out,
        };
        let thread = thread::Builder::new()
            .name(format!("kesi-rec-{session}"))
            .spawn(move || {
                recording.run(received, output);
                let _nobody_waits = ended_out.send(());
            })
            .map_err(|e| failed(&e))?;
        let mut recorder = Recorder {
            items: Some(items),
            spares,
            queued,
            queue_cap: self.options.queue_cap_bytes,
            mesh_hz: self.options.mesh_hz,
            finish_within: self.options.finish_within,
            status,
            thread,
            ended,
            now: Moment::of(world.report()),
            slot: 0,
            resting: false,
            epoch: world.grid().epoch,
            remeshed: None,
        };
        recorder.slot = recorder.slot_of(recorder.now.time);
        recorder.frame(world);
        Ok(recorder)
    }
}

/// One session's recording. Belongs to the tick thread; dropping it ends the recording as [`Recorder::finish`] does.
#[derive(Debug)]
pub struct Recorder {
    /// `None` once the recording is ended.
    items: Option<Sender<Item>>,
    /// Buffers that come back from the recording thread.
    spares: Receiver<Vec<[f32; 3]>>,
    queued: Arc<AtomicU64>,
    queue_cap: u64,
    mesh_hz: f64,
    finish_within: Duration,
    status: Status,
    thread: JoinHandle<()>,
    ended: Receiver<()>,
    /// The last recorded step.
    now: Moment,
    /// Number of the last mesh frame's slot in simulated time.
    slot: i64,
    resting: bool,
    /// The mesh of the last frame, and its triangles once it is not the one of the start.
    epoch: u32,
    remeshed: Option<Arc<Remeshed>>,
}

impl Recorder {
    /// Records the world as it is after a step that took `tick_ms` of wall time [ms].
    ///
    /// Takes microseconds and never blocks: scalars at every call, the mesh when a frame is due. At rest, one call of every
    /// mesh period is kept and the mesh is not repeated.
    pub fn record(&mut self, world: &World, tick_ms: f64) {
        let report = world.report();
        self.now = Moment::of(report);
        let slot = self.slot_of(report.time);
        let due = slot != std::mem::replace(&mut self.slot, slot);
        let settled = report.resting && self.resting;
        self.resting = report.resting;
        if settled && !due {
            return;
        }
        self.send(Item::Row(Row::of(report, tick_ms)));
        // The pose in which the cloth comes to rest is kept whether due or not.
        if !settled && (due || report.resting) {
            self.frame(world);
        }
    }

    /// Records a line of text (a grab, a lease lost, a refused command) at the time of the last recorded step.
    pub fn event(&mut self, text: &str) {
        self.send(Item::Event(Event { at: self.now, text: text.to_owned() }));
    }

    /// How the recording is doing; the handle stays valid after the end.
    pub fn status(&self) -> Status {
        self.status.clone()
    }

    /// Ends the recording: what waits is written, then the file's footer, within [`Options::finish_within`].
    pub fn finish(self) {}

    /// Copies the mesh, if the queue has room for it.
    fn frame(&mut self, world: &World) {
        let particles = world.positions();
        if !self.room((size_of::<Item>() + size_of::<[f32; 3]>() * particles.len()) as u64) {
            return self.status.drop_one();
        }
        if self.epoch != world.grid().epoch {
            self.epoch = world.grid().epoch;
            self.remeshed = Some(Arc::new(Remeshed::of(world.grid())));
        }
        let mut positions = self.spares.try_recv().unwrap_or_default();
        positions.clear();
        positions.extend(particles.iter().map(single));
        let place = |pose: &nalgebra::Isometry3<f64>| {
            (single(&pose.translation.vector), pose.rotation.coords.cast::<f32>().into())
        };
        let poses = world.state().poses.iter().map(place).collect();
        self.send(Item::Frame(Frame { at: self.now, positions, poses, remeshed: self.remeshed.clone() }));
    }

    fn send(&mut self, item: Item) {
        let bytes = item.bytes();
        if !self.room(bytes) {
            return self.status.drop_one();
        }
        self.queued.fetch_add(bytes, Ordering::Relaxed);
        if self.items.as_ref().is_none_or(|items| items.send(item).is_err()) {
            self.status.drop_one();
            self.status.fail("the recording thread is gone".into());
        }
    }

    fn room(&self, bytes: u64) -> bool {
        self.queued.load(Ordering::Relaxed) + bytes <= self.queue_cap
    }

    /// Number of the mesh period that a simulated time [s] lies in.
    fn slot_of(&self, time: f64) -> i64 {
        (time * self.mesh_hz + 1e-6).floor() as i64
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.items = None;
        self.thread.thread().unpark();
        match self.ended.recv_timeout(self.finish_within) {
            Ok(()) => {}
            Err(RecvTimeoutError::Timeout) => {
                self.status.fail(format!("not written to the end within {:?}", self.finish_within));
            }
            Err(RecvTimeoutError::Disconnected) => self.status.fail("the recording thread panicked".into()),
        }
    }
}
