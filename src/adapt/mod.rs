//! When to merge cells and when to split them, and what that does to the hand's force: as few particles as force and folds allow.
//!
//! `Probe::prepare` is slow and pure, so that it can run beside the world: it looks at a copy of the state, chooses edits, makes
//! the new mesh with its solver, and foresees what merges do to the force. The world then adopts it within a tick. One change of the mesh
//! either splits or merges; splitting comes first. Thresholds have a dead band of a factor of two, and what was split stays so for
//! a while, so a mesh at rest does not change.

mod measure;
mod anchors;
mod source;
mod transfer;

pub use transfer::{Carried, Transfer};

use crate::{
    grid::{Cell, Edit, Grid, Unfit},
    hand::Reach,
    math::Vec3,
    minimize::{Method, Minimizer},
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, halves::FEWEST_IN_HALVES},
    state::State,
};
use measure::{KEEP, MERGE, Scores, sites};
use std::{collections::HashSet, sync::Arc};

/// What decides how fine the mesh is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Criterion {
    /// How far a cell turns.
    BendingAngle,
    /// The paper's: the bending moment, against the one that weight raises over a bending length, squared.
    BendingCost,
    /// The paper's: that plus the strain against one percent, squared.
    BendingStretchingCost,
    /// How much the hand's force depends on a cell, with a cap on its turn.
    ForceSensitivity,
}

/// How the mesh adapts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// What decides.
    pub criterion: Criterion,
    /// Turn of a cell along a direction above which it is halved there [rad]; two merge below half of it. 0.3 gave about 0.2 % of force error on the
    /// scenes here; 0.4 already shows.
    pub angle: f64,
    /// Size up to which cells merge, over the one of which two in a half wave just bear the compression there; they are split at twice that.
    pub buckling: f64,
    /// Difference of tension between the ends of a cell's side above which it is halved, over the hand's force per length of the sheet's
    /// shorter side: where the hand's force enters the sheet and where pins take it up, tension falls off within a few cells. Under a hand
    /// that tells; at rest merged elements keep their tension anyway.
    pub tension: f64,
    /// Cost above which a cell is split, for the paper's criteria.
    pub cost: f64,
    /// Force sensitivity above which a cell is split, relative to the sheet's mean.
    pub sensitivity: f64,
    /// Largest cell, in intervals of the lattice.
    pub coarsest: usize,
    /// Longest cell, over its shorter side; squares only with 1.
    pub slenderest: usize,
    /// Whether merged cells may be split again.
    pub refines: bool,
    /// Rings of finest cells around fixed particles. Three halve the force error.
    pub rings: usize,
    /// Change of the hand's force that merging may add up to: the larger of a part of the force [1] and [N].
    pub budget: [f64; 2],
    /// What particles cost; a mesh only merges where it does not become dearer.
    pub price: Price,
}

/// What a particle costs beside one whose neighbours stand in lines of a lattice.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Price {
    /// One on a graded mesh.
    pub graded: f64,
    /// One of the few that stand off the lines, where nearly all cells are of one size.
    pub loose: f64,
    /// One in the lines of a lattice so large that two cores share it.
    pub shared: f64,
}

impl Price {
    /// All cost the same: who merges has the fewest.
    pub const EQUAL: Price = Price { graded: 1.0, loose: 1.0, shared: 1.0 };
    /// Of a factor: 1.1 measured, and what a mesh must save at least that errs under a hand.
    pub const FACTOR: Price = Price { graded: 1.4, loose: 1.4, shared: 1.0 };
    /// Of conjugate gradients, from times of adaptive and uniform sheets with AVX2 and AVX-512.
    pub const ITERATIONS: Price = Price { graded: 2.0, loose: 5.0, shared: 0.6 };

    /// What a mesh costs, in particles of a lattice.
    pub fn of(&self, grid: &Grid) -> f64 {
        let all = grid.active().count() as f64;
        let graded = self.graded * all;
        let Some(size) = grid.main_size() else { return graded };
        let in_line = grid.active().filter(|&n| grid.is_on_lines(n, size)).count();
        let each = if in_line < FEWEST_IN_HALVES { 1.0 } else { self.shared };
        let in_line = in_line as f64;
        graded.min(each * in_line + self.loose * (all - in_line))
    }
}

/// How many times as dear as a lattice a mesh that grows must be to become that lattice again.
const REGROWN: f64 = 1.2;

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            criterion: Criterion::BendingAngle,
            angle: 0.3,
            buckling: 0.8,
            tension: f64::INFINITY,
            cost: 0.05,
            sensitivity: 10.0,
            coarsest: 4,
            slenderest: 4,
            refines: true,
            rings: 3,
            budget: [0.01, 5e-3],
            price: Price::EQUAL,
        }
    }
}

impl Settings {
    /// As sessions adapt that are solved so. Conjugate gradients gain most where few sizes meet; cells that turn a little farther and bear
    /// twice the compression leave half as many particles at the same error of the force (hanging sheets under a hand); a flag then needs
    /// cells that are small where tension differs.
    pub fn of(method: Method) -> Settings {
        let settings = Settings::default();
        match method.accuracy() {
            None => Settings { slenderest: 1, price: Price::FACTOR, ..settings },
            Some(_) => {
                Settings { angle: 0.4, buckling: 1.6, tension: 10.0, price: Price::ITERATIONS, ..settings }
            }
        }
    }
}

/// A copy of what a change of the mesh is decided on.
#[derive(Clone, Debug)]
pub struct Probe {
    /// How the mesh adapts.
    pub settings: Settings,
    /// The present mesh.
    pub model: Arc<Model>,
    /// The present state.
    pub state: State,
    /// Fixed particles.
    pub fixed: Vec<bool>,
    /// The hand's particle.
    pub hand: Option<u32>,
    /// Force at the hand [N].
    pub force: Vec3,
    /// Foreseen difference of that force from a mesh that never merged [N].
    pub drift: Vec3,
    /// Cells that were split a short while ago.
    pub young: Vec<Cell>,
    /// Part of the merges that are asked for, what changes least first: fewer where more have been refused.
    pub part: f64,
    /// Whose factor solves.
    pub method: Method,
}

/// A new mesh, ready to be adopted.
pub struct Prepared {
    /// What changes.
    pub edits: Vec<Edit>,
    /// The new mesh.
    pub model: Arc<Model>,
    /// Its solver, with nothing fixed.
    pub minimizer: Minimizer,
    /// The way from the old one.
    pub transfer: Transfer,
    /// Foreseen change of the hand's force [N]. What splits change is only seen when they are adopted, as nothing depends on it before.
    pub change: Option<Vec3>,
    /// How far it may take that force from the one of a mesh that never merged [N].
    pub limit: f64,
    /// Energy that it may bring in [J], and dead loads that it may leave in all [N].
    pub gain: f64,
    pub load: f64,
    /// Merges that the force budget refused.
    pub refused: usize,
    /// Number of the mesh that it follows.
    pub follows: u32,
    /// What a step on it costs, over one on that mesh.
    pub price: f64,
}

/// Pseudo-transient shifts [1/s²] at which the force's change is foreseen, until one makes the Hessian definite.
const SHIFTS: [f64; 4] = [1.0, 1e2, 1e3, 1e4];

/// Energy that a change which a criterion chose may bring in, over the sheet's weight times its longer side. Usual is less than 1e-3; cells
/// that crumpled bring in thousands, again and again.
const GAINED: f64 = 1e-2;

/// Dead loads that merging may leave in all, over the sheet's weight. Usual is 0.1 to 2; of cells that crumpled it is 1e2 to 1e5, and does work
/// without bounds where the cloth moves on.
const LOADED: f64 = 10.0;

/// Parts of the force budget that fewer merges are tried with.
const PARTS: [f64; 3] = [0.5, 0.2, 0.05];

/// What merges first: the smallest leaves, and four of them before two.
type Rank = (usize, bool);

impl Probe {
    /// Chooses edits and makes the new mesh; `None` when the present one is good.
    pub fn prepare(&self) -> Option<Prepared> {
        let (weight, [i, j]) = (self.model.weight_on_earth(), self.model.grid.size);
        let gain = GAINED * weight * i.max(j);
        self.choose().map(|prepared| {
            let merges = prepared.edits.first().is_some_and(Edit::merges);
            let load = if merges { LOADED * weight } else { f64::INFINITY };
            Prepared { gain, load, ..prepared }
        })
    }

    fn choose(&self) -> Option<Prepared> {
        let reach = match self.settings.criterion {
            Criterion::ForceSensitivity => self.reach(),
            _ => None,
        };
        let scores = Scores::new(self, reach.as_ref());
        if self.settings.refines {
            let edits = self.refined(self.too_large(&scores));
            if !edits.is_empty() {
                return self.change_to(edits);
            }
        }
        let mut merged = self.too_small(&scores);
        merged.truncate((merged.len() as f64 * self.part).ceil() as usize);
        self.within_budget(merged).filter(|prepared| self.is_worth_it(&prepared.model.grid))
    }

    /// The edits that split these cells, and with them all larger ones than those of a lattice, where that is much cheaper.
    fn refined(&self, cells: Vec<(Cell, [bool; 2])>) -> Vec<Edit> {
        let mut grid = self.model.grid.clone();
        let mut edits = grid.refine_along(cells);
        let (mut cheapest, mut kept) = (self.settings.price.of(&grid) / REGROWN, edits.len());
        // Splitting only adds particles.
        while self.settings.price.shared * (grid.active().count() as f64) < cheapest
            && let Some(longest) = grid.cells().iter().flat_map(|c| c.size).max().filter(|&size| size > 1)
        {
            let along = |cell: &Cell| cell.size.map(|size| size == longest);
            let large: Vec<_> = grid.cells().iter().map(|c| (*c, along(c))).collect();
            edits.extend(grid.refine_along(large));
            let price = self.settings.price.of(&grid);
            if price < cheapest {
                (cheapest, kept) = (price, edits.len());
            }
        }
        edits.truncate(kept);
        edits
    }

    fn is_worth_it(&self, grid: &Grid) -> bool {
        self.settings.price.of(grid) <= self.settings.price.of(&self.model.grid)
    }

    /// Leaves that the criterion wants split, and along what. Where what merged cells do not see is held, a split would drop that for
    /// nothing as long as the cloth stays: only what guards fixed particles is split there.
    fn too_large(&self, scores: &Scores) -> Vec<(Cell, [bool; 2])> {
        let cells = self.model.grid.cells().iter().filter(|c| c.is_coarse());
        let is_held = self.state.held.iter().any(|load| *load != Vec3::zeros());
        let limit = if is_held { f64::MAX } else { 1.0 };
        let along = |cell: &Cell| {
            let along = scores.of(cell).map(|score| score > limit);
            let halved = [0, 1].map(|k| cell.size[k] / (1 + usize::from(along[k])));
            if along == [false; 2] || self.is_allowed(halved) { along } else { [true; 2] }
        };
        cells.map(|cell| (*cell, along(cell))).filter(|(_, along)| *along != [false; 2]).collect()
    }

    fn is_allowed(&self, size: [usize; 2]) -> bool {
        let (short, long) = (size[0].min(size[1]), size[0].max(size[1]));
        long <= self.settings.coarsest && long <= short * self.settings.slenderest
    }

    /// Merges that the criterion allows and the mesh fits, the finest first, up to the size that makes the cheapest mesh; none where they are
    /// not worth it.
    fn too_small(&self, scores: &Scores) -> Vec<Edit> {
        let grid = &self.model.grid;
        let mut wishes: Vec<(Rank, f64, Edit)> = Vec::new();
        for leaf in grid.cells() {
            for along in [[true, true], [true, false], [false, true]] {
                let size = [0, 1].map(|k| leaf.size[k] << u8::from(along[k]));
                let parent = Cell::around(leaf.corner, size);
                let first = parent.corner == leaf.corner && self.is_allowed(size);
                // Neighbours may have to merge first, so balance is judged when the edits are made.
                if !first || grid.fits(Edit::Coarsen(parent)) == Err(Unfit::Leaves) {
                    continue;
                }
                if self.young.iter().any(|c| c.overlaps(&parent)) {
                    continue;
                }
                let limits = along.map(|along| if along { MERGE } else { KEEP });
                let scores = scores.up_to(&parent, limits);
                if (0..2).all(|k| scores[k] < limits[k]) {
                    let score = scores[0].max(scores[1]);
                    wishes.push(((leaf.intervals(), along != [true; 2]), score, Edit::Coarsen(parent)));
                }
            }
        }
        wishes.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut best = (self.settings.price.of(grid), Vec::new());
        let mut trial = grid.clone();
        let mut edits = Vec::new();
        for wishes in wishes.chunk_by(|a, b| a.0 == b.0) {
            edits.extend(trial.edit_what_fits(wishes.iter().map(|w| w.2)));
            let price = self.settings.price.of(&trial);
            if price <= best.0 {
                best = (price, edits.clone());
            }
        }
        best.1
    }

    /// The new mesh with as many of the merges as the force budget allows.
    fn within_budget(&self, merges: Vec<Edit>) -> Option<Prepared> {
        let wanted = merges.len();
        let (prepared, by_particle) = self.foresee(merges)?;
        let limit = (self.settings.budget[0] * self.force.norm()).max(self.settings.budget[1]);
        let is_within =
            |prepared: &Prepared| prepared.change.is_some_and(|change| (self.drift + change).norm() <= limit);
        if is_within(&prepared) {
            return Some(Prepared { limit, ..prepared });
        }
        let mut shares: Vec<(Vec3, Edit)> = prepared
            .edits
            .iter()
            .map(|&edit| (sites(&self.model.grid, &edit.cell()).map(|n| by_particle[n]).sum(), edit))
            .collect();
        shares.sort_by(|a, b| a.0.norm().total_cmp(&b.0.norm()));
        // What changes the force least first, as long as the sum of magnitudes stays within a part of what is left of the budget.
        let left = (limit - self.drift.norm()).max(0.0);
        for part in PARTS {
            let mut sum = 0.0;
            let kept = shares.iter().take_while(|(share, _)| {
                sum += share.norm();
                sum <= part * left
            });
            let kept: HashSet<&Edit> = kept.map(|(_, edit)| edit).collect();
            let edits: Vec<Edit> = prepared.edits.iter().filter(|e| kept.contains(e)).copied().collect();
            let edits = self.model.grid.clone().edit_what_fits(edits);
            let (fewer, _) = self.foresee(edits)?;
            if is_within(&fewer) {
                return Some(Prepared { limit, refused: wanted - fewer.edits.len(), ..fewer });
            }
        }
        None
    }

    /// The mesh with these merges, the change of the hand's force foreseen, and the part that each of its particles has in that [N]: what
    /// dead loads hold back.
    fn foresee(&self, merges: Vec<Edit>) -> Option<(Prepared, Vec<Vec3>)> {
        let mut prepared = self.change_to(merges)?;
        let Prepared { model, minimizer, transfer, .. } = &mut prepared;
        let Carried { state, .. } = transfer.carry(&self.model, model, &self.state, &self.fixed);
        let mut by_particle = vec![Vec3::zeros(); model.elements.nodes()];
        if let Some(hand) = self.hand
            && linearize(minimizer, model, &state, &self.fixed, hand)
        {
            by_particle = held_back(minimizer, model, &state.all_loads());
            minimizer.forget();
        }
        prepared.change = Some(by_particle.iter().sum());
        Some((prepared, by_particle))
    }

    /// The mesh with these edits, whatever the criterion says and whatever energy they bring in; they must all split or all merge.
    pub fn change_to(&self, edits: Vec<Edit>) -> Option<Prepared> {
        if edits.is_empty() {
            return None;
        }
        let mut model = Model::clone(&self.model);
        model.remesh(&edits).ok()?;
        let mut transfer = Transfer::new(&self.model, &model);
        transfer.fit_rests(&self.model, &mut model, &self.state, &self.fixed);
        let minimizer = Minimizer::new(&model, self.method);
        let price = self.settings.price.of(&model.grid) / self.settings.price.of(&self.model.grid);
        Some(Prepared {
            edits,
            change: None,
            model: Arc::new(model),
            minimizer,
            transfer,
            limit: f64::INFINITY,
            gain: f64::INFINITY,
            load: f64::INFINITY,
            refused: 0,
            follows: self.model.grid.epoch,
            price,
        })
    }

    /// How the cloth follows the hand, nearly statically.
    fn reach(&self) -> Option<Reach> {
        let mut minimizer = Minimizer::new(&self.model, self.method);
        let definite = linearize(&mut minimizer, &self.model, &self.state, &self.fixed, self.hand?);
        definite.then(|| Reach::new(&minimizer, &self.model.elements))
    }
}

/// What dead loads take from the hand's force as the cloth follows the hand in the solver's last factor, by particle [N].
pub fn held_back(minimizer: &Minimizer, model: &Model, loads: &[Vec3]) -> Vec<Vec3> {
    let mut change = vec![Vec3::zeros(); loads.len()];
    let system = &minimizer.system;
    if let Some(hand) = system.hand {
        for n in model.grid.active().filter(|&n| !system.fixed[n]) {
            change[n] = -minimizer.response[n].tr_mul(&loads[n]);
        }
        change[hand as usize] = loads[hand as usize];
    }
    change
}

/// Factors the exact Hessian, shifted as little as makes it definite; false when nothing does.
fn linearize(minimizer: &mut Minimizer, model: &Model, state: &State, fixed: &[bool], hand: u32) -> bool {
    let particles = model.grid.particles();
    minimizer.system.fixed[..particles].copy_from_slice(&fixed[..particles]);
    minimizer.system.hand = Some(hand);
    let (mut pull, candidates) = (Pull::none(model), Candidates::of(model, state));
    SHIFTS.iter().any(|&shift| {
        pull.set_shift(model, &state.positions, shift);
        let potential = Potential { model, state, candidates: &candidates, pull: &pull };
        minimizer.linearize(&potential, &state.positions)
    })
}

/// The edits that make the cells around a particle the finest.
pub fn to_finest(grid: &Grid, particle: usize) -> Vec<Edit> {
    let site = grid.site(particle);
    let mut trial = grid.clone();
    let mut edits = Vec::new();
    loop {
        let large: Vec<Cell> = trial.cells_at(site).filter(Cell::is_coarse).collect();
        if large.is_empty() {
            return edits;
        }
        edits.extend(trial.refine(large));
    }
}
