//! What the soft elements (bending, shear, twist) bring to the Hessian, kept while the cloth hardly changes its shape and made anew beside the
//! solve.
//!
//! The step's equation stays exact: only the matrix is that of a moment ago, so a Newton step errs by a little more to second order; and what
//! is as small as that error is left out of it (`kernels::lean`). Edges, inertia and contact, which are stiff, never lag. What a step uses does
//! not depend on whether a core was free.

use crate::{
    batch::{Batches, Planes},
    cores::{Team, Work},
    fabric::Fabric,
    math::pack::dispatch,
    model::Model,
    potential::{
        Curvature, Potential,
        ghosted::Nine,
        halves::call_for_assembly,
        kernels::{Given, edges::Turned},
        made::{Made, add_lean},
        pattern::{Pattern, no_sums},
        system::System,
        values::Values,
    },
    state::History,
};
use std::sync::Arc;

/// How far edges may have turned or stretched [1] since the soft elements were looked at. They see edges alone, so how far the cloth went as a
/// whole does not matter.
const REACH: f64 = 1.0 / 64.0;
/// Part of that where the shape is the middle of a step: it goes by velocities, and with blocks of another moment errors of theirs grow.
const REACH_OF_MIDDLE: f64 = 0.25;
/// Part of the former from which on they are looked at again: after every tick but those in which the cloth hardly moves.
const RENEWAL: f64 = 1.0 / 64.0;
/// Part of that from which on a batch's blocks are made anew then, where that goes batch by batch: on meshes of so many particles, of which
/// most hardly turn in a tick.
const STALE: f64 = 1.0 / 16.0;
const FEWEST: usize = 13_000;

/// What is known of the blocks of the soft elements, which may lag behind.
#[derive(Default)]
pub struct Soft {
    /// Whether the blocks hold something, and which derivatives.
    holds: Option<Curvature>,
}

/// The blocks, and what they are made from.
pub struct Blocks {
    entries: Vec<f64>,
    /// Of which shapes, once all of them were made and if they change batch by batch.
    made: Option<Made>,
    is_whole: bool,
    /// A copy of such for the next step, if there is one.
    ready: Vec<f64>,
    is_ready: bool,
    sums: Vec<Nine>,
    pattern: Arc<Pattern>,
    batches: Arc<Batches>,
    fabric: Arc<Fabric>,
    shape: Planes,
    history: History,
    rests: f64,
    kind: Curvature,
}

/// What became of the blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Brought {
    /// They are those of a moment ago.
    pub lag: bool,
    /// They are to be made anew.
    pub due: bool,
}

impl Soft {
    /// Brings the soft elements' blocks into the system, at its shape or, where that has changed little since and they may lag, as they
    /// were.
    pub fn bring(
        &mut self,
        blocks: &mut Blocks,
        potential: &Potential,
        kind: Curvature,
        system: &mut System,
        team: &Team,
    ) -> Brought {
        system.forget_hand();
        let shapes = [&blocks.shape, &system.shape];
        let way = dispatch(Turned { batches: &potential.model.batches, shapes });
        // No number tells how far the cloth went since a shape that is not known.
        let holds = self.holds == Some(kind) && !way.is_nan();
        let reach = if system.is_middle { REACH_OF_MIDDLE * REACH } else { REACH };
        let lag = holds && way <= reach;
        if !lag {
            call_for_assembly(team, blocks.pattern.order.len());
            blocks.begin(potential, kind, &system.shape);
            blocks.is_whole &= holds;
            blocks.renew(REACH, team);
            // What is too fast as a whole is not kept.
            let is_kept = blocks.made.is_some() || way <= reach || way.is_nan();
            self.holds = is_kept.then_some(kind);
        }
        let due = holds && self.holds.is_some() && way > RENEWAL * REACH;
        blocks.hand_over(&mut system.blocks, due || self.holds.is_none(), team);
        if due {
            blocks.begin(potential, kind, &system.shape);
        }
        Brought { lag, due }
    }

    /// Says that the blocks of a shape will be made before they are brought.
    pub fn begin(&mut self, blocks: &mut Blocks, potential: &Potential, kind: Curvature, shape: &Planes) {
        blocks.begin(potential, kind, shape);
        self.holds = Some(kind);
    }

    /// Forgets the blocks, and where the cloth was: a restored world goes on as it did the first time.
    pub fn forget(&mut self, blocks: &mut Blocks) {
        self.holds = None;
        (blocks.is_whole, blocks.is_ready) = (false, false);
        blocks.shape.list.fill(f64::NAN);
    }
}

impl Blocks {
    /// Memory for a model's mesh.
    pub fn new(model: &Model, pattern: &Arc<Pattern>) -> Blocks {
        let blocks = Blocks::made_as_a_whole(model, pattern);
        if pattern.order.len() < FEWEST { blocks } else { blocks.by_batches() }
    }

    /// Those that change batch by batch.
    pub fn by_batches(self) -> Blocks {
        let made = Some(Made::new(&self.pattern, &self.batches));
        Blocks { made, ready: self.entries.clone(), ..self }
    }

    /// Whether they change batch by batch.
    pub fn change_by_batches(&self) -> bool {
        self.made.is_some()
    }

    fn made_as_a_whole(model: &Model, pattern: &Arc<Pattern>) -> Blocks {
        let mut shape = Planes::new(model.elements.named.len());
        shape.list.fill(f64::NAN);
        Blocks {
            entries: vec![0.0; 9 * pattern.lines.stride],
            made: None,
            is_whole: false,
            ready: Vec::new(),
            is_ready: false,
            sums: no_sums(pattern),
            pattern: pattern.clone(),
            batches: model.batches.clone(),
            fabric: model.fabric.clone(),
            shape,
            history: History::default(),
            rests: 0.0,
            kind: Curvature::Exact,
        }
    }

    /// Takes over what they are to be made from.
    fn begin(&mut self, potential: &Potential, kind: Curvature, shape: &Planes) {
        let (model, history) = (potential.model, &potential.state.history);
        let is_same = self.kind == kind
            && self.rests == potential.state.rests
            && Arc::ptr_eq(&self.batches, &model.batches)
            && Arc::ptr_eq(&self.fabric, &model.fabric);
        self.is_whole &= is_same;
        self.is_ready = false;
        (self.kind, self.rests) = (kind, potential.state.rests);
        self.batches.clone_from(&model.batches);
        self.fabric.clone_from(&model.fabric);
        self.shape.list.copy_from_slice(&shape.list);
        self.history.triples.clone_from(&history.triples);
        self.history.shears.clone_from(&history.shears);
    }

    /// Makes those anew whose edges have turned or stretched farther than that: all of them where nothing is known, something has collapsed
    /// or most have.
    fn renew(&mut self, reach: f64, team: &Team) {
        let Blocks {
            entries,
            made,
            is_whole,
            sums,
            pattern,
            batches,
            fabric,
            shape,
            history,
            rests,
            kind,
            ..
        } = self;
        let given = Given { batches, fabric, history, rests: *rests, x: shape };
        let known = made.as_mut().filter(|_| *is_whole);
        let looked = known.map(|made| made.look(given, pattern, reach, team));
        let is_anew = looked.is_none_or(|looked| looked.is_beyond || 2 * looked.due > looked.all);
        if is_anew {
            let middle = entries.len() / 2;
            let (low, high) = entries.split_at_mut(middle);
            team.both(|| low.fill(0.0), || high.fill(0.0));
        }
        let mut values = Values::new(entries, pattern, sums);
        match made {
            Some(made) => made.add(given, *kind, &mut values, is_anew, team),
            None => add_lean(given, *kind, &mut values, team),
        }
        values.add_sums();
        *is_whole = true;
    }

    /// Puts them into a system; they need not stay if they are made as a whole and will be made anew.
    fn hand_over(&mut self, to: &mut Vec<f64>, may_go: bool, team: &Team) {
        if std::mem::take(&mut self.is_ready) {
            std::mem::swap(to, &mut self.ready);
        } else if may_go && self.made.is_none() {
            std::mem::swap(to, &mut self.entries);
        } else {
            let middle = to.len() / 2;
            let ((low, high), (from, rest)) = (to.split_at_mut(middle), self.entries.split_at(middle));
            team.both(|| low.copy_from_slice(from), || high.copy_from_slice(rest));
        }
    }
}

impl Work for Blocks {
    fn work(&mut self) {
        self.renew(STALE * REACH, Team::nobody());
        if self.made.is_some() {
            self.ready.copy_from_slice(&self.entries);
            self.is_ready = true;
        }
    }
}
