//! The view socket: one eye. Newest frame only, never more than two unacknowledged, never a queue.
//!
//! Viewers of the same rate look at the same moments (multiples of their interval), so that one encoded frame serves all
//! of them. A viewer that is not due, or that owes acknowledgements, asks the session for nothing.

use super::{
    App,
    haptic::{ended, farewell},
    http::Fail,
    link::{self, Heard, Link, Parting},
};
use crate::{
    protocol::{
        self,
        haptic::{ErrorCode, Level, Status},
        view::{ServerMessage, ViewerMessage},
    },
    runner::{End, Picture, Tick},
    session::{Kind, Seat, Session},
};
use axum::{
    extract::{Path, State, ws::WebSocketUpgrade},
    response::Response,
};
use std::{collections::VecDeque, sync::Arc, time::Duration};
use tokio::{
    sync::{broadcast, watch},
    time::{Instant, sleep_until},
};

/// Frames a viewer may leave unacknowledged.
const IN_FLIGHT: usize = 2;
/// Rate of a viewer that asks for none [Hz].
const RATE: f64 = 30.0;
/// Lowest rate a viewer may ask for [Hz].
const SLOWEST: f64 = 0.1;

/// `GET /v1/sessions/{id}/view`.
pub(super) async fn open(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    upgrade: WebSocketUpgrade,
) -> Result<Response, Fail> {
    let limits = &app.settings.config.limits;
    let (kind, within) = ((Kind::View, protocol::VIEW), Duration::from_secs_f64(limits.write_timeout_s));
    let rate_max = limits.view_hz;
    link::open(&app, &id, upgrade, kind, within, move |link, seat| Viewer::new(link, seat, rate_max).live())
}

/// What clients are told of a session that failed.
pub(super) fn failed(words: &str) -> Status {
    Status {
        level: Level::Error,
        code: "session_failed".into(),
        message: format!("the session failed: {words}"),
    }
}

/// Where a viewer is between two frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Until its next moment.
    Waiting(Instant),
    /// Its moment has come, but it owes acknowledgements; since when.
    Owing(Instant),
    /// Its moment has come, but the state is the one it has.
    Idle,
    /// It asked for a frame; the tick that was present then.
    Asked(u64),
}

enum Next {
    Heard(Result<Heard, Parting>),
    End(End),
    Tell(Status),
    Look,
    Nothing,
}

struct Viewer {
    link: Link,
    session: Arc<Session>,
    end: watch::Receiver<Option<End>>,
    ticks: watch::Receiver<Arc<Tick>>,
    pictures: watch::Receiver<Option<Arc<Picture>>>,
    status: broadcast::Receiver<Status>,
    rate_max: f64,
    interval: Duration,
    /// Moments lie at multiples of the interval since then.
    origin: Instant,
    phase: Phase,
    in_flight: VecDeque<u32>,
    sent_tick: Option<u64>,
    sent_epoch: Option<u32>,
    /// Counts this client until it goes.
    _seat: Seat,
}

impl Viewer {
    fn new(link: Link, seat: Seat, rate_max: f64) -> Viewer {
        let session = Arc::clone(&seat.session);
        let now = Instant::now();
        Viewer {
            link,
            end: session.shared.end.subscribe(),
            ticks: session.shared.ticks.subscribe(),
            pictures: session.shared.pictures.subscribe(),
            status: session.shared.status.subscribe(),
            rate_max,
            interval: Duration::from_secs_f64(1.0 / RATE.min(rate_max)),
            origin: session.opened.into(),
            phase: Phase::Waiting(now),
            in_flight: VecDeque::new(),
            sent_tick: None,
            sent_epoch: None,
            session,
            _seat: seat,
        }
    }

    async fn live(mut self) {
        let hello = ServerMessage::Hello(self.session.view_hello());
        let mut parting = self.link.say(&hello).await.err();
        while parting.is_none() {
            let next = self.next().await;
            parting = match next {
                Next::Heard(heard) => self.answer(heard).await.err(),
                Next::Tell(status) => self.link.say(&ServerMessage::Status(status)).await.err(),
                Next::Look => self.look().await.err(),
                Next::End(end) => Some(self.bid_farewell(&end).await),
                Next::Nothing => None,
            };
        }
        let parting = parting.expect("the loop ended by it");
        if parting == Parting::Stalled {
            self.session.shared.metrics.clients_dropped.inc();
        }
        self.link.part(parting).await;
    }

    async fn next(&mut self) -> Next {
        let due = if let Phase::Waiting(due) = self.phase { due } else { self.origin };
        tokio::select! {
            end = ended(&mut self.end) => Next::End(end),
            heard = self.link.hear() => Next::Heard(heard),
            status = self.status.recv() => match status {
                Ok(status) => Next::Tell(status),
                // Statuses that were missed are out of date; the channel lives as long as the session.
                Err(_) => Next::Nothing,
            },
            () = sleep_until(due), if matches!(self.phase, Phase::Waiting(_)) => Next::Look,
            _ = self.ticks.changed(), if self.phase == Phase::Idle => Next::Look,
            _ = self.pictures.changed(), if matches!(self.phase, Phase::Asked(_)) => Next::Look,
        }
    }

    /// The viewer is due: sends the present frame, or finds out why not yet.
    async fn look(&mut self) -> Result<(), Parting> {
        if self.in_flight.len() >= IN_FLIGHT {
            self.session.shared.metrics.frames_skipped.inc();
            self.phase = Phase::Owing(Instant::now());
            return Ok(());
        }
        let present = self.ticks.borrow_and_update().number;
        let picture = self.pictures.borrow_and_update().clone();
        // What was painted since we asked will do; unasked, a frame of the tick before is as good as one of this.
        let oldest = if let Phase::Asked(then) = self.phase { then } else { present.saturating_sub(1) };
        let fresh = picture.filter(|p| self.sent_tick.is_none_or(|sent| p.tick > sent) && p.tick >= oldest);
        if let Some(picture) = fresh {
            return self.send(&picture).await;
        }
        self.phase = if self.sent_tick == Some(present) {
            Phase::Idle
        } else {
            self.session.shared.mailbox.want_frame();
            Phase::Asked(oldest.max(self.sent_tick.map_or(0, |sent| sent + 1)))
        };
        Ok(())
    }

    async fn send(&mut self, picture: &Picture) -> Result<(), Parting> {
        let now = Instant::now();
        let intervals = (now - self.origin).as_nanos() / self.interval.as_nanos() + 1;
        self.phase =
            Phase::Waiting(self.origin + self.interval * u32::try_from(intervals).unwrap_or(u32::MAX));
        if self.sent_epoch != Some(picture.epoch) {
            self.link.give(picture.topology.clone()).await?;
            self.sent_epoch = Some(picture.epoch);
        }
        self.in_flight.push_back(picture.number);
        self.sent_tick = Some(picture.tick);
        self.session.shared.metrics.frames_sent.inc();
        self.link.give(picture.frame.clone()).await
    }

    async fn answer(&mut self, heard: Result<Heard, Parting>) -> Result<(), Parting> {
        let (code, words) = match heard? {
            Heard::Binary(_) => (ErrorCode::BadFrame, "a viewer sends text messages only".into()),
            Heard::Text(text) => match serde_json::from_str(&text) {
                Ok(ViewerMessage::Ack { frame }) => return self.acknowledge(frame).await,
                Ok(ViewerMessage::Hello { rate_hz }) if rate_hz >= SLOWEST => {
                    self.set_rate(rate_hz.min(self.rate_max));
                    return Ok(());
                }
                Ok(ViewerMessage::Hello { rate_hz }) => {
                    (ErrorCode::BadRate, format!("rate_hz is {rate_hz}, allowed: {SLOWEST} or more"))
                }
                Err(e) => (ErrorCode::BadMessage, format!("text message: {e}")),
            },
        };
        self.error(code, words).await
    }

    async fn error(&mut self, code: ErrorCode, message: String) -> Result<(), Parting> {
        self.link.say(&ServerMessage::Error { code, message }).await
    }

    fn set_rate(&mut self, rate: f64) {
        self.interval = Duration::from_secs_f64(1.0 / rate);
        if let Phase::Waiting(due) = &mut self.phase {
            *due = (*due).min(Instant::now() + self.interval);
        }
    }

    /// Frames up to this one were shown.
    async fn acknowledge(&mut self, frame: u32) -> Result<(), Parting> {
        if let Some(k) = self.in_flight.iter().position(|&f| f == frame) {
            self.in_flight.drain(..=k);
            self.link.was_data();
        }
        let Phase::Owing(since) = self.phase else { return Ok(()) };
        if self.in_flight.len() >= IN_FLIGHT {
            return Ok(());
        }
        let skipped = since.elapsed().as_nanos() / self.interval.as_nanos();
        self.session.shared.metrics.frames_skipped.inc_by(u64::try_from(skipped).unwrap_or(u64::MAX));
        self.look().await
    }

    async fn bid_farewell(&mut self, end: &End) -> Parting {
        if let End::Failed(words) = end
            && let Err(parting) = self.link.say(&ServerMessage::Status(failed(words))).await
        {
            return parting;
        }
        farewell(end)
    }
}
