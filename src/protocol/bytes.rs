//! Little-endian cursors for the binary layouts; no allocation beyond the message itself.

use super::Malformed;

/// Appends fields to a message.
pub(super) struct Writer(Vec<u8>);

impl Writer {
    /// Starts a message of `length` bytes with its opcode.
    pub(super) fn new(opcode: u8, length: usize) -> Writer {
        let mut bytes = Vec::with_capacity(length);
        bytes.push(opcode);
        Writer(bytes)
    }
    /// Ends the message.
    pub(super) fn finish(self) -> Vec<u8> {
        self.0
    }
    /// Appends zeros until the length is a multiple of `to`.
    pub(super) fn pad(&mut self, to: usize) {
        self.0.resize(self.0.len().next_multiple_of(to), 0);
    }
    pub(super) fn u8(&mut self, v: u8) {
        self.0.push(v);
    }
    pub(super) fn u16(&mut self, v: u16) {
        self.0.extend(v.to_le_bytes());
    }
    pub(super) fn u32(&mut self, v: u32) {
        self.0.extend(v.to_le_bytes());
    }
    pub(super) fn u64(&mut self, v: u64) {
        self.0.extend(v.to_le_bytes());
    }
    /// Appends a number as f32.
    pub(super) fn f32(&mut self, v: f64) {
        self.0.extend((v as f32).to_le_bytes());
    }
    /// Appends numbers as f32.
    pub(super) fn f32s(&mut self, v: &[f64]) {
        v.iter().for_each(|&x| self.f32(x));
    }
    /// Appends a number as f64.
    pub(super) fn f64(&mut self, v: f64) {
        self.0.extend(v.to_le_bytes());
    }
}

/// Reads fields of a message whose length was checked.
pub(super) struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    /// Opens a message; checks its opcode and that it has at least `length` bytes.
    pub(super) fn new(
        bytes: &'a [u8],
        what: &'static str,
        opcode: u8,
        length: usize,
    ) -> Result<Self, Malformed> {
        let got = bytes.first().copied().unwrap_or(0);
        if got != opcode {
            return Err(Malformed::Opcode { got, expected: opcode });
        }
        if bytes.len() < length {
            return Err(Malformed::Length { what, got: bytes.len(), expected: length });
        }
        Ok(Reader(&bytes[1..]))
    }
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (head, rest) = self.0.split_first_chunk().expect("length was checked on opening");
        self.0 = rest;
        *head
    }
    /// Passes over bytes that are zero.
    pub(super) fn skip(&mut self, n: usize) {
        self.0 = &self.0[n..];
    }
    pub(super) fn u8(&mut self) -> u8 {
        self.take::<1>()[0]
    }
    pub(super) fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }
    pub(super) fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }
    pub(super) fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }
    pub(super) fn f32(&mut self) -> f64 {
        f64::from(f32::from_le_bytes(self.take()))
    }
    pub(super) fn f32s<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| self.f32())
    }
    pub(super) fn f64s<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| f64::from_le_bytes(self.take()))
    }
}
