//! The mesh of a live world: copies to decide on, and adoption of what was prepared from them.

use super::{Report, Settling, World, fork::Declined};
use crate::{
    adapt::{self, Prepared, Probe, Settings},
    cost::CostReport,
    grid::{Cell, Grid, Site},
    math::Vec3,
    minimize::{Minimizer, Outcome},
    model::Model,
    potential::Pull,
};
use std::{mem, sync::Arc};

/// What became of the mesh since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Remeshing {
    /// Changes of the mesh.
    pub changes: u64,
    /// Cells that were split.
    pub splits: u64,
    /// Cells that were merged from two or four.
    pub merges: u64,
    /// Merges that the force budget refused, foreseen or found when the mesh was to change, and edits that would have brought in energy or
    /// left loads that are more than the cloth.
    pub refused: u64,
    /// Active particles by level: 0 beside the finest cells.
    pub by_level: [usize; LEVELS],
    /// Cost before and after the last change, its dead loads counted as out of balance.
    pub cost: [CostReport; 2],
}

/// Levels that are counted; the last takes all coarser ones.
pub const LEVELS: usize = 4;

/// What a world remembers about its mesh.
#[derive(Clone, Debug, Default)]
pub(super) struct Mesh {
    pub settings: Option<Settings>,
    /// Foreseen difference of the hand's force from a mesh that never merged [N].
    pub drift: Vec3,
    /// Cells that were split, until when they are not merged again [s], and for how long that is [s].
    young: Vec<(Cell, f64, f64)>,
    /// Whether the last probe found the mesh good.
    pub good: bool,
    /// Changes that were refused in a row; one that is taken makes up for one.
    pub refusals: u32,
    /// Simulated time for which a cloth that could rest waited for its mesh [s].
    waited: f64,
    /// Positions at which the rests and held loads of the state were made [m]; empty without any, or when the cloth has moved on.
    pub held_at: Vec<Vec3>,
}

/// Time in which the dead loads of a change fade to 1/e [s]. Then a change that shifts the force by 1 % in all shifts it by
/// 0.1 % in a tick of 8 ms.
const FADE: f64 = 0.08;
/// Simulated time in which the foreseen difference from a mesh that never merged is forgotten to 1/e [s]: it belongs to the shape
/// of its time. While the cloth falls, merges would else use up the budget of the rest that follows.
const FORGET: f64 = 0.5;
/// Dead load, over the weight of a mean particle, that is dropped.
const FADED: f64 = 1e-2;
/// Part of the rests that may fade in a step without its first gradient.
const LITTLE: f64 = 0.05;
/// Part of the rests that is dropped.
const LEAST_REST: f64 = 1e-3;
/// Simulated time for which a split cell is not merged again [s]; each further time it lasts twice as long, so that nothing
/// changes to and fro for ever.
const YOUTH: f64 = 0.5;
/// Simulated time after which it is forgotten that a cell was split [s].
const MEMORY: f64 = 20.0;
/// Simulated time for which a cloth that could rest waits for its mesh at the most [s].
const MOST_WAIT: f64 = 6.0;
/// Refusals in a row from which on a mesh counts as good.
const MOST_REFUSALS: u32 = 5;
/// How far the hand's force may jump: the larger of a part of it [1] and [N].
const JUMP: [f64; 2] = [5e-3, 2e-3];

/// Active particles by level.
pub(super) fn by_level(grid: &Grid) -> [usize; LEVELS] {
    let mut counts = [0; LEVELS];
    grid.active().for_each(|n| counts[usize::from(grid.level(n)).min(LEVELS - 1)] += 1);
    counts
}

impl Mesh {
    pub fn keep_split(&mut self, cell: Cell, now: f64) {
        self.young.retain(|(_, until, _)| now < until + MEMORY);
        // What is split again had merged since; what is halved a second time had not.
        let before = self.young.iter().filter(|(known, ..)| known.overlaps(&cell));
        let lasts = before.map(|(_, until, lasts)| if now < *until { *lasts } else { 2.0 * lasts });
        let lasts = lasts.fold(YOUTH, f64::max);
        self.young.retain(|(known, ..)| *known != cell);
        self.young.push((cell, now + lasts, lasts));
    }
}

impl World {
    /// Lets the mesh adapt, or keeps it as it is.
    pub fn set_adaptive(&mut self, settings: Option<Settings>) {
        self.mesh.settings = settings;
    }

    /// A copy to decide on the mesh; `None` at rest, or where the mesh does not adapt.
    pub fn probe(&self) -> Option<Probe> {
        let settings = self.mesh.settings.filter(|_| self.settling != Settling::Resting)?;
        Some(self.probe_with(settings))
    }

    fn probe_with(&self, settings: Settings) -> Probe {
        let now = self.report.time;
        let young = self.mesh.young.iter().filter(|(_, until, _)| now < *until);
        Probe {
            settings,
            model: self.model.clone(),
            state: self.state.clone(),
            fixed: self.minimizer.system.fixed.clone(),
            hand: self.minimizer.system.hand,
            force: self.report.hand.map_or(Vec3::zeros(), |h| h.force),
            drift: self.mesh.drift,
            young: young.map(|(cell, ..)| *cell).collect(),
            part: 0.5_f64.powi(self.mesh.refusals as i32),
            method: self.method,
        }
    }

    /// Looks at the mesh and changes it at once where that is due; true when it did.
    pub fn adapt(&mut self) -> bool {
        let Some(probe) = self.probe() else { return false };
        match probe.prepare() {
            Some(prepared) => self.adopt(prepared),
            None => {
                self.keep_mesh();
                false
            }
        }
    }

    /// Says that a probe found the mesh good, so that the cloth may rest on it.
    pub fn keep_mesh(&mut self) {
        self.mesh.good = true;
    }

    /// Goes on with a prepared mesh; false, and nothing changes, when the cloth came to rest or the mesh changed meanwhile.
    pub fn adopt(&mut self, prepared: Prepared) -> bool {
        self.exchange(prepared).is_some()
    }

    /// The same; gives the world on the old mesh to whoever has time to free it.
    pub fn exchange(&mut self, prepared: Prepared) -> Option<World> {
        if self.settling == Settling::Resting { None } else { self.change_mesh(prepared) }
    }

    fn change_mesh(&mut self, prepared: Prepared) -> Option<World> {
        match self.fork().on(prepared) {
            Ok(mut world) => {
                world.scratch = mem::take(&mut self.scratch);
                Some(mem::replace(self, world))
            }
            Err(declined) => {
                self.decline(declined);
                None
            }
        }
    }

    /// Changes places with one that was forked from this world, changed its mesh and made the same steps since. False, and nothing changes,
    /// where this one sleeps, the other is not as far, or the hand's force would jump.
    pub fn succeed(&mut self, heir: &mut World) -> bool {
        let (now, then) = (&self.report, &heir.report);
        // After trouble its steps may have been shorter.
        let is_level = now.step == then.step && now.time <= then.time;
        if self.settling == Settling::Resting || !is_level || then.outcome == Outcome::NotFinite {
            return false;
        }
        let force = |report: &Report| report.hand.map_or(Vec3::zeros(), |hand| hand.force);
        let jump = (force(then) - force(now)).norm();
        let merged = then.remeshing.merges - now.remeshing.merges;
        if jump > (JUMP[0] * force(now).norm()).max(JUMP[1]) {
            // Merges may be done without; what must split is split at once the next time, where loads keep the force.
            if merged > 0 {
                self.decline(Declined::Refused(merged));
            }
            return false;
        }
        // What has been told does not fall.
        heir.report.dissipated = heir.report.dissipated.max(now.dissipated);
        heir.set_method(self.method);
        mem::swap(self, heir);
        true
    }

    /// Says that a mesh was not taken.
    pub fn decline(&mut self, why: Declined) {
        if let Declined::Refused(edits) = why {
            self.report.remeshing.refused += edits;
            self.mesh.refusals = (self.mesh.refusals + 1).min(MOST_REFUSALS);
            self.mesh.good = self.mesh.refusals == MOST_REFUSALS;
        }
    }

    /// Makes a particle active that is not, splitting the cells around it.
    pub(super) fn make_active(&mut self, particle: Site) {
        let n = self.model.grid.index(particle);
        if self.model.grid.is_active(n) {
            return;
        }
        let edits = adapt::to_finest(&self.model.grid, n);
        let settings = self.mesh.settings.unwrap_or_default();
        if let Some(prepared) = self.probe_with(settings).change_to(edits) {
            self.change_mesh(prepared);
        }
    }

    /// Lets rests fade by what a step of `dt` [s] makes, if the cloth has moved on.
    pub(super) fn fade_rests(&mut self, dt: f64) {
        if self.rests_fade() {
            let rests = self.state.rests;
            self.state.rests = if rests > LEAST_REST { rests * (-dt / FADE).exp() } else { 0.0 };
        }
    }

    /// Lets dead loads fade over a step of `dt` [s], and those that were held when the cloth has moved on.
    pub(super) fn fade_loads(&mut self, dt: f64) {
        let keep = (-dt / FADE).exp();
        self.mesh.drift *= (-dt / FORGET).exp();
        let least = FADED * self.mean_weight();
        let way = self.model.grid.spacing(0).min(self.model.grid.spacing(1));
        let positions = &self.state.positions;
        let is_held = !self.mesh.held_at.is_empty();
        let moved = |n: usize| (positions[n] - self.mesh.held_at[n]).norm() > way;
        if is_held && self.model.elements.present().any(moved) {
            self.mesh.held_at.clear();
            let held = self.state.held.iter_mut().map(std::mem::take);
            self.state.loads.iter_mut().zip(held).for_each(|(load, held)| *load += held);
        }
        for n in self.model.elements.present() {
            let load = &mut self.state.loads[n];
            *load *= keep;
            if load.norm() < least {
                *load = Vec3::zeros();
            }
        }
    }

    /// Whether elements' rests have begun to fade.
    pub(super) fn rests_fade(&self) -> bool {
        self.state.rests > 0.0 && self.mesh.held_at.is_empty()
    }

    /// Whether they fade by so much in a step of `dt` [s] that the gradient it begins with must know.
    pub(super) fn rests_fade_much(&self, dt: f64) -> bool {
        self.rests_fade() && dt > LITTLE * FADE
    }

    /// Whether a cloth that could rest still waits, after a step of `dt` [s], for its mesh, or for loads to fade.
    pub(super) fn mesh_works(&mut self, dt: f64) -> bool {
        let loaded = self.model.elements.present().any(|n| self.state.loads[n] != Vec3::zeros());
        let unsettled = self.mesh.settings.is_some() && !self.mesh.good && self.mesh.waited < MOST_WAIT;
        self.mesh.waited += if unsettled { dt } else { 0.0 };
        loaded || unsettled || self.rests_fade()
    }

    /// Something moved: the mesh must be looked at again.
    pub(super) fn stir_mesh(&mut self) {
        (self.mesh.good, self.mesh.waited) = (false, 0.0);
    }

    /// Brings a world back to the mesh of a snapshot.
    pub(super) fn restore_mesh(&mut self, model: &Arc<Model>) {
        if !Arc::ptr_eq(&self.model, model) {
            self.model = model.clone();
            self.minimizer = Minimizer::new(model, self.method);
            self.pull = Pull::none(model);
            let nodes = model.elements.nodes();
            self.ahead = vec![Vec3::zeros(); nodes];
            self.begun = vec![Vec3::zeros(); nodes];
            self.positions = vec![Vec3::zeros(); nodes];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_split_again_waits_twice_as_long_whatever_it_had_merged_into() {
        let mut mesh = Mesh::default();
        let mut split = |corner: Site, size: Site, now: f64| {
            mesh.keep_split(Cell { corner, size }, now);
            mesh.young.last().map(|(_, until, lasts)| [until - now, *lasts])
        };
        assert_eq!(split([0, 0], [4, 4], 0.0), Some([YOUTH; 2]));
        assert_eq!(
            split([2, 0], [2, 2], 0.1),
            Some([YOUTH; 2]),
            "it has not merged since: it is halved further"
        );
        assert_eq!(split([2, 0], [1, 4], 1.0), Some([2.0 * YOUTH; 2]), "another shape, in the same place");
        assert_eq!(split([4, 0], [4, 4], 1.0), Some([YOUTH; 2]), "beside it");
        assert_eq!(split([0, 0], [4, 4], 2.5), Some([4.0 * YOUTH; 2]));
        assert_eq!(split([0, 0], [4, 4], 2.5 + 4.0 * YOUTH + MEMORY), Some([YOUTH; 2]), "long ago");
    }
}
