//! What the soft elements (bending, shear, twist) bring to the Hessian, kept while the cloth hardly moves and made anew beside the solve.
//!
//! The step's equation stays exact: only the matrix is that of a moment ago, so a Newton step errs by a little more to second order. Edges,
//! inertia and contact, which are stiff, never lag. What a step uses does not depend on whether a core was free.

use super::cores::{Beside, Work};
use crate::{
    batch::{Batches, Planes},
    fabric::Fabric,
    math::pack::{Arch, instructions, with_instructions},
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

/// The blocks of the soft elements, which may lag behind.
pub struct Soft {
    beside: Beside<Box<Made>>,
    /// Whether the blocks hold something, and which derivatives.
    holds: Option<Curvature>,
    reach: f64,
}

/// Blocks, and what they are made from.
struct Made {
    blocks: Vec<f64>,
    sums: Vec<Nine>,
    pattern: Arc<Pattern>,
    batches: Arc<Batches>,
    fabric: Arc<Fabric>,
    shape: Planes,
    history: History,
    kind: Curvature,
    instructions: Arch,
}

impl Soft {
    /// Memory for a model's mesh.
    pub fn new(model: &Model, pattern: &Arc<Pattern>) -> Soft {
        let made = Made {
            blocks: vec![0.0; 9 * pattern.stride],
            sums: no_sums(pattern),
            pattern: pattern.clone(),
            batches: model.batches.clone(),
            fabric: model.fabric.clone(),
            shape: Planes::new(model.elements.named.len()),
            history: History::default(),
            kind: Curvature::Exact,
            instructions: instructions(),
        };
        let mut soft = Soft { beside: Beside::new(Box::new(made)), holds: None, reach: reach(model) };
        soft.forget();
        soft
    }

    /// Forgets the blocks, and where the cloth was: a restored world goes on as it did the first time.
    pub fn forget(&mut self) {
        self.holds = None;
        let mut made = self.beside.take();
        made.shape.list.fill(f64::NAN);
        self.beside.put(made);
    }

    /// Brings the soft elements' blocks into the system, at its shape or, where nothing has gone far since, as they were; true if so.
    pub fn bring(&mut self, potential: &Potential, kind: Curvature, system: &mut System) -> bool {
        system.forget_hand();
        let mut made = self.beside.take();
        let way = made.shape.farthest(&system.shape);
        // Not a number is far.
        let is_near = way <= self.reach;
        let lags = is_near && self.holds == Some(kind);
        if lags && way > RENEWAL * self.reach {
            std::mem::swap(&mut system.blocks, &mut made.blocks);
            made.begin(potential, kind, &system.shape);
            self.beside.start(made);
            return true;
        }
        if !lags {
            made.begin(potential, kind, &system.shape);
            made.work();
            self.holds = is_near.then_some(kind);
        }
        if is_near {
            system.blocks.copy_from_slice(&made.blocks);
        } else {
            // Too fast to be kept.
            std::mem::swap(&mut system.blocks, &mut made.blocks);
        }
        self.beside.put(made);
        lags
    }
}

impl Made {
    fn begin(&mut self, potential: &Potential, kind: Curvature, shape: &Planes) {
        let (model, history) = (potential.model, &potential.state.history);
        (self.kind, self.instructions) = (kind, instructions());
        self.batches.clone_from(&model.batches);
        self.fabric.clone_from(&model.fabric);
        self.shape.list.copy_from_slice(&shape.list);
        self.history.triples.clone_from(&history.triples);
        self.history.shears.clone_from(&history.shears);
    }
}

impl Work for Box<Made> {
    fn work(&mut self) {
        let Made { blocks, sums, pattern, batches, fabric, shape, history, kind, instructions } = &mut **self;
        blocks.fill(0.0);
        let mut values = Values { entries: blocks, pattern, sums };
        with_instructions(*instructions, || {
            add_soft(Given { batches, fabric, history, x: shape }, *kind, &mut values);
        });
        values.add_sums();
    }
}

/// How far particles may go [m] before soft elements count as moved.
fn reach(model: &Model) -> f64 {
    let least = |k: usize| (REACH * model.bending_length(k)).min(OF_SIDE * model.grid.spacing(k));
    least(0).min(least(1))
}
