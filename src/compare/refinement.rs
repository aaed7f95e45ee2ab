//! Refinement as others do it: cells are split where a sign at their particles passes a threshold, and never merged again.

use crate::{
    grid::{Cell, Edit, Grid},
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, triple},
    state::State,
};

/// What calls for smaller cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// The paper's: the bending moment over the one that weight raises over a bending length, squared.
    BendingCost,
    /// The paper's: that, or the strain over one percent, squared.
    BendingStretchingCost,
    /// The angle between neighbouring edges [rad] (Hutchinson).
    Angle,
    /// The curvatures of both beams through a particle, together [1/m], whatever the cells' size (Villard).
    Curvature,
    /// One over the distance from an obstacle in sides of the cell: particles wait inactive until then.
    NearObstacle,
}

/// A rule of refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refinement {
    /// What is looked at.
    pub sign: Sign,
    /// Value above which a cell is split, in the sign's unit.
    pub threshold: f64,
}

impl Refinement {
    /// The edits that split all cells whose sign passes the threshold, and the larger neighbours that stand in the way.
    pub fn edits(&self, model: &Model, state: &State) -> Vec<Edit> {
        let signs = self.measure(model, state);
        let grid = &model.grid;
        let passes = |n: u32| signs[n as usize] > self.threshold;
        let large = grid.cells().iter().filter(|c| c.is_coarse());
        let split: Vec<_> = large.filter(|c| grid.corners(c).iter().any(|&n| passes(n))).copied().collect();
        grid.clone().refine(split)
    }

    /// The sign at every active particle.
    fn measure(&self, model: &Model, state: &State) -> Vec<f64> {
        let (grid, elements, fabric) = (&model.grid, &model.elements, &model.fabric);
        let pull = Pull::default();
        let candidates = Candidates::default();
        let potential = Potential { model, state, candidates: &candidates, pull: &pull };
        let x = &state.positions;
        let mut signs = vec![0.0_f64; elements.nodes()];
        if self.sign == Sign::NearObstacle {
            for cell in grid.cells() {
                let side = grid.spacing(0).max(grid.spacing(1)) * cell.size[0].max(cell.size[1]) as f64;
                for n in grid.corners(cell).map(|n| n as usize) {
                    let gap = gap(model, x[n]).max(1e-3 * side);
                    signs[n] = signs[n].max(side / gap);
                }
            }
            return signs;
        }
        let weight = fabric.areal_density * model.gravity.max(1.0);
        for (k, t) in elements.triples.iter().enumerate() {
            let kappa = potential.bend(t, &triple::Weights::new(t), x).value;
            let sign = &mut signs[t.site as usize];
            match self.sign {
                Sign::Angle => *sign = sign.max(kappa.abs() * 0.5 * (t.lengths[0] + t.lengths[1])),
                Sign::Curvature => *sign = sign.hypot(kappa),
                _ => {
                    let moment = fabric.bending[t.direction].evaluate(kappa, state.history.triples[k]).force;
                    let unit = weight * model.bending_length(t.direction).powi(2);
                    *sign = sign.max((moment / unit).powi(2));
                }
            }
        }
        if self.sign == Sign::BendingStretchingCost {
            for e in &elements.edges {
                let cost = (potential.strain(e, x).value / 0.01).powi(2);
                e.nodes.iter().for_each(|&n| signs[n as usize] = signs[n as usize].max(cost));
            }
        }
        signs
    }
}

fn gap(model: &Model, x: Vec3) -> f64 {
    model.obstacles.iter().map(|o| o.gap(x).value).fold(f64::INFINITY, f64::min)
}

/// The edits that merge all cells of a mesh up to a size, for a coarse start.
pub fn coarsened(grid: &Grid, size: usize) -> Vec<Edit> {
    let mut edits = Vec::new();
    let mut mesh = grid.clone();
    let mut next = 2;
    while next <= size {
        let parents =
            mesh.cells().iter().filter(|c| c.size == [next / 2; 2] && c.corner.iter().all(|k| k % next == 0));
        let wishes: Vec<_> = parents.map(|c| Edit::Coarsen(Cell::square(c.corner, next))).collect();
        edits.extend(mesh.edit_what_fits(wishes));
        next *= 2;
    }
    edits
}
