//! Virtual instruments: specimens of particles in a world, held and moved as the machines do it, read as the machines read.
//!
//! Everything goes through `World`, the same that serves clients. Nothing here is fitted.

pub mod specimen;
pub mod kes;
pub mod wander;
pub mod drape;
