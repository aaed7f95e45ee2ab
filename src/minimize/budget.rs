//! How much a minimization may cost, and when it is good enough.

use crate::phase::Watch;

/// How much a minimization may cost, and when it is good enough.
#[derive(Clone, Copy)]
pub struct Budget<'a> {
    /// Linear solves at the most.
    pub solves: u32,
    /// Linear solves after which `stop` is asked.
    pub least: u32,
    /// Residual, relative to the weight of a mean particle, at which a live step has converged.
    pub residual: f64,
    /// Asked between solves; `true` ends the minimization. The caller owns the clock.
    pub stop: Option<&'a dyn Fn() -> bool>,
    /// Who is told when a phase ends.
    pub watch: Watch<'a>,
}

/// Residual that a hand does not feel.
const FELT: f64 = 1e-3;

impl Budget<'_> {
    /// So many solves, however long they take, until nothing is left that a hand feels.
    pub const fn solves(solves: u32) -> Budget<'static> {
        Budget { solves, least: solves, residual: FELT, stop: None, watch: Watch(None) }
    }

    pub(super) fn is_spent(&self, solves: u32) -> bool {
        solves >= self.solves || solves >= self.least && self.is_late()
    }

    pub(super) fn is_late(&self) -> bool {
        self.stop.is_some_and(|stop| stop())
    }
}
