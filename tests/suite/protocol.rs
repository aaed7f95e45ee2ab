//! The wire, to the byte: golden files that the viewer's tests decode too, and layouts against hand-counted offsets.

use kesi::protocol::{
    Malformed,
    haptic::{At, ClientMessage, Corner, Denied, Device, ErrorCode, Released, ServerMessage},
    pose::{ForceModel, Move},
    view::{Frame, Topology, ViewerMessage},
};
use serde_json::{Value, json};
use std::path::PathBuf;

fn a_move() -> Move {
    Move { seq: 17, t_us: 1_234_567, position: [0.1, -0.25, 0.3] }
}

fn a_model() -> ForceModel {
    ForceModel {
        flags: ForceModel::CONVERGED | ForceModel::CLAMPED | ForceModel::CONTACT,
        seq: 41,
        server_us: 5_000_000_123,
        move_us: 1_234_567,
        move_seq: 17,
        lease_ms: 125.0,
        position: [0.125, -0.25, 0.5],
        velocity: [0.0625, 0.0, -0.125],
        force: [0.5, -0.75, -1.5],
        rate: [2.0, -4.0, 8.0],
        stiffness: [16.0, 0.5, 0.25, 32.0, -0.5, 64.0],
        radius: 0.015625,
        horizon_ms: 4.0,
        force_error: 0.001953125,
        active: 5929,
        solve_ms: 2.75,
    }
}

/// A sheet of 3 × 2 particles whose particle (1, 1) is no vertex.
fn a_topology() -> Topology {
    Topology {
        epoch: 3,
        counts: [3, 2],
        vertices: vec![0, 1, 2, 4, 5],
        triangles: vec![[0, 2, 1], [2, 3, 4], [1, 2, 4]],
        levels: vec![0, 0, 1, 2, 1],
    }
}

fn a_frame() -> Frame {
    Frame {
        flags: Frame::CONVERGED | Frame::HAND | Frame::HELD,
        number: 99,
        server_us: 5_000_000_456,
        epoch: 3,
        active: 5,
        hand_particle: 0,
        hand_position: [0.125, -0.25, 0.5],
        force: [0.5, -0.75, -1.5],
        cost: [0.5, 0.25, 0.125, 0.0625],
        residual: 0.03125,
        solve_ms: 2.75,
        max_penetration: 0.0078125,
        force_error: 0.001953125,
        tick_hz: 249.5,
        positions: vec![
            [0.0, 0.5, 1.0],
            [0.25, 0.5, 0.75],
            [-1.0, 2.0, -4.0],
            [0.125, 0.0, 0.0],
            [8.0, 16.0, 32.0],
        ],
        poses: vec![[0.25, -0.5, 2.0, 0.5, -0.5, 0.5, 0.5]],
    }
}

/// Compares bytes with a golden file; with KESI_WRITE_GOLDEN set, writes it.
fn golden(name: &str, bytes: &[u8]) {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    if std::env::var_os("KESI_WRITE_GOLDEN").is_some() {
        std::fs::write(&path, bytes).unwrap();
    }
    let kept = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    assert_eq!(kept, bytes, "{name}: the layout changed, which is a new version of the protocol");
}

#[test]
fn golden_bytes_of_every_binary_message_are_kept() {
    golden("move.bin", &a_move().encode());
    golden("force_model.bin", &a_model().encode());
    golden("topology.bin", &a_topology().encode());
    golden("frame.bin", &a_frame().encode());
    let text = serde_json::to_string_pretty(&fields()).unwrap() + "\n";
    golden("fields.json", text.as_bytes());
}

/// What the golden files say, for tests in other languages.
fn fields() -> Value {
    let (m, f, t, v) = (a_move(), a_model(), a_topology(), a_frame());
    json!({
        "move.bin": { "seq": m.seq, "t_us": m.t_us, "position_m": m.position },
        "force_model.bin": {
            "flags": f.flags, "seq": f.seq, "server_us": f.server_us, "move_us": f.move_us, "move_seq": f.move_seq,
            "lease_ms": f.lease_ms, "p0_m": f.position, "v0_m_per_s": f.velocity, "f0_n": f.force,
            "g_n_per_s": f.rate, "k_n_per_m": f.stiffness, "radius_m": f.radius, "horizon_ms": f.horizon_ms,
            "force_error_n": f.force_error, "particles_active": f.active, "solve_ms": f.solve_ms,
        },
        "topology.bin": {
            "epoch": t.epoch, "particles": t.counts, "vertices": t.vertices, "triangles": t.triangles,
            "levels": t.levels,
        },
        "frame.bin": {
            "flags": v.flags, "frame": v.number, "server_us": v.server_us, "epoch": v.epoch,
            "particles_active": v.active, "hand_particle": v.hand_particle, "hand_position_m": v.hand_position,
            "force_n": v.force, "cost": v.cost, "residual_n": v.residual, "solve_ms": v.solve_ms,
            "max_penetration_m": v.max_penetration, "force_error_n": v.force_error, "tick_hz": v.tick_hz,
            "positions_m": v.positions, "poses": v.poses,
        },
    })
}

#[test]
fn every_binary_message_is_read_back_as_it_was_written() {
    assert_eq!(Move::decode(&a_move().encode()), Ok(a_move()));
    assert_eq!(ForceModel::decode(&a_model().encode()), Ok(a_model()));
    assert_eq!(Topology::decode(&a_topology().encode()), Ok(a_topology()));
    assert_eq!(Frame::decode(&a_frame().encode()), Ok(a_frame()));
}

fn u32_at(b: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(b[at..at + 4].try_into().unwrap())
}
fn u64_at(b: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(b[at..at + 8].try_into().unwrap())
}
fn f32_at(b: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(b[at..at + 4].try_into().unwrap())
}

#[test]
fn fields_lie_where_the_document_says() {
    let b = a_move().encode();
    assert_eq!((b.len(), b[0], u32_at(&b, 4), u64_at(&b, 8)), (40, 0x01, 17, 1_234_567));
    assert_eq!(f64::from_le_bytes(b[32..40].try_into().unwrap()), 0.3);

    let b = a_model().encode();
    assert_eq!((b.len(), b[0], b[1], u32_at(&b, 4)), (128, 0x81, 1 | 4 | 16, 41));
    assert_eq!((u64_at(&b, 8), u64_at(&b, 16), u32_at(&b, 24)), (5_000_000_123, 1_234_567, 17));
    let floats =
        [(28, 125.0), (32, 0.125), (52, -0.125), (64, -1.5), (76, 8.0), (80, 16.0), (92, 32.0), (100, 64.0)];
    floats.iter().for_each(|&(at, x)| assert_eq!(f32_at(&b, at), x, "offset {at}"));
    assert_eq!((f32_at(&b, 104), f32_at(&b, 108), f32_at(&b, 112)), (0.015625, 4.0, 0.001953125));
    assert_eq!((u32_at(&b, 116), f32_at(&b, 120), u32_at(&b, 124)), (5929, 2.75, 0));

    let b = a_topology().encode();
    assert_eq!((b.len(), b[0]), (24 + 20 + 36 + 8, 0x82));
    assert_eq!((u32_at(&b, 4), u32_at(&b, 8), u32_at(&b, 12), b[16], b[18]), (3, 5, 3, 3, 2));
    assert_eq!((u32_at(&b, 24 + 12), u32_at(&b, 44 + 12), b[80 + 3], b[80 + 5]), (4, 2, 2, 0));

    let b = a_frame().encode();
    assert_eq!((b.len(), b[0], b[1], u32_at(&b, 4)), (96 + 60 + 28, 0x83, 1 | 4 | 8, 99));
    assert_eq!((u64_at(&b, 8), u32_at(&b, 16), u32_at(&b, 20), u32_at(&b, 24)), (5_000_000_456, 3, 5, 5));
    let floats =
        [(32, 0.125), (44, 0.5), (56, 0.5), (68, 0.0625), (72, 0.03125), (76, 2.75), (80, 0.0078125)];
    floats.iter().for_each(|&(at, x)| assert_eq!(f32_at(&b, at), x, "offset {at}"));
    assert_eq!((u32_at(&b, 28), f32_at(&b, 88), u32_at(&b, 92), f32_at(&b, 96 + 4)), (0, 249.5, 1, 0.5));
    assert_eq!((f32_at(&b, 96 + 60), f32_at(&b, 96 + 60 + 8)), (0.25, 2.0));
}

#[test]
fn bytes_of_another_length_or_opcode_are_refused_at_every_cut() {
    fn cuts<T: std::fmt::Debug>(whole: &[u8], decode: impl Fn(&[u8]) -> Result<T, Malformed>) {
        (0..whole.len()).for_each(|n| assert!(decode(&whole[..n]).is_err(), "{n} bytes"));
        assert!(decode(&[whole, &[0]].concat()).is_err());
        let other = [&[0x7f], &whole[1..]].concat();
        assert!(matches!(decode(&other), Err(Malformed::Opcode { got: 0x7f, .. })));
    }
    cuts(&a_move().encode(), Move::decode);
    cuts(&a_model().encode(), ForceModel::decode);
    cuts(&a_topology().encode(), Topology::decode);
    cuts(&a_frame().encode(), Frame::decode);
}

#[test]
fn a_header_that_promises_too_much_is_refused_without_reserving_it() {
    let mut topology = a_topology().encode();
    topology[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
    topology[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(matches!(Topology::decode(&topology), Err(Malformed::Length { .. })));
    let mut frame = a_frame().encode();
    frame[20..24].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(matches!(Frame::decode(&frame), Err(Malformed::Length { .. })));
}

#[test]
fn json_messages_are_spelled_as_the_document_says() {
    let client = |text: &str| serde_json::from_str::<ClientMessage>(text).unwrap();
    let grab = |at| ClientMessage::Grab { at };
    assert_eq!(client(r#"{"op":"grab","at":{"corner":"00"}}"#), grab(At::Corner(Corner::Origin)));
    assert_eq!(client(r#"{"op":"grab","at":{"corner":"IJ"}}"#), grab(At::Corner(Corner::Opposite)));
    assert_eq!(client(r#"{"op":"grab","at":{"particle":[3,4]}}"#), grab(At::Particle([3, 4])));
    assert_eq!(client(r#"{"op":"grab","at":{"nearest_m":[0,1,2]}}"#), grab(At::NearestM([0.0, 1.0, 2.0])));
    assert_eq!(client(r#"{"op":"release"}"#), ClientMessage::Release { let_go: false });
    assert_eq!(client(r#"{"op":"ping","t_us":1234567}"#), ClientMessage::Ping { t_us: 1_234_567 });
    let hello = r#"{"op":"hello","client":"d","device":{"max_force_n":8,"max_stiffness_n_per_m":3000,"rate_hz":500}}"#;
    let device = Device { max_force_n: 8.0, max_stiffness_n_per_m: 3000.0, rate_hz: 500.0 };
    assert_eq!(client(hello), ClientMessage::Hello { client: "d".into(), device });
    let ack: ViewerMessage = serde_json::from_str(r#"{"op":"ack","frame":7}"#).unwrap();
    assert_eq!(ack, ViewerMessage::Ack { frame: 7 });

    let server = |m: ServerMessage| serde_json::to_value(m).unwrap();
    let message = || "words".to_string();
    let denied = ServerMessage::Denied { code: Denied::HeldByAnother, message: message() };
    assert_eq!(server(denied), json!({"op":"denied","code":"held_by_another","message":"words"}));
    let released = ServerMessage::Released { code: Released::SessionEnded, message: message() };
    assert_eq!(server(released), json!({"op":"released","code":"session_ended","message":"words"}));
    let error = ServerMessage::Error { code: ErrorCode::StaleSeq, message: message() };
    assert_eq!(server(error), json!({"op":"error","code":"stale_seq","message":"words"}));
}
