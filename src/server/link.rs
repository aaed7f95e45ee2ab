//! One WebSocket, with the rules both kinds share: bounded messages, bounded requests, bounded writes, pings, and closing with a
//! sentence.

use super::{
    App,
    http::{Fail, find_alive},
};
use crate::{
    protocol::{
        MESSAGE_LIMIT, REQUEST_LIMIT, close,
        haptic::{ErrorCode, ServerMessage},
    },
    session::{Kind, Seat},
};
use axum::{
    body::Bytes,
    extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade},
    http::{HeaderValue, StatusCode},
    response::Response,
};
use serde::Serialize;
use std::time::Duration;
use tokio::time::{Instant, sleep_until, timeout, timeout_at};
use tokio_tungstenite::tungstenite::{Error, error::ProtocolError};

/// How long a closing handshake may take.
const FAREWELL: Duration = Duration::from_secs(1);
/// Time over which requests are counted.
const WINDOW: Duration = Duration::from_secs(1);
/// Longest reason a close frame holds [bytes].
const REASON: usize = 123;

/// What came in.
#[derive(Debug)]
pub(super) enum Heard {
    /// A text message.
    Text(String),
    /// A binary message.
    Binary(Bytes),
}

/// Why a socket ends. A reason with a code is still to be told to the peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Parting {
    /// The peer closed, or the connection broke: nothing can be said.
    Gone,
    /// A write took too long, or pings were not answered.
    Stalled,
    /// To be closed with a code and a sentence.
    Close(u16, String),
}

/// One WebSocket.
pub(super) struct Link {
    socket: WebSocket,
    write_within: Duration,
    idle: Duration,
    heard: Instant,
    ping_at: Instant,
    /// Requests heard in the present window, and when it began.
    requests: u32,
    since: Instant,
    /// The stream from the peer makes no sense any more, and cannot be read on.
    broken: bool,
}

/// Opens a socket of a session: limits, the subprotocol of its `kind`, a place among the clients, then its `life` on both.
pub(super) fn open<L: Future<Output = ()> + Send + 'static>(
    app: &App,
    id: &str,
    upgrade: WebSocketUpgrade,
    (kind, ours): (Kind, &'static str),
    write_within: Duration,
    life: impl FnOnce(Link, Seat) -> L + Send + 'static,
) -> Result<Response, Fail> {
    let session = find_alive(app, id)?;
    let (upgrade, wrong) = prepare(upgrade, ours);
    if let Some(words) = wrong {
        return Ok(refuse(upgrade, words));
    }
    let limits = &app.settings.config.limits;
    let seat = Seat::take(&session, kind, limits.clients_per_session).ok_or_else(|| {
        let message = format!(
            "session {id} has as many clients as it takes; allowed: limits.clients_per_session = {}",
            limits.clients_per_session
        );
        Fail(StatusCode::SERVICE_UNAVAILABLE, "too_many_clients", message)
    })?;
    let idle = Duration::from_secs_f64(limits.idle_timeout_s);
    let open = app.sockets.token();
    Ok(upgrade.on_upgrade(async move |socket| {
        life(Link::new(socket, write_within, idle), seat).await;
        drop(open);
    }))
}

/// The upgrade, with this protocol's limits, to a subprotocol. A client that asks for another one is accepted with its own
/// word, because browsers drop the reason for closing otherwise; returns whether it is ours.
fn prepare(upgrade: WebSocketUpgrade, ours: &'static str) -> (WebSocketUpgrade, Option<String>) {
    let mut upgrade = upgrade
        .max_message_size(MESSAGE_LIMIT)
        .max_frame_size(MESSAGE_LIMIT)
        .read_buffer_size(2 * MESSAGE_LIMIT)
        .write_buffer_size(0);
    let asked: Vec<HeaderValue> = upgrade.requested_protocols().cloned().collect();
    if asked.iter().any(|p| p.as_bytes() == ours.as_bytes()) {
        upgrade.set_selected_protocol(HeaderValue::from_static(ours));
        return (upgrade, None);
    }
    let words = match asked.first() {
        Some(first) => {
            upgrade.set_selected_protocol(first.clone());
            format!(
                "this socket speaks {ours}, the client asked for {}",
                String::from_utf8_lossy(first.as_bytes())
            )
        }
        None => format!("this socket speaks {ours}, the client asked for no subprotocol"),
    };
    (upgrade, Some(words))
}

/// Accepts, says why not, and closes.
fn refuse(upgrade: WebSocketUpgrade, words: String) -> Response {
    upgrade.on_upgrade(async move |socket| {
        let link = Link::new(socket, FAREWELL, FAREWELL);
        link.part(Parting::Close(close::PROTOCOL, words)).await;
    })
}

impl Link {
    /// Wraps a socket that was accepted.
    fn new(socket: WebSocket, write_within: Duration, idle: Duration) -> Link {
        let now = Instant::now();
        Link {
            socket,
            write_within,
            idle,
            heard: now,
            ping_at: now + idle / 3,
            requests: 0,
            since: now,
            broken: false,
        }
    }

    /// The next message. Safe to cancel. Sends pings while it waits.
    pub(super) async fn hear(&mut self) -> Result<Heard, Parting> {
        loop {
            let message = tokio::select! {
                message = self.socket.recv() => message,
                () = sleep_until(self.ping_at) => {
                    if self.heard.elapsed() >= self.idle {
                        return Err(Parting::Stalled);
                    }
                    self.ping_at = Instant::now() + self.idle / 3;
                    self.write(Message::Ping(Bytes::new())).await?;
                    continue;
                }
            };
            self.heard = Instant::now();
            if matches!(message, Some(Ok(_))) {
                self.count()?;
            }
            match message {
                None | Some(Ok(Message::Close(_))) => return Err(Parting::Gone),
                Some(Ok(Message::Text(text))) => return Ok(Heard::Text(text.to_string())),
                Some(Ok(Message::Binary(bytes))) => return Ok(Heard::Binary(bytes)),
                Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                Some(Err(e)) => {
                    self.broken = true;
                    return Err(fault(e));
                }
            }
        }
    }

    /// Counts a message as a request; too many end the socket, because each costs an answer that nobody waits for.
    fn count(&mut self) -> Result<(), Parting> {
        if self.heard - self.since >= WINDOW {
            (self.since, self.requests) = (self.heard, 0);
        }
        self.requests += 1;
        if self.requests <= REQUEST_LIMIT {
            return Ok(());
        }
        let words =
            format!("more than {REQUEST_LIMIT} messages in a second besides moves and acknowledgements");
        Err(Parting::Close(close::POLICY, words))
    }

    /// The newest message was data, of which only the newest counts: it is no request.
    pub(super) fn was_data(&mut self) {
        self.requests = self.requests.saturating_sub(1);
    }

    async fn write(&mut self, message: Message) -> Result<(), Parting> {
        match timeout(self.write_within, self.socket.send(message)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(Parting::Gone),
            Err(_) => Err(Parting::Stalled),
        }
    }

    /// Sends a JSON message.
    pub(super) async fn say(&mut self, message: &impl Serialize) -> Result<(), Parting> {
        let text = serde_json::to_string(message).expect("messages are plain data");
        self.write(Message::Text(text.into())).await
    }

    /// Sends a binary message.
    pub(super) async fn give(&mut self, bytes: Bytes) -> Result<(), Parting> {
        self.write(Message::Binary(bytes)).await
    }

    /// Ends the socket; tells the peer why, where it can be told.
    pub(super) async fn part(mut self, parting: Parting) {
        let Parting::Close(code, mut words) = parting else { return };
        let mistake = match code {
            close::TOO_LARGE => Some(ErrorCode::TooLarge),
            close::POLICY => Some(ErrorCode::Overflow),
            _ => None,
        };
        if let Some(code) = mistake
            // Spelled alike on both kinds of socket.
            && self.say(&ServerMessage::Error { code, message: words.clone() }).await.is_err()
        {
            return;
        }
        words.truncate(words.floor_char_boundary(REASON));
        let deadline = Instant::now() + FAREWELL;
        let frame = Message::Close(Some(CloseFrame { code, reason: words.into() }));
        if !matches!(timeout_at(deadline, self.socket.send(frame)).await, Ok(Ok(()))) {
            return;
        }
        // Closing a TCP connection with unread input resets it, and the peer may lose the reason: read on, or where that is
        // impossible give the peer time to hear it.
        while let Ok(Some(Ok(_))) = timeout_at(deadline, self.socket.recv()).await {}
        if self.broken {
            sleep_until(deadline).await;
        }
    }
}

/// What a failed read means.
fn fault(error: axum::Error) -> Parting {
    let words = error.to_string();
    match error.into_inner().downcast_ref::<Error>() {
        Some(Error::Capacity(_)) => {
            Parting::Close(close::TOO_LARGE, format!("a message is larger than {MESSAGE_LIMIT} bytes"))
        }
        Some(Error::Utf8(_)) => Parting::Close(close::NOT_UTF8, words),
        // A connection that ends in the middle of a message, or of a closing handshake, is no fault of framing.
        Some(Error::Protocol(
            ProtocolError::ResetWithoutClosingHandshake | ProtocolError::ReceivedAfterClosing,
        )) => Parting::Gone,
        Some(Error::Protocol(_)) => Parting::Close(close::PROTOCOL, words),
        _ => Parting::Gone,
    }
}
