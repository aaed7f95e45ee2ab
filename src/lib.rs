//! kesi: live cloth with Kawabata (KES) mechanics, felt through a hand.
//!
//! Modules are declared in dependency order: each uses only those above it.
#![allow(rustdoc::broken_intra_doc_links, reason = "units stand in brackets: [m], [N/m]")]

#[cfg(feature = "wire")]
pub mod protocol;
pub mod math;
pub mod fabric;
pub mod cut;
pub mod grid;
pub mod batch;
pub mod cores;
pub mod surface;
pub mod obstacle;
pub mod model;
pub mod state;
pub mod potential;
pub mod cost;
pub mod phase;
pub mod minimize;
pub mod hand;
pub mod adapt;
pub mod world;
pub mod successor;
pub mod compare;
pub mod lab;
pub mod scene;
pub mod validate;
pub mod stress;
#[cfg(feature = "server")]
pub mod metrics;
#[cfg(feature = "server")]
pub mod recording;
#[cfg(feature = "server")]
pub mod config;
#[cfg(feature = "server")]
pub mod runner;
#[cfg(feature = "server")]
pub mod session;
#[cfg(feature = "server")]
pub mod server;
#[cfg(feature = "client")]
pub mod client;
pub mod cli;
