//! The haptic socket: one hand. Takes grabs and moves to the session's thread, brings force models back.
//!
//! The lease is kept here, not in the thread: a session at rest sleeps, and a lost hand must be noticed all the same.

use super::{
    App, feel,
    http::Fail,
    link::{self, Heard, Link, Parting},
};
use crate::{
    protocol::{
        self, FARTHEST, close,
        haptic::{At, ClientMessage, Denied, Device, ErrorCode, Released, ServerMessage, Status},
        pose::{ForceModel, Move},
    },
    runner::{End, Pose, Refusal, Request, Tick},
    session::{Kind, LEASE, Seat, Session},
};
use axum::{
    extract::{Path, State, ws::WebSocketUpgrade},
    response::Response,
};
use std::{sync::Arc, time::Duration};
use tokio::{
    sync::{broadcast, oneshot, watch},
    time::{Instant, sleep_until, timeout},
};

/// A holder hears a model at least this often, also from a cloth at rest: its lease on the force runs as ours on its hand.
const HEARTBEAT: Duration = LEASE.checked_div(5).expect("five is not zero").saturating_mul(2);

/// `GET /v1/sessions/{id}/haptic`.
pub(super) async fn open(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    upgrade: WebSocketUpgrade,
) -> Result<Response, Fail> {
    // A client that takes no bytes for a whole lease has lost its hand: no reason to wait longer for it.
    let kind = (Kind::Haptic, protocol::HAPTIC);
    link::open(&app, &id, upgrade, kind, LEASE, |link, seat| Haptic::new(link, seat).live())
}

/// Waits until a session ends.
pub(super) async fn ended(end: &mut watch::Receiver<Option<End>>) -> End {
    match end.wait_for(Option::is_some).await {
        Ok(end) => end.clone().expect("waited for it"),
        Err(_) => End::Deleted,
    }
}

/// Close code and sentence of a session's end.
pub(super) fn farewell(end: &End) -> Parting {
    match end {
        End::Deleted => Parting::Close(close::NORMAL, "the session was ended".into()),
        End::Shutdown => Parting::Close(close::AWAY, "the server is shutting down".into()),
        End::Failed(_) => Parting::Close(close::FAILED, "the session failed".into()),
    }
}

/// What to do next.
enum Next {
    Heard(Result<Heard, Parting>),
    End(End),
    Tell(Status),
    Model,
    Paced,
    Lease,
    Nothing,
}

struct Haptic {
    link: Link,
    seat: Seat,
    session: Arc<Session>,
    end: watch::Receiver<Option<End>>,
    ticks: watch::Receiver<Arc<Tick>>,
    status: broadcast::Receiver<Status>,
    device: Device,
    /// While holding: when the lease runs out.
    lease: Option<Instant>,
    last_seq: Option<u32>,
    sent: Sent,
    /// While a slow device needs no new model yet: until when.
    paced: Option<Instant>,
}

/// What was said by the last model.
struct Sent {
    seq: u32,
    at: Instant,
    epoch: u32,
    contact_changes: u64,
}

impl Haptic {
    fn new(link: Link, seat: Seat) -> Haptic {
        let session = Arc::clone(&seat.session);
        let tick = session.tick();
        Haptic {
            end: session.shared.end.subscribe(),
            ticks: session.shared.ticks.subscribe(),
            status: session.shared.status.subscribe(),
            link,
            seat,
            device: Device::default(),
            lease: None,
            last_seq: None,
            sent: Sent {
                seq: 0,
                at: Instant::now(),
                epoch: tick.epoch,
                contact_changes: tick.contact_changes,
            },
            paced: None,
            session,
        }
    }

    async fn live(mut self) {
        let hello = ServerMessage::Hello {
            protocol: protocol::HAPTIC.into(),
            server: protocol::SERVER.into(),
            session: self.session.id.clone(),
            tick_hz: self.session.tick().rung.tick_hz,
            lease_ms: LEASE.as_secs_f64() * 1e3,
        };
        let mut parting = self.link.say(&hello).await.err();
        while parting.is_none() {
            let next = self.next().await;
            parting = self.act(next).await.err();
        }
        // Whatever happened, a closed socket holds nothing.
        self.session.release_hand(self.seat.client, false, "closed");
        let parting = parting.expect("the loop ended by it");
        if parting == Parting::Stalled {
            self.session.shared.metrics.clients_dropped.inc();
        }
        self.link.part(parting).await;
    }

    async fn next(&mut self) -> Next {
        let now = Instant::now();
        let holding = self.lease.is_some();
        let lease = self.lease.unwrap_or(now);
        let paced = self.paced.unwrap_or(now);
        tokio::select! {
            end = ended(&mut self.end) => Next::End(end),
            heard = self.link.hear() => Next::Heard(heard),
            status = self.status.recv() => match status {
                Ok(status) => Next::Tell(status),
                // Statuses that were missed are out of date; the channel lives as long as the session.
                Err(_) => Next::Nothing,
            },
            _ = self.ticks.changed(), if holding && self.paced.is_none() => Next::Model,
            () = sleep_until(paced), if holding && self.paced.is_some() => Next::Paced,
            () = sleep_until(self.sent.at + HEARTBEAT), if holding => Next::Model,
            () = sleep_until(lease), if holding => Next::Lease,
        }
    }

    async fn act(&mut self, next: Next) -> Result<(), Parting> {
        match next {
            Next::Heard(heard) => self.answer(heard).await,
            Next::Tell(status) => self.link.say(&ServerMessage::Status(status)).await,
            Next::Model => self.send_model().await,
            Next::Paced => {
                self.paced = None;
                Ok(())
            }
            Next::Lease => self.expire().await,
            Next::End(end) => {
                let parting = self.bid_farewell(&end).await;
                Err(parting)
            }
            Next::Nothing => Ok(()),
        }
    }

    async fn answer(&mut self, heard: Result<Heard, Parting>) -> Result<(), Parting> {
        let message = match heard? {
            Heard::Binary(bytes) => match Move::decode(&bytes) {
                Ok(pose) => return self.follow(pose).await,
                Err(e) => return self.error(ErrorCode::BadFrame, format!("binary message: {e}")).await,
            },
            Heard::Text(text) => match serde_json::from_str::<ClientMessage>(&text) {
                Ok(message) => message,
                Err(e) => return self.error(ErrorCode::BadMessage, format!("text message: {e}")).await,
            },
        };
        match message {
            ClientMessage::Hello { client, device } => self.greet(&client, device).await,
            ClientMessage::Grab { at } => self.grab(at).await,
            ClientMessage::Move { seq, t_us, position_m } => {
                self.follow(Move { seq, t_us, position: position_m }).await
            }
            ClientMessage::Release { let_go } => self.release(let_go).await,
            ClientMessage::Ping { t_us } => {
                self.renew();
                self.link.say(&ServerMessage::Pong { t_us }).await
            }
        }
    }

    async fn error(&mut self, code: ErrorCode, message: String) -> Result<(), Parting> {
        self.link.say(&ServerMessage::Error { code, message }).await
    }

    fn renew(&mut self) {
        if self.lease.is_some() {
            self.lease = Some(Instant::now() + LEASE);
        }
    }

    async fn greet(&mut self, client: &str, device: Device) -> Result<(), Parting> {
        if let Err(words) = device.check() {
            return self.error(ErrorCode::BadDevice, words).await;
        }
        tracing::debug!("session {}: client {:?} says hello", self.session.id, client);
        self.device = device;
        Ok(())
    }

    async fn grab(&mut self, at: At) -> Result<(), Parting> {
        match self.ask_for(at).await {
            Ok(Ok(granted)) => {
                self.lease = Some(Instant::now() + LEASE);
                self.sent.at = Instant::now();
                let lease_ms = LEASE.as_secs_f64() * 1e3;
                let (particle, position_m) = (granted.particle, granted.position);
                self.link.say(&ServerMessage::Granted { particle, position_m, lease_ms }).await
            }
            Ok(Err(Refusal { code, message })) => {
                self.link.say(&ServerMessage::Denied { code, message }).await
            }
            Err(parting) => Err(parting),
        }
    }

    /// Reserves the hand, then asks the cloth.
    async fn ask_for(&mut self, at: At) -> Result<Result<crate::runner::Granted, Refusal>, Parting> {
        let client = self.seat.client;
        if let Err(refusal) = self.session.reserve_hand(client) {
            return Ok(Err(refusal));
        }
        let (reply, answer) = oneshot::channel();
        if self.session.shared.mailbox.post(Request::Grab { client, at, reply }).is_err() {
            let words = "the session has more requests than it takes";
            return Err(Parting::Close(close::POLICY, words.into()));
        }
        let refused = tokio::select! {
            answer = answer => match answer {
                Ok(Ok(granted)) => return Ok(Ok(granted)),
                Ok(Err(refusal)) => Some(refusal),
                Err(_) => None,
            },
            _ = ended(&mut self.end) => None,
        };
        // A refused second grab leaves the first as it was.
        if self.lease.is_none() {
            self.session.cancel_hand(client);
        }
        let ended = || Refusal { code: Denied::Refused, message: "the session is ending".into() };
        Ok(Err(refused.unwrap_or_else(ended)))
    }

    async fn follow(&mut self, pose: Move) -> Result<(), Parting> {
        if let Err((code, words)) = self.judge(&pose) {
            return self.error(code, words).await;
        }
        self.link.was_data();
        self.last_seq = Some(pose.seq);
        self.renew();
        let Move { seq, t_us, position } = pose;
        let received = std::time::Instant::now();
        let (client, interval) = (self.seat.client, self.device.interval());
        let pose = Pose { client, seq, t_us, position, received, interval };
        let _ = self.session.shared.mailbox.post(Request::Move(pose));
        Ok(())
    }

    fn judge(&self, pose: &Move) -> Result<(), (ErrorCode, String)> {
        let p = pose.position;
        if self.lease.is_none() {
            return Err((ErrorCode::NotHolding, format!("move {}: grab a particle first", pose.seq)));
        }
        if p.iter().any(|x| !x.is_finite()) {
            return Err((ErrorCode::NotFinite, format!("position_m is {p:?}, allowed: finite numbers")));
        }
        let distance = p.iter().map(|x| x * x).sum::<f64>().sqrt();
        if distance > FARTHEST {
            let words = format!("position_m is {distance:.3e} m from the origin, allowed: {FARTHEST} m");
            return Err((ErrorCode::TooFar, words));
        }
        match self.last_seq {
            Some(last) if pose.seq <= last => {
                Err((ErrorCode::StaleSeq, format!("seq is {}, allowed: above {last}", pose.seq)))
            }
            _ => Ok(()),
        }
    }

    async fn release(&mut self, let_go: bool) -> Result<(), Parting> {
        if self.lease.take().is_none() {
            return self.error(ErrorCode::NotHolding, "release: nothing is held".into()).await;
        }
        self.session.release_hand(self.seat.client, let_go, "client");
        let words = if let_go { "the particle is free" } else { "the particle stays pinned where it is" };
        self.released(Released::Client, words).await
    }

    async fn released(&mut self, code: Released, words: &str) -> Result<(), Parting> {
        self.link.say(&ServerMessage::Released { code, message: words.into() }).await
    }

    /// The lease ran out, unless a message that renews it lies waiting because this task was late itself.
    async fn expire(&mut self) -> Result<(), Parting> {
        if let Ok(heard) = timeout(Duration::ZERO, self.link.hear()).await {
            return self.answer(heard).await;
        }
        self.lease = None;
        self.session.release_hand(self.seat.client, false, "silent");
        let words =
            format!("no move or ping for {} ms; the particle stays pinned where it is", LEASE.as_millis());
        self.released(Released::Silent, &words).await
    }

    async fn bid_farewell(&mut self, end: &End) -> Parting {
        if let End::Failed(words) = end {
            let status = super::view::failed(words);
            if let Err(parting) = self.link.say(&ServerMessage::Status(status)).await {
                return parting;
            }
        }
        if self.lease.take().is_some() {
            let (code, words) = match end {
                End::Shutdown => (Released::Shutdown, "the server is shutting down"),
                _ => (Released::SessionEnded, "the session has ended"),
            };
            if let Err(parting) = self.released(code, words).await {
                return parting;
            }
        }
        farewell(end)
    }

    /// Sends the newest state as a model, once the cloth knows that this client holds it.
    async fn send_model(&mut self) -> Result<(), Parting> {
        let now = Instant::now();
        let tick = Arc::clone(&self.ticks.borrow_and_update());
        self.sent.at = now;
        if tick.holder != Some(self.seat.client) {
            return Ok(());
        }
        let Some(mut model) = feel::model(&tick, &self.device) else { return Ok(()) };
        if !feel::tells(&model, &self.device) {
            self.session.shared.metrics.models_withheld.inc();
            return Ok(());
        }
        let sent = &mut self.sent;
        if tick.epoch != sent.epoch {
            model.flags |= ForceModel::REMESHED;
        }
        if tick.contact_changes != sent.contact_changes {
            model.flags |= ForceModel::CONTACT;
        }
        sent.seq = sent.seq.wrapping_add(1);
        (sent.epoch, sent.contact_changes) = (tick.epoch, tick.contact_changes);
        model.seq = sent.seq;
        let slow = self.device.rate_hz < tick.rung.tick_hz;
        self.paced = slow.then(|| now + self.device.interval());
        self.session.shared.metrics.models_sent.inc();
        self.link.give(model.encode().into()).await
    }
}
