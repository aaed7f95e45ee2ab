//! What the soft elements (bending, shear, twist) bring to the Hessian, kept while the cloth hardly moves and made anew beside the solve.
//!
//! The step's equation stays exact: only the matrix is that of a moment ago, so a Newton step errs by a little more to second order. Edges,
//! inertia and contact, which are stiff, never lag. What a step uses does not depend on whether a core was free.

use super::cores::Work;
use crate::{
    batch::{Batches, Planes},
    fabric::Fabric,
    model::Model,
    potential::{
        Curvature, Potential, add_soft,
        ghosted::Nine,
        kernels::Given,
        pattern::{Pattern, no_sums},
        system::{System, Values},
    },
    state::History,
};
use std::sync::Arc;

/// How far a particle may have gone from where the soft elements were looked at, over the bending length (a quarter of a millimetre for
/// denim), and over the shortest side of a cell. With twice as much single solves on the drape end in trouble.
const REACH: f64 = 1.0 / 64.0;
const OF_SIDE: f64 = 1.0 / 16.0;
/// Part of that from which on they are looked at again.
const RENEWAL: f64 = 0.25;

/// What is known of the blocks of the soft elements, which may lag behind.
pub struct Soft {
    /// Whether the blocks hold something, and which derivatives.
    holds: Option<Curvature>,
    reach: f64,
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
    /// Nothing known of the blocks of a model's mesh.
    pub fn new(model: &Model) -> Soft {
        Soft { holds: None, reach: reach(model) }
    }

    /// Brings the soft elements' blocks into the system, at its shape or, where nothing has gone far since, as they were.
    pub fn bring(
        &mut self,
        blocks: &mut Blocks,
        potential: &Potential,
        kind: Curvature,
        system: &mut System,
    ) -> Brought {
        system.forget_hand();
        let way = blocks.shape.farthest(&system.shape);
        // Not a number is far.
        let is_near = way <= self.reach;
        let lag = is_near && self.holds == Some(kind);
        let due = lag && way > RENEWAL * self.reach;
        if !lag {
            blocks.begin(potential, kind, &system.shape);
            blocks.work();
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
            kind: Curvature::Exact,
        }
    }

    fn begin(&mut self, potential: &Potential, kind: Curvature, shape: &Planes) {
        let (model, history) = (potential.model, &potential.state.history);
        self.kind = kind;
        self.batches.clone_from(&model.batches);
        self.fabric.clone_from(&model.fabric);
        self.shape.list.copy_from_slice(&shape.list);
        self.history.triples.clone_from(&history.triples);
        self.history.shears.clone_from(&history.shears);
    }
}

impl Work for Blocks {
    fn work(&mut self) {
        let Blocks { entries, sums, pattern, batches, fabric, shape, history, kind } = self;
        entries.fill(0.0);
        let mut values = Values { entries, pattern, sums };
        add_soft(Given { batches, fabric, history, x: shape }, *kind, &mut values);
        values.add_sums();
    }
}

/// How far particles may go [m] before soft elements count as moved.
fn reach(model: &Model) -> f64 {
    let least = |k: usize| (REACH * model.bending_length(k)).min(OF_SIDE * model.grid.spacing(k));
    least(0).min(least(1))
}
