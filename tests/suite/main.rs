//! All integration tests in one binary: one link of the server instead of many.

mod adapt;
mod bench;
mod cloth;
mod contact;
mod compare;
mod cut;
mod derivatives;
mod directions;
mod distances;
mod drape;
mod factor;
mod fabric;
mod instructions;
mod lab;
mod laws;
mod mechanics;
mod mesh;
mod modules;
mod multigrid;
mod ratios;
mod scene;
mod stress;
mod validate;
#[cfg(feature = "wire")]
mod protocol;
#[cfg(all(feature = "server", feature = "client"))]
mod service;
#[cfg(feature = "recording")]
mod recording;
