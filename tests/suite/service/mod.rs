//! A real server on a free port of this machine, and clients written from PROTOCOL.md's words and offsets alone.

mod cli;
mod hand;
mod http;
mod load;
mod rate;
mod rest;
mod schema;
mod view;
mod wire;

use futures_util::{SinkExt, StreamExt};
use kesi::{
    config::Config,
    protocol::haptic::At,
    scene::Scene,
    server::{self, ServeError},
    session::Plan,
};
use serde_json::{Value, json};
use std::{
    io::{Read, Write},
    net::SocketAddr,
    time::Duration,
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::oneshot,
    task::JoinHandle,
    time::timeout,
};
use tokio_tungstenite::{
    WebSocketStream, client_async,
    tungstenite::{Error, Message, client::IntoClientRequest, http::header::SEC_WEBSOCKET_PROTOCOL},
};

/// Longest wait for anything; reached only when something is broken.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server that ends with the test.
struct Server {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    task: JoinHandle<Result<(), ServeError>>,
}

/// A small sheet, so that ticks are short.
fn small_plan(n: usize) -> Plan {
    let scene = Scene { particles: [n, n], ..Scene::built_in("hang").unwrap() };
    Plan::of(&scene).unwrap()
}

impl Server {
    /// Serves a sheet of 12 × 12 particles.
    async fn start() -> Server {
        Server::start_with(12, |_| {}).await
    }

    /// Serves a sheet of n × n particles with a changed configuration.
    async fn start_with(n: usize, change: impl FnOnce(&mut Config)) -> Server {
        Server::serve(small_plan(n), change).await
    }

    /// Serves a plan with a changed configuration.
    async fn serve(plan: Plan, change: impl FnOnce(&mut Config)) -> Server {
        let mut config = Config { record: "off".into(), ..Config::default() };
        change(&mut config);
        let settings = config.check().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let shutdown = async { drop(stopped.await) };
        let task = tokio::spawn(server::run(listener, settings, plan, shutdown));
        let server = Server { address, stop: Some(stop), task };
        server.until("the server is ready", async || server.get("/readyz").await.0 == 200).await;
        server
    }

    /// Shuts down, and waits until the server is gone.
    async fn shut_down(mut self) {
        self.begin_shutdown();
        timeout(PATIENCE, self.task).await.expect("shutdown ends").unwrap().unwrap();
    }

    fn begin_shutdown(&mut self) {
        drop(self.stop.take());
    }

    /// Repeats a question until it is answered with yes.
    async fn until(&self, what: &str, mut question: impl AsyncFnMut() -> bool) {
        let asked = async {
            while !question().await {
                // Not a guess of how long it takes: asking without pause would be the load.
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        timeout(PATIENCE, asked).await.unwrap_or_else(|_| panic!("waited in vain until {what}"));
    }

    async fn get(&self, path: &str) -> (u16, String) {
        self.request("GET", path, &[], "").await
    }

    async fn json(&self, path: &str) -> Value {
        let (status, body) = self.get(path).await;
        assert_eq!(status, 200, "{path}: {body}");
        serde_json::from_str(&body).unwrap()
    }

    /// One HTTP request, spelled out; status and body.
    async fn request(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> (u16, String) {
        let host = self.address.to_string();
        let mut lines = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
        if !headers.iter().any(|(name, _)| *name == "Host") {
            lines += &format!("Host: {host}\r\n");
        }
        headers.iter().for_each(|(name, value)| lines += &format!("{name}: {value}\r\n"));
        lines += &format!("Content-Length: {}\r\n\r\n{body}", body.len());
        let address = self.address;
        tokio::task::spawn_blocking(move || {
            let Ok(mut stream) = std::net::TcpStream::connect(address) else { return (0, String::new()) };
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
            stream.write_all(lines.as_bytes()).unwrap();
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).unwrap();
            let answer = String::from_utf8_lossy(&answer).into_owned();
            let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
            (head.split(' ').nth(1).and_then(|s| s.parse().ok()).unwrap_or(0), body.to_string())
        })
        .await
        .unwrap()
    }

    /// Sum of a counter or gauge over the sessions.
    async fn metric(&self, name: &str) -> f64 {
        let (_, text) = self.get("/metrics").await;
        let values = text.lines().filter(|l| l.starts_with(&format!("{name}{{")));
        values.map(|l| l.rsplit(' ').next().unwrap().parse::<f64>().unwrap()).sum()
    }

    async fn hand(&self, session: &str) -> Socket {
        let mut hand = self.socket(session, "haptic", Some("kesi.haptic.v1")).await;
        let hello = hand.json().await;
        assert_eq!((&hello["op"], &hello["protocol"]), (&json!("hello"), &json!("kesi.haptic.v1")));
        hand
    }

    async fn viewer(&self, session: &str) -> Socket {
        let mut viewer = self.socket(session, "view", Some("kesi.view.v1")).await;
        assert_eq!(viewer.json().await["op"], "hello");
        viewer
    }

    async fn socket(&self, session: &str, kind: &str, subprotocol: Option<&str>) -> Socket {
        self.try_socket(session, kind, subprotocol, &[]).await.unwrap()
    }

    async fn try_socket(
        &self,
        session: &str,
        kind: &str,
        subprotocol: Option<&str>,
        headers: &[(&'static str, &str)],
    ) -> Result<Socket, Error> {
        let stream = TcpStream::connect(self.address).await.unwrap();
        stream.set_nodelay(true).unwrap();
        self.upgrade(stream, session, kind, subprotocol, headers).await
    }

    async fn upgrade(
        &self,
        stream: TcpStream,
        session: &str,
        kind: &str,
        subprotocol: Option<&str>,
        headers: &[(&'static str, &str)],
    ) -> Result<Socket, Error> {
        let url = format!("ws://{}/v1/sessions/{session}/{kind}", self.address);
        let mut request = url.into_client_request().unwrap();
        if let Some(word) = subprotocol {
            request.headers_mut().insert(SEC_WEBSOCKET_PROTOCOL, word.parse().unwrap());
        }
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().unwrap());
        }
        Ok(Socket { ws: client_async(request, stream).await?.0 })
    }
}

/// One WebSocket.
struct Socket {
    ws: WebSocketStream<TcpStream>,
}

impl Socket {
    async fn say(&mut self, message: Value) {
        self.text(&message.to_string()).await;
    }

    async fn text(&mut self, text: &str) {
        self.ws.send(Message::text(text)).await.unwrap();
    }

    async fn bytes(&mut self, bytes: Vec<u8>) {
        self.ws.send(Message::binary(bytes)).await.unwrap();
    }

    async fn next(&mut self) -> Message {
        let next = timeout(PATIENCE, self.ws.next()).await.expect("the server says something");
        next.expect("the socket is open").expect("the connection holds")
    }

    /// The next JSON message, whatever binary comes before it.
    async fn json(&mut self) -> Value {
        loop {
            if let Message::Text(text) = self.next().await {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    /// The next JSON message with this `op`; statuses may come at any time.
    async fn expect(&mut self, op: &str) -> Value {
        loop {
            let message = self.json().await;
            if message["op"] == op {
                return message;
            }
            assert_eq!(message["op"], "status", "expected {op}: {message}");
        }
    }

    /// The next binary message, whatever JSON comes before it.
    async fn binary(&mut self) -> Vec<u8> {
        loop {
            if let Message::Binary(bytes) = self.next().await {
                return bytes.to_vec();
            }
        }
    }

    /// Code and words of the server's close.
    async fn closed(&mut self) -> (u16, String) {
        loop {
            if let Message::Close(frame) = self.next().await {
                let frame = frame.expect("a reason");
                return (frame.code.into(), frame.reason.to_string());
            }
        }
    }

    /// Grabs, until it is granted: another's release may still be on its way.
    async fn grab(&mut self, corner: &str) -> Value {
        let asking = async {
            loop {
                self.say(json!({"op":"grab","at":{"corner":corner}})).await;
                let answer = self.json().await;
                match answer["op"].as_str() {
                    Some("granted") => return answer,
                    Some("denied") => assert_eq!(answer["code"], "held_by_another"),
                    _ => assert_eq!(answer["op"], "status", "{answer}"),
                }
            }
        };
        timeout(PATIENCE, asking).await.expect("the grab is granted")
    }
}

/// The 40 bytes of a move, by the offsets of the document.
fn move_bytes(seq: u32, t_us: u64, position: [f64; 3]) -> Vec<u8> {
    let mut bytes = vec![0; 40];
    bytes[0] = 0x01;
    bytes[4..8].copy_from_slice(&seq.to_le_bytes());
    bytes[8..16].copy_from_slice(&t_us.to_le_bytes());
    for (k, x) in position.iter().enumerate() {
        bytes[16 + 8 * k..24 + 8 * k].copy_from_slice(&x.to_le_bytes());
    }
    bytes
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}
fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())
}
fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}
fn position_of(granted: &Value) -> [f64; 3] {
    std::array::from_fn(|k| granted["position_m"][k].as_f64().unwrap())
}

#[test]
fn corners_are_where_their_names_say() {
    let site = |name: &str| match serde_json::from_value::<At>(json!({"corner": name})).unwrap() {
        At::Corner(corner) => corner.site([5, 9]),
        _ => unreachable!(),
    };
    assert_eq!(["00", "I0", "0J", "IJ"].map(site), [[0, 0], [4, 0], [0, 8], [4, 8]]);
}
