//! A copy of a world that goes on on another mesh, here or on another thread.

use super::{Report, Scratch, Settling, World, meets_obstacles, remesh};
use crate::{
    adapt::{self, Carried, Prepared},
    cost,
    math::Vec3,
    minimize::{Legacy, Method},
    model::{Model, Setup},
    potential::{Potential, Pull},
    state::State,
};
use std::sync::Arc;

/// What a world is, and what its solver knows.
pub struct Fork {
    setup: Arc<Setup>,
    model: Arc<Model>,
    method: Method,
    mesh: remesh::Mesh,
    state: State,
    legacy: Legacy,
    hand: Option<usize>,
    held: bool,
    target: Option<Vec3>,
    observation: f64,
    caution: i32,
    settling: Settling,
    report: Report,
}

/// Why a mesh is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Declined {
    /// It does not fit the cloth as it is now.
    Late,
    /// So many edits would bring in energy, leave loads that are more than the cloth, or change the hand's force by more than they may.
    Refused(u64),
}

impl World {
    /// A copy to go on with on another mesh.
    pub fn fork(&mut self) -> Fork {
        // Cost and energy before the change are those of now.
        self.observe();
        Fork {
            setup: self.setup.clone(),
            model: self.model.clone(),
            method: self.method,
            mesh: self.mesh.clone(),
            state: self.state.clone(),
            legacy: self.minimizer.legacy(),
            hand: self.hand,
            held: self.held,
            target: self.target,
            observation: self.observation,
            caution: self.caution,
            settling: self.settling.clone(),
            report: self.report.clone(),
        }
    }
}

impl Fork {
    /// The world on a prepared mesh.
    pub fn on(self, prepared: Prepared) -> Result<World, Declined> {
        let Prepared {
            edits,
            model,
            mut minimizer,
            transfer,
            change,
            limit,
            gain,
            load,
            refused,
            follows,
            ..
        } = prepared;
        let Fork { model: old, mut mesh, mut report, legacy, .. } = self;
        let keeps_fixed = (0..model.grid.particles()).all(|n| !legacy.fixed[n] || model.grid.is_active(n));
        if follows != old.grid.epoch || !keeps_fixed {
            return Err(Declined::Late);
        }
        let Carried { state, measures, candidates } =
            transfer.carry(&old, &model, &self.state, &legacy.fixed);
        // Another mesh is another surface: it must not cut what the old one lies on.
        if !state.is_finite() || meets_obstacles(&model, &state) {
            return Err(Declined::Late);
        }
        minimizer.iterate(&model, self.method);
        minimizer.take_over(&legacy, &old, &model);
        let pull = Pull::still(&model, &state);
        let after = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
        // Dead loads count as out of balance.
        let loads = &pull.loads;
        let (cost, energy) =
            cost::of_state(&after, &state.positions, loads, &minimizer.system.fixed, &measures);
        let gained = energy - report.energy;
        // A cloth that is quiet is as it was when the change was foreseen, at rest; else it has moved on since.
        let found = change
            .filter(|_| transfer.holds)
            .unwrap_or_else(|| adapt::held_back(&minimizer, &model, loads).iter().sum());
        let loaded: f64 = loads.iter().map(|load| load.norm()).sum();
        if !(gained <= gain && loaded <= load && (mesh.drift + found).norm() <= limit) {
            return Err(Declined::Refused(edits.len() as u64));
        }
        let remeshing = &mut report.remeshing;
        remeshing.changes += 1;
        remeshing.refused += refused as u64;
        remeshing.cost = [report.cost, cost];
        for edit in &edits {
            if edit.merges() {
                remeshing.merges += 1;
            } else {
                remeshing.splits += 1;
                mesh.keep_split(edit.cell(), report.time);
            }
        }
        [report.particles_active, report.particles_ghost] = model.grid.tally();
        remeshing.by_level = remesh::by_level(&model.grid);
        mesh.drift += change.unwrap_or(found);
        mesh.good = false;
        mesh.refusals = mesh.refusals.saturating_sub(1);
        mesh.held_at = if transfer.holds { state.positions.clone() } else { Vec::new() };
        minimizer.measures = measures;
        let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
        minimizer.make_ready(&potential);
        let mut world = World {
            positions: state.positions.clone(),
            ahead: vec![Vec3::zeros(); state.positions.len()],
            begun: vec![Vec3::zeros(); state.positions.len()],
            ahead_of: None,
            anchors: Vec::new(),
            observation: self.observation,
            observed: report.time,
            setup: self.setup,
            method: self.method,
            hand: self.hand,
            held: self.held,
            target: self.target,
            caution: self.caution,
            settling: self.settling,
            scratch: Scratch::default(),
            model,
            mesh,
            state,
            minimizer,
            candidates,
            pull,
            report,
        };
        world.stop_seeking();
        Ok(world)
    }
}
