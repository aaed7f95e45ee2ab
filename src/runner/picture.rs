//! A state as a view frame: encoded once, shared by every viewer it is due for.

use super::Tick;
use crate::{
    protocol::view::{Frame, Topology},
    world::{Outcome, World},
};
use axum::body::Bytes;
use std::sync::Arc;

/// A state of the cloth, encoded for viewers.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Number of the frame in its session.
    pub number: u32,
    /// Number of the tick it shows.
    pub tick: u64,
    /// Mesh it belongs to.
    pub epoch: u32,
    /// The mesh, encoded.
    pub topology: Bytes,
    /// The frame, encoded.
    pub frame: Bytes,
}

/// Encodes states, keeping what belongs to the mesh.
#[derive(Debug, Default)]
pub struct Painter {
    frames: u32,
    mesh: Option<Mesh>,
}

#[derive(Debug)]
struct Mesh {
    epoch: u32,
    vertices: Vec<u32>,
    bytes: Bytes,
}

impl Mesh {
    /// The vertices are the particles that some triangle uses, in the order of their lattice index.
    fn of(world: &World) -> Mesh {
        let grid = world.grid();
        let triangles = grid.triangles();
        let mut vertices: Vec<u32> = triangles.iter().flatten().copied().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let mut place = vec![0; grid.particles()];
        vertices.iter().zip(0..).for_each(|(&v, k)| place[v as usize] = k);
        let topology = Topology {
            epoch: grid.epoch,
            counts: grid
                .counts
                .map(|n| u16::try_from(n).expect("scenes are smaller than 65536 particles a side")),
            triangles: triangles.iter().map(|t| t.map(|v| place[v as usize])).collect(),
            levels: vertices.iter().map(|&v| grid.level(v as usize)).collect(),
            vertices,
        };
        Mesh { epoch: grid.epoch, bytes: topology.encode().into(), vertices: topology.vertices }
    }
}

impl Painter {
    /// Encodes the world as it is after `tick`.
    pub fn paint(&mut self, world: &World, tick: &Tick) -> Arc<Picture> {
        if self.mesh.as_ref().is_none_or(|m| m.epoch != world.grid().epoch) {
            self.mesh = Some(Mesh::of(world));
        }
        let mesh = self.mesh.as_ref().expect("made above");
        self.frames = self.frames.wrapping_add(1);
        let mut frame = header(world, tick);
        frame.number = self.frames;
        frame.positions = mesh
            .vertices
            .iter()
            .map(|&v| {
                let p = &world.positions()[v as usize];
                [p.x as f32, p.y as f32, p.z as f32]
            })
            .collect();
        Arc::new(Picture {
            number: self.frames,
            tick: tick.number,
            epoch: mesh.epoch,
            topology: mesh.bytes.clone(),
            frame: frame.encode().into(),
        })
    }
}

fn pose(pose: &nalgebra::Isometry3<f64>) -> [f32; 7] {
    let ([x, y, z], [i, j, k, w]): ([f64; 3], [f64; 4]) =
        (pose.translation.vector.into(), pose.rotation.coords.into());
    [x, y, z, i, j, k, w].map(|v| v as f32)
}

/// Everything of a frame but its number and positions.
fn header(world: &World, tick: &Tick) -> Frame {
    let report = &tick.report;
    let mut frame = Frame {
        flags: 0,
        server_us: tick.server_us,
        epoch: world.grid().epoch,
        active: report.particles_active as u32,
        hand_particle: Frame::NO_PARTICLE,
        cost: [report.cost.newton, report.cost.stretch, report.cost.bend, report.cost.shear],
        residual: report.residual,
        solve_ms: tick.solve_ms,
        max_penetration: report.max_penetration,
        tick_hz: tick.measured_hz,
        poses: world.state().poses.iter().map(pose).collect(),
        ..Frame::default()
    };
    let flag = |on: bool, bit: u8| if on { bit } else { 0 };
    frame.flags |= flag(report.outcome == Outcome::Converged, Frame::CONVERGED);
    frame.flags |= flag(report.resting, Frame::RESTING);
    if let Some(hand) = &report.hand {
        frame.flags |= Frame::HAND | flag(tick.holder.is_some(), Frame::HELD);
        frame.hand_particle = world.grid().index(hand.particle) as u32;
        frame.hand_position = hand.position.into();
        frame.force = hand.force.into();
        frame.force_error = hand.force_error;
    }
    frame
}
