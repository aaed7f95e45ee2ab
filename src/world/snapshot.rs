//! The present of a world, to come back to.

use super::{Report, Settling, World, remesh};
use crate::{math::Vec3, model::Model, potential::contact::candidates::Candidates, state::State};
use std::sync::Arc;

/// Everything a world needs to go on from where it was; steps after `restore` depend on it and the commands alone.
#[derive(Clone)]
pub struct Snapshot {
    model: Arc<Model>,
    mesh: remesh::Mesh,
    state: State,
    hand: Option<usize>,
    held: bool,
    target: Option<Vec3>,
    fixed: Vec<bool>,
    settling: Settling,
    candidates: Candidates,
    report: Report,
}

impl World {
    /// The present, to come back to.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot {
            model: self.model.clone(),
            mesh: self.mesh.clone(),
            state: self.state.clone(),
            hand: self.hand,
            held: self.held,
            target: self.target,
            fixed: self.minimizer.system.fixed.clone(),
            settling: self.settling.clone(),
            candidates: self.candidates.clone(),
            report: self.report.clone(),
        }
    }

    /// Goes back to a snapshot of this world.
    pub fn restore(&mut self, snapshot: &Snapshot) {
        let Snapshot { model, mesh, state, hand, held, target, fixed, settling, candidates, report } =
            snapshot.clone();
        self.restore_mesh(&model);
        self.mesh = mesh;
        self.candidates = candidates;
        self.minimizer.system.hand = hand.map(|n| n as u32);
        self.minimizer.system.fixed = fixed;
        self.minimizer.forget();
        self.ahead_of = None;
        self.caution = 0;
        self.target = target;
        (self.state, self.hand, self.held, self.settling, self.report) =
            (state, hand, held, settling, report);
        self.positions.copy_from_slice(&self.state.positions);
        self.observed = self.report.time;
    }
}
