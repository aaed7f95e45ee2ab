//! A native haptic client: one socket, poses out, force models in. Holds no policy on what to do with them.

use crate::protocol::{
    self,
    haptic::{At, ClientMessage, Device, ServerMessage},
    pose::{ForceModel, Move},
};
use futures_util::{SinkExt, StreamExt};
use std::time::Duration;
use tokio::{net::TcpStream, time::timeout};
use tokio_tungstenite::{
    WebSocketStream, client_async,
    tungstenite::{
        self, Message,
        client::IntoClientRequest,
        http::{HeaderValue, header},
    },
};

/// How long connecting, and an answer to a grab, may take.
const PATIENCE: Duration = Duration::from_secs(10);

/// Why a client cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// A URL that names no haptic socket.
    #[error(
        "url is {0:?}, allowed: ws://HOST:PORT or http://HOST:PORT, with or without /v1/sessions/ID/haptic"
    )]
    Url(String),
    /// Nobody listens there.
    #[error("{address}: {source}")]
    Connect {
        /// Where.
        address: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The server refused the socket, with these words.
    #[error("{url}: {words}")]
    Refused {
        /// The socket.
        url: String,
        /// Status and message.
        words: String,
    },
    /// The server closed the socket.
    #[error("the server closed the socket: {0}")]
    Closed(String),
    /// The server does not answer.
    #[error("no answer to {0} within {PATIENCE:?}")]
    Silent(&'static str),
    /// A message that is not of this protocol.
    #[error("the server sent what is not of kesi.haptic.v1: {0}")]
    Protocol(String),
    /// The grab was refused.
    #[error("the grab was denied: {0}")]
    Denied(String),
}

/// What the server sent.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A JSON message.
    Message(ServerMessage),
    /// A force model.
    Model(ForceModel),
}

/// Where a haptic socket is.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    address: String,
    url: String,
}

/// Host, port and path of a URL; a URL without a path means the haptic socket of `session`.
fn place(url: &str, session: &str) -> Result<Place, ClientError> {
    let bad = || ClientError::Url(url.into());
    let rest = ["ws://", "http://"].iter().find_map(|s| url.strip_prefix(s)).ok_or_else(bad)?;
    let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
    if host.is_empty() || host.contains('@') {
        return Err(bad());
    }
    let port = host.rsplit_once(':').is_some_and(|(_, p)| p.parse::<u16>().is_ok());
    let address = if port { host.to_string() } else { format!("{host}:80") };
    let path = if path.is_empty() { format!("v1/sessions/{session}/haptic") } else { path.to_string() };
    Ok(Place { address, url: format!("ws://{host}/{path}") })
}

/// A haptic socket.
#[derive(Debug)]
pub struct Haptic {
    socket: WebSocketStream<TcpStream>,
}

impl Haptic {
    /// Connects to a server's `url`, and to its `session` if the URL has no path.
    pub async fn connect(url: &str, session: &str) -> Result<Haptic, ClientError> {
        let Place { address, url } = place(url, session)?;
        let open = async {
            let connect = |source| ClientError::Connect { address: address.clone(), source };
            let stream = TcpStream::connect(&address).await.map_err(connect)?;
            stream.set_nodelay(true).map_err(connect)?;
            let mut request =
                url.as_str().into_client_request().map_err(|_| ClientError::Url(url.clone()))?;
            let ours = HeaderValue::from_static(protocol::HAPTIC);
            request.headers_mut().insert(header::SEC_WEBSOCKET_PROTOCOL, ours);
            match client_async(request, stream).await {
                Ok((socket, _)) => Ok(Haptic { socket }),
                Err(e) => Err(ClientError::Refused { url: url.clone(), words: words(e) }),
            }
        };
        timeout(PATIENCE, open).await.unwrap_or(Err(ClientError::Silent("the connection")))
    }

    async fn write(&mut self, message: Message) -> Result<(), ClientError> {
        self.socket.send(message).await.map_err(|e| ClientError::Closed(e.to_string()))
    }

    /// Sends a JSON message.
    pub async fn say(&mut self, message: &ClientMessage) -> Result<(), ClientError> {
        let text = serde_json::to_string(message).expect("messages are plain data");
        self.write(Message::text(text)).await
    }

    /// Sends a pose.
    pub async fn follow(&mut self, pose: &Move) -> Result<(), ClientError> {
        self.write(Message::binary(pose.encode())).await
    }

    /// The next message. Safe to cancel.
    pub async fn hear(&mut self) -> Result<Event, ClientError> {
        loop {
            match self.socket.next().await {
                None => return Err(ClientError::Closed("without a word".into())),
                Some(Err(e)) => return Err(ClientError::Closed(e.to_string())),
                Some(Ok(Message::Close(frame))) => {
                    let words =
                        frame.map_or("without a word".into(), |f| format!("{} ({})", f.reason, f.code));
                    return Err(ClientError::Closed(words));
                }
                Some(Ok(Message::Text(text))) => {
                    return serde_json::from_str(&text)
                        .map(Event::Message)
                        .map_err(|e| ClientError::Protocol(e.to_string()));
                }
                Some(Ok(Message::Binary(bytes))) => {
                    return ForceModel::decode(&bytes)
                        .map(Event::Model)
                        .map_err(|e| ClientError::Protocol(e.to_string()));
                }
                Some(Ok(_)) => {}
            }
        }
    }

    /// Says hello, grabs, and waits for the answer: the particle and its position [m].
    pub async fn grab(
        &mut self,
        name: &str,
        device: Device,
        at: At,
    ) -> Result<([usize; 2], [f64; 3]), ClientError> {
        self.say(&ClientMessage::Hello { client: name.into(), device }).await?;
        self.say(&ClientMessage::Grab { at }).await?;
        let answer = async {
            loop {
                match self.hear().await? {
                    Event::Message(ServerMessage::Granted { particle, position_m, .. }) => {
                        return Ok((particle, position_m));
                    }
                    Event::Message(ServerMessage::Denied { message, .. }) => {
                        return Err(ClientError::Denied(message));
                    }
                    Event::Message(ServerMessage::Error { message, .. }) => {
                        return Err(ClientError::Protocol(message));
                    }
                    _ => {}
                }
            }
        };
        timeout(PATIENCE, answer).await.unwrap_or(Err(ClientError::Silent("the grab")))
    }

    /// Opens the hand, and closes the socket in order; waits a little for the server's last word.
    pub async fn leave(mut self, let_go: bool) -> Result<(), ClientError> {
        self.say(&ClientMessage::Release { let_go }).await?;
        let _ = self.socket.close(None).await;
        let rest = async { while let Some(Ok(_)) = self.socket.next().await {} };
        let _ = timeout(Duration::from_secs(1), rest).await;
        Ok(())
    }
}

/// What a failed handshake means, with the server's own words where it gave some.
fn words(error: tungstenite::Error) -> String {
    let tungstenite::Error::Http(response) = error else { return error.to_string() };
    let body = response.body().as_deref().unwrap_or_default();
    match serde_json::from_slice::<protocol::http::Failure>(body) {
        Ok(failure) => format!("{} ({})", failure.error.message, response.status()),
        Err(_) => response.status().to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_name_a_server_or_a_socket() {
        let server = place("http://127.0.0.1:8080", "s1").unwrap();
        assert_eq!(server.address, "127.0.0.1:8080");
        assert_eq!(server.url, "ws://127.0.0.1:8080/v1/sessions/s1/haptic");
        let socket = place("ws://host/v1/sessions/a/haptic", "ignored").unwrap();
        assert_eq!(
            (socket.address.as_str(), socket.url.as_str()),
            ("host:80", "ws://host/v1/sessions/a/haptic")
        );
        for bad in ["127.0.0.1:8080", "wss://host", "ws://", "ftp://host"] {
            assert!(place(bad, "default").is_err(), "{bad}");
        }
    }
}
