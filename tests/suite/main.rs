//! All integration tests in one binary: one link of the server instead of many.

mod fabric;
mod laws;

mod cloth;
mod derivatives;
mod mechanics;
mod instruments;
