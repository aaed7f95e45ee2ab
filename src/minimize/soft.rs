//! What the soft elements (bending, shear, twist) bring to the Hessian, kept while the cloth hardly changes its shape and made anew beside the
//! solve.
//!
//! The step's equation stays exact: only the matrix is that of a moment ago, so a Newton step errs by a little more to second order. Edges,
//! inertia and contact, which are stiff, never lag. What a step uses does not depend on whether a core was free.

use crate::{
    batch::{Batches, Planes},
    cores::{Team, Work},
    fabric::Fabric,
    math::pack::dispatch,
    model::Model,
    potential::{
        Curvature, Potential, add_soft,
        ghosted::Nine,
        kernels::{Given, edges::Turned},
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
/// Part of that from which on they are looked at again: after every tick but those in which the cloth hardly moves.
const RENEWAL: f64 = 1.0 / 64.0;

/// What is known of the blocks of the soft elements, which may lag behind.
#[derive(Default)]
pub struct Soft {
    /// Whether the blocks hold something, and which derivatives.
    holds: Option<Curvature>,
}

/// The blocks, and what they are made from.
pub struct Blocks {
    entries: Vec<f64>,
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
        may_lag: bool,
        system: &mut System,
        team: &Team,
    ) -> Brought {
        system.forget_hand();
        let shapes = [&blocks.shape, &system.shape];
        let way = dispatch(Turned { batches: &potential.model.batches, shapes });
        // No number tells how far the cloth went since a shape that is not known.
        let is_near = may_lag && (way <= REACH || way.is_nan());
        let lag = is_near && self.holds == Some(kind);
        let due = lag && way > RENEWAL * REACH;
        if !lag {
            blocks.begin(potential, kind, &system.shape);
            blocks.make(team);
            self.holds = is_near.then_some(kind);
        }
        if due || !is_near {
            // They will be made anew, or are too fast to be kept.
            std::mem::swap(&mut system.blocks, &mut blocks.entries);
        } else {
            system.blocks.copy_from_slice(&blocks.entries);
        }
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
        blocks.shape.list.fill(f64::NAN);
    }
}

impl Blocks {
    /// Memory for a model's mesh.
    pub fn new(model: &Model, pattern: &Arc<Pattern>) -> Blocks {
        let mut shape = Planes::new(model.elements.named.len());
        shape.list.fill(f64::NAN);
        Blocks {
            entries: vec![0.0; 9 * pattern.lines.stride],
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

    fn begin(&mut self, potential: &Potential, kind: Curvature, shape: &Planes) {
        let (model, history) = (potential.model, &potential.state.history);
        (self.kind, self.rests) = (kind, potential.state.rests);
        self.batches.clone_from(&model.batches);
        self.fabric.clone_from(&model.fabric);
        self.shape.list.copy_from_slice(&shape.list);
        self.history.triples.clone_from(&history.triples);
        self.history.shears.clone_from(&history.shears);
    }
}

impl Blocks {
    /// Makes them, in halves.
    fn make(&mut self, team: &Team) {
        let Blocks { entries, sums, pattern, batches, fabric, shape, history, rests, kind } = self;
        let middle = entries.len() / 2;
        let (low, high) = entries.split_at_mut(middle);
        team.both(|| low.fill(0.0), || high.fill(0.0));
        let mut values = Values::new(entries, pattern, sums);
        add_soft(Given { batches, fabric, history, rests: *rests, x: shape }, *kind, &mut values, team);
        values.add_sums();
    }
}

impl Work for Blocks {
    fn work(&mut self) {
        self.make(Team::nobody());
    }
}
