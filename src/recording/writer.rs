//! The recording thread: gathers what the tick left, encodes it, writes it to the session's files and to live viewers.
//!
//! It may block for as long as a disk does; nobody waits for it but [`super::Recorder::finish`], and that with a bound.

use super::{
    Status,
    folder::Folder,
    frames::{Batch, Event, Frame, Row},
    live::Live,
};
use rerun::{
    EntityPath, SizeBytes as _, StoreId,
    external::re_log_encoding::{Encoder, EncodingOptions},
    log::LogMsg,
};
use std::{
    io::Write,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, Sender},
    },
    thread,
    time::Duration,
};

/// How long the thread gathers before it writes. Bounds what `kill -9` loses; shorter makes more, smaller chunks.
const GATHER: Duration = Duration::from_millis(250);

/// What the tick thread leaves for the recording thread.
#[derive(Debug)]
pub(super) enum Item {
    Row(Row),
    Frame(Frame),
    Event(Event),
}

impl Item {
    /// Memory held while it waits [bytes].
    pub fn bytes(&self) -> u64 {
        let held = match self {
            Item::Row(_) => 0,
            Item::Frame(frame) => size_of_val(&frame.positions[..]) + size_of_val(&frame.poses[..]),
            Item::Event(event) => event.text.len(),
        };
        (size_of::<Item>() + held) as u64
    }
}

/// Where the bytes go.
pub(super) enum Target {
    /// Files of a folder, a new one whenever the last has grown to its share.
    Folder { folder: Arc<Folder>, session: String, path: PathBuf },
    /// One writer of the caller's.
    Writer,
}

/// What the recording thread works with.
pub(super) struct Recording {
    pub target: Target,
    pub preamble: Vec<LogMsg>,
    pub store: StoreId,
    /// The mesh of the start.
    pub triangles: Vec<[u32; 3]>,
    /// Where the obstacles are.
    pub obstacles: Vec<EntityPath>,
    pub live: Option<Live>,
    pub status: Status,
    /// Bytes between the tick thread and the disk.
    pub queued: Arc<AtomicU64>,
    /// Buffers on their way back to the tick thread.
    pub spares: Sender<Vec<[f32; 3]>>,
}

/// The file (or writer) being written.
struct Segment {
    encoder: Encoder<Box<dyn Write + Send>>,
    written: u64,
}

impl Recording {
    /// Records until the sender is gone and ends with the footer. After a failure nothing more is written, all is counted as dropped.
    pub fn run(mut self, items: Receiver<Item>, output: Box<dyn Write + Send>) {
        if let Some(live) = &self.live {
            live.send_preamble(&self.preamble);
        }
        let mut segment = self.begin(output);
        // `recv` blocks without cost while the session rests; afterwards the thread sleeps rather than waits, so that the
        // tick thread never has to wake it.
        while let Ok(first) = items.recv() {
            let mut batch = Batch::default();
            let mut bytes = add(&mut batch, first);
            thread::park_timeout(GATHER);
            while !batch.full() {
                let Ok(item) = items.try_recv() else { break };
                bytes += add(&mut batch, item);
            }
            self.write(&mut segment, &batch);
            self.queued.fetch_sub(bytes, Ordering::Relaxed);
            for frame in batch.frames {
                let _gone = self.spares.send(frame.positions);
            }
        }
        if let Some(Err(e)) = segment.map(|mut s| s.encoder.finish()) {
            self.status.fail(format!("footer: {e}"));
        }
        if let Target::Folder { folder, path, .. } = &self.target {
            folder.release(path);
        }
    }

    /// Begins a file: the header and what every file says first.
    fn begin(&self, output: Box<dyn Write + Send>) -> Option<Segment> {
        let version = rerun::build_info().version;
        let encoder = Encoder::new_eager(version, EncodingOptions::PROTOBUF_COMPRESSED, output);
        let mut segment = encoder.map(|encoder| Some(Segment { encoder, written: 0 })).unwrap_or_else(|e| {
            self.status.fail(format!("header: {e}"));
            None
        });
        for message in &self.preamble {
            self.append(&mut segment, message);
        }
        segment
    }

    /// Writes a batch, to viewers first: they are waiting.
    fn write(&mut self, segment: &mut Option<Segment>, batch: &Batch) {
        let chunks = match batch.chunks(&self.triangles, &self.obstacles) {
            Ok(chunks) => chunks,
            Err(e) => return self.status.fail(format!("encoding: {e}")),
        };
        for chunk in chunks {
            let message = match chunk.to_arrow_msg() {
                Ok(arrow) => LogMsg::ArrowMsg(self.store.clone(), arrow),
                Err(e) => return self.status.fail(format!("encoding: {e}")),
            };
            if let Some(live) = &self.live
                && !live.send(message.clone(), chunk.total_size_bytes())
            {
                self.status.drop_one();
            }
            self.roll(segment, chunk.total_size_bytes());
            self.append(segment, &message);
        }
    }

    /// Appends a message; the first failure closes the file as it is.
    fn append(&self, segment: &mut Option<Segment>, message: &LogMsg) {
        let Some(open) = segment else { return self.status.drop_one() };
        match open.encoder.append(message) {
            Ok(bytes) => {
                open.written += bytes;
                self.status.wrote(bytes);
            }
            Err(e) => {
                self.status.fail(e.to_string());
                self.status.drop_one();
                // A footer after half a message would only make it worse.
                open.encoder.do_not_emit_footer();
                *segment = None;
            }
        }
    }

    /// Goes on in a new file when `coming` bytes would make this one larger than its share of the cap.
    fn roll(&mut self, segment: &mut Option<Segment>, coming: u64) {
        let Target::Folder { folder, session, path } = &mut self.target else { return };
        let Some(full) = segment.take_if(|s| s.written + coming > folder.segment_bytes()) else { return };
        let mut encoder = full.encoder;
        let finished = encoder.finish().map_err(|e| format!("footer: {e}"));
        drop(encoder);
        folder.release(path);
        match finished.and_then(|()| folder.create(session).map_err(|e| e.to_string())) {
            Ok((next, file)) => {
                self.status.move_to(next.clone());
                *path = next;
                *segment = self.begin(Box::new(file));
            }
            Err(e) => self.status.fail(e),
        }
    }
}

/// Puts an item into the batch; returns the bytes it held in the queue.
fn add(batch: &mut Batch, item: Item) -> u64 {
    let bytes = item.bytes();
    match item {
        Item::Row(row) => batch.rows.push(row),
        Item::Frame(frame) => batch.frames.push(frame),
        Item::Event(event) => batch.events.push(event),
    }
    bytes
}
