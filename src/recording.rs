//! Recordings (skeleton).
