//! All integration tests in one binary: one link of the server instead of many.

mod fabric;
mod laws;
