//! Wire messages of version 1: JSON as serde types, binary layouts to the byte. `PROTOCOL.md` says it in prose.
//!
//! Holds no sockets and no policy: what a message means is the server's and the client's business. Numbers here are
//! SI; fields that carry a unit say so in their name. All binary is little-endian.

pub mod haptic;
pub mod http;
pub mod pose;
pub mod schema;
pub mod view;

mod bytes;

/// Subprotocol of the haptic socket.
pub const HAPTIC: &str = "kesi.haptic.v1";
/// Subprotocol of the view socket.
pub const VIEW: &str = "kesi.view.v1";
/// Name and version of this server, as in every `hello`.
pub const SERVER: &str = concat!("kesi ", env!("CARGO_PKG_VERSION"));
/// Longest distance of a hand pose from the origin [m].
pub const FARTHEST: f64 = 10.0;
/// Largest message a client may send on either socket, in bytes.
pub const MESSAGE_LIMIT: usize = 4096;
/// Most messages a client may send within a second besides data: moves that are taken, acknowledgements of frames.
pub const REQUEST_LIMIT: u32 = 1000;

/// WebSocket close codes this protocol uses.
pub mod close {
    /// The session ended in order.
    pub const NORMAL: u16 = 1000;
    /// The server is going away.
    pub const AWAY: u16 = 1001;
    /// Wrong or missing subprotocol, or broken framing.
    pub const PROTOCOL: u16 = 1002;
    /// Text that is not UTF-8.
    pub const NOT_UTF8: u16 = 1007;
    /// A client that sends more than it may.
    pub const POLICY: u16 = 1008;
    /// A message larger than [`super::MESSAGE_LIMIT`].
    pub const TOO_LARGE: u16 = 1009;
    /// The session failed.
    pub const FAILED: u16 = 1011;
}

/// Why bytes are not the message they should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Malformed {
    /// The opcode in byte 0 is another one.
    #[error("opcode is {got:#04x}, expected {expected:#04x}")]
    Opcode { got: u8, expected: u8 },
    /// The message has another length than its layout.
    #[error("{what} is {got} bytes, expected {expected}")]
    Length { what: &'static str, got: usize, expected: usize },
}
