//! Clients that break the rules of the wire, flood it, or stop reading: they are told why, and nobody else notices.

use super::*;
use tokio::{io::AsyncWriteExt, net::TcpSocket};

/// A frame by the bytes of RFC 6455: first byte (final flag, reserved bits, opcode), then the payload, masked with zeros.
fn raw(first: u8, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![first];
    match payload.len() {
        n if n < 126 => bytes.push(0x80 | n as u8),
        n => {
            bytes.push(0x80 | 126);
            bytes.extend((n as u16).to_be_bytes());
        }
    }
    bytes.extend([0; 4]);
    bytes.extend(payload);
    bytes
}

/// The head of a frame that announces `length` bytes.
fn announced(length: u64) -> Vec<u8> {
    [&[0x82, 0xff], length.to_be_bytes().as_slice(), &[0; 4]].concat()
}

/// Broken streams: what is wrong, the bytes, the code the server closes with.
fn broken() -> Vec<(&'static str, Vec<u8>, u16)> {
    vec![
        ("data opcode 3 is reserved", raw(0x83, b"{}"), 1002),
        ("control opcode 11 is reserved", raw(0x8b, b""), 1002),
        ("a reserved bit is set", raw(0xc1, b"{}"), 1002),
        ("the frame is not masked", vec![0x81, 2, b'{', b'}'], 1002),
        ("a ping is fragmented", raw(0x09, b""), 1002),
        ("a ping is longer than 125 bytes", raw(0x89, &[b'x'; 126]), 1002),
        ("a message goes on that never began", raw(0x80, b"{}"), 1002),
        ("a message begins within another", [raw(0x01, b"{"), raw(0x81, b"{}")].concat(), 1002),
        ("the close frame has one byte", raw(0x88, &[3]), 1002),
        ("text is not UTF-8", raw(0x81, &[b'{', 0xc3, 0x28, b'}']), 1007),
        ("4097 bytes are announced", announced(4097), 1009),
        ("more bytes are announced than there are", announced(u64::MAX), 1009),
        (
            "fragments add up to 6000 bytes",
            [raw(0x01, &[b' '; 3000]), raw(0x80, &[b' '; 3000])].concat(),
            1009,
        ),
    ]
}

impl Server {
    /// Waits until so many sockets of each kind are open: haptic, view.
    async fn until_open(&self, haptic: f64, view: f64) {
        self.until("the sockets are given back", async || {
            self.metric("kesi_haptic_clients").await == haptic && self.metric("kesi_viewers").await == view
        })
        .await;
    }

    /// Waits for 50 more steps.
    async fn keeps_ticking(&self) {
        let steps = self.metric("kesi_steps_total").await;
        self.until("50 more ticks", async || self.metric("kesi_steps_total").await > steps + 50.0).await;
    }

    /// A socket whose client takes few bytes before it reads.
    async fn narrow(&self, kind: &str) -> Socket {
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(4096).unwrap();
        let stream = socket.connect(self.address).await.unwrap();
        let subprotocol = format!("kesi.{kind}.v1");
        self.upgrade(stream, "default", kind, Some(&subprotocol), &[]).await.unwrap()
    }
}

impl Socket {
    async fn raw(&mut self, bytes: &[u8]) {
        self.ws.get_mut().write_all(bytes).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn broken_framing_is_closed_with_its_reason_and_lets_go() {
    let server = Server::start().await;
    let bystander = load::watch(server.viewer("default").await);
    for (what, bytes, code) in broken() {
        let mut hand = server.hand("default").await;
        // Granted again and again: the client before, whose framing broke, holds nothing any more.
        hand.grab("00").await;
        hand.raw(&bytes).await;
        if code == 1009 {
            assert_eq!(hand.expect("error").await["code"], "too_large", "{what}");
        }
        let (got, words) = hand.closed().await;
        assert_eq!(got, code, "{what}: {words}");
        assert!(words.len() > 10, "{what}: {words}");

        let mut viewer = server.viewer("default").await;
        viewer.raw(&bytes).await;
        assert_eq!(viewer.closed().await.0, code, "{what}, of a viewer");
    }
    server.keeps_ticking().await;
    server.until_open(0.0, 1.0).await;
    server.shut_down().await;
    assert!(bystander.await.unwrap() > 3, "a viewer beside them saw frames");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_cut_off_within_a_frame_lets_go() {
    let server = Server::start().await;
    let whole = raw(0x82, &move_bytes(1, 1, [0.0; 3]));
    for length in [1, 2, 5, 20, whole.len() - 1] {
        let mut hand = server.hand("default").await;
        hand.grab("00").await;
        hand.raw(&whole[..length]).await;
        hand.ws.get_mut().shutdown().await.unwrap();
        server.until_open(0.0, 0.0).await;
        server
            .until("the hand is free", async || server.json("/v1/sessions/default").await["held"] == false)
            .await;
    }
    server.keeps_ticking().await;
    server.shut_down().await;
}

/// Sends the same message until the server closes the socket: its last words, and the code.
async fn flood(socket: Socket, message: Message) -> (Value, u16) {
    let (mut sink, mut stream) = socket.ws.split();
    let sending = tokio::spawn(async move { while sink.send(message.clone()).await.is_ok() {} });
    let mut said = Value::Null;
    let hearing = async {
        loop {
            match stream.next().await.expect("a reason comes first").expect("a reason comes first") {
                Message::Text(text) => said = serde_json::from_str(&text).unwrap(),
                Message::Close(frame) => break frame.expect("a reason").code.into(),
                _ => {}
            }
        }
    };
    let code = timeout(PATIENCE, hearing).await.expect("a flood ends");
    timeout(PATIENCE, sending).await.expect("the connection ends").unwrap();
    (said, code)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_requests_is_closed_and_disturbs_nobody() {
    let server = Server::start().await;
    let mut bystander = server.hand("default").await;
    for (kind, message) in [
        ("haptic", Message::text(r#"{"op":"ping","t_us":1}"#)),
        ("haptic", Message::text(r#"{"op":"hello"}"#)),
        ("haptic", Message::text("nonsense")),
        ("haptic", Message::binary(move_bytes(1, 1, [0.0; 3]))),
        ("haptic", Message::Ping("of the WebSocket itself".into())),
        ("view", Message::text(r#"{"op":"hello","rate_hz":1}"#)),
        ("view", Message::text(r#"{"op":"ack","frame":4000000000}"#)),
    ] {
        let socket = server.socket("default", kind, Some(&format!("kesi.{kind}.v1"))).await;
        let flooding = tokio::spawn(flood(socket, message.clone()));
        bystander.say(json!({"op":"ping","t_us":9})).await;
        assert_eq!(bystander.expect("pong").await["t_us"], 9, "another client is answered");
        let (said, code) = flooding.await.unwrap();
        assert_eq!((code, &said["code"]), (1008, &json!("overflow")), "{kind}, {message:?}: {said}");
    }
    server.keeps_ticking().await;
    server.until_open(1.0, 0.0).await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_moves_is_followed_by_its_newest() {
    let server = Server::start().await;
    let mut hand = server.hand("default").await;
    let [x, y, z] = position_of(&hand.grab("00").await);
    let last = 20_000;
    for seq in 1..=last {
        hand.ws.feed(Message::binary(move_bytes(seq, u64::from(seq), [x, y, z]))).await.unwrap();
    }
    hand.ws.flush().await.unwrap();
    let mut seq = last;
    loop {
        let model = hand.binary().await;
        if u32_at(&model, 24) >= last {
            break;
        }
        // Keeps the lease, should the machine be slow.
        seq += 1;
        hand.bytes(move_bytes(seq, u64::from(seq), [x, y, z])).await;
    }
    server.keeps_ticking().await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_holder_that_stops_reading_is_dropped_and_lets_go() {
    let server = Server::start().await;
    let mut hand = server.narrow("haptic").await;
    hand.json().await;
    let [x, y, z] = position_of(&hand.grab("00").await);
    let mut seq = 0;
    server
        .until("the client that does not read is dropped", async || {
            seq += 1;
            // Never silent, so that it is not the lease that ends it. Fails once the server is gone.
            let _ = hand.ws.send(Message::binary(move_bytes(seq, 1, [x, y, z]))).await;
            server.metric("kesi_clients_dropped_total").await == 1.0
        })
        .await;
    server.until_open(0.0, 0.0).await;
    server.hand("default").await.grab("00").await;
    server.shut_down().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_that_acknowledges_without_reading_is_dropped() {
    let server = Server::start_with(20, |config| config.limits.write_timeout_s = 0.1).await;
    let mut viewer = server.narrow("view").await;
    viewer.say(json!({"op":"hello","rate_hz":60})).await;
    server
        .until("the viewer that does not read is dropped", async || {
            let newest = server.metric("kesi_view_frames_encoded_total").await;
            let ack = json!({"op":"ack","frame":newest}).to_string();
            let _ = viewer.ws.send(Message::text(ack)).await;
            server.metric("kesi_clients_dropped_total").await == 1.0
        })
        .await;
    server.until_open(0.0, 0.0).await;
    server.keeps_ticking().await;
    server.shut_down().await;
}
