//! How fine each place of a state wants to be, as scores of cells: above 1 a cell is too large, far below 1 four could be one.

use super::{Criterion, Probe, Settings};
use crate::{
    grid::{Cell, Direction, Grid},
    hand::Reach,
    math::{Mat3, Vec3},
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, shear, triple},
    state::State,
};
use std::f64::consts::PI;

/// Score below which cells merge along a direction.
pub const MERGE: f64 = 0.5;
/// Score that one merged along the other direction may have in this one.
pub const KEEP: f64 = 0.8;
/// Depth of a cell's side in an obstacle that calls for smaller cells, over the gap at which contact begins.
const DEPTH: f64 = 0.5;
/// The same of how much nearer particles come to an obstacle, where barriers are stiff.
const NEARER: f64 = 0.02;
/// Time by which the shape is looked at in advance [s]: folds that come are met by fine cells.
const AHEAD: f64 = 0.05;
/// Force-sensitivity never allows a cell to turn by more than this [rad].
const CAP: f64 = 0.4;

/// Scores of a state, by particle.
pub struct Scores<'a> {
    model: &'a Model,
    state: &'a State,
    settings: &'a Settings,
    fixed: Vec<[usize; 2]>,
    /// Score along each direction over the cell's size there, guarded by a ring.
    by_size: [Vec<f64>; 2],
    /// Score whatever the size, guarded too.
    flat: [Vec<f64>; 2],
    /// Tension along each direction [N/m], the mean of the edges there; `None` without any.
    tension: [Vec<Option<f64>>; 2],
    /// Bending rigidity along each direction [N·m].
    rigidity: [f64; 2],
    /// The hand's force over the sheet's shorter side [N/m].
    pull: f64,
}

impl<'a> Scores<'a> {
    /// Scores of a state; `reach` is how the cloth follows the hand, for force sensitivity.
    pub fn new(probe: &'a Probe, reach: Option<&Reach>) -> Scores<'a> {
        let Probe { model, state, settings, fixed, force, .. } = probe;
        let grid = &model.grid;
        let none = vec![0.0; grid.particles()];
        let mut scores = Scores {
            model,
            state,
            settings,
            fixed: (0..grid.particles()).filter(|&n| fixed[n]).map(|n| grid.site(n)).collect(),
            by_size: [none.clone(), none.clone()],
            flat: [none.clone(), none],
            tension: [vec![None; grid.particles()], vec![None; grid.particles()]],
            rigidity: [0, 1].map(|d| model.fabric.rigidity(d).max(1e-12)),
            pull: model.felt_scale(force.norm()) / grid.size[0].min(grid.size[1]),
        };
        scores.measure(reach);
        scores
    }

    fn measure(&mut self, reach: Option<&Reach>) {
        let (model, state, settings) = (self.model, self.state, self.settings);
        let (grid, elements, fabric) = (&model.grid, &model.elements, &model.fabric);
        let pull = Pull::default();
        let potential = Potential { model, state, candidates: &Candidates::default(), pull: &pull };
        let x = &state.positions;
        let ahead: Vec<Vec3> = x.iter().zip(&state.velocities).map(|(x, v)| x + v * AHEAD).collect();
        let raise = |field: &mut f64, value: f64| *field = field.max(value);
        let weight = fabric.areal_density * model.gravity.max(1.0);
        for (k, t) in elements.triples.iter().enumerate() {
            let weights = triple::Weights::new(t);
            let kappa = potential.bend(t, &weights, x).value;
            let soon = potential.bend(t, &weights, &ahead).value;
            // As it is bent, from whatever it measures.
            let rest = state.rests * t.rest;
            let turn = (kappa + rest).abs().max((soon + rest).abs()) * grid.spacing(t.direction);
            let n = t.site as usize;
            match settings.criterion {
                Criterion::BendingAngle => raise(&mut self.by_size[t.direction][n], turn / settings.angle),
                Criterion::ForceSensitivity => raise(&mut self.by_size[t.direction][n], turn / CAP),
                Criterion::BendingCost | Criterion::BendingStretchingCost => {
                    let law = &fabric.bending[t.direction];
                    let moment = law.evaluate(kappa, state.history.triples[k]).force;
                    let unit = weight * model.bending_length(t.direction).powi(2);
                    raise(&mut self.flat[t.direction][n], (moment / unit).abs() / settings.cost.sqrt());
                }
            }
        }
        for (k, e) in elements.edges.iter().enumerate() {
            let strain = potential.strain(e, x).value;
            let tension = fabric.tensile[e.direction].evaluate(strain, state.history.edges[k]).force;
            for n in e.nodes {
                // The first and the last edge of a line count twice there, the others half each.
                let known = &mut self.tension[e.direction][n as usize];
                *known = Some(known.map_or(tension, |other| 0.5 * (other + tension)));
                if settings.criterion == Criterion::BendingStretchingCost {
                    raise(
                        &mut self.flat[e.direction][n as usize],
                        (strain / 0.01).abs() / settings.cost.sqrt(),
                    );
                }
            }
        }
        if let (Criterion::ForceSensitivity, Some(reach)) = (settings.criterion, reach) {
            self.measure_sensitivity(&potential, reach);
        }
    }

    /// Energy of the cloth's response to a unit displacement of the hand, by place: what the force depends on.
    fn measure_sensitivity(&mut self, potential: &Potential, reach: &Reach) {
        let (model, state) = (self.model, self.state);
        let (grid, elements, fabric) = (&model.grid, &model.elements, &model.fabric);
        let x = &state.positions;
        let mut density = vec![0.0; grid.particles()];
        let along = |gradient: &Vec3, response: Mat3| response.tr_mul(gradient);
        let at = |n: u32| reach.response(n as usize);
        for (k, e) in elements.edges.iter().enumerate() {
            let strain = potential.strain(e, x);
            let stiffness =
                fabric.tensile[e.direction].evaluate(strain.value, state.history.edges[k]).stiffness;
            let change = along(&strain.gradient, at(e.nodes[1]) - at(e.nodes[0])).norm_squared();
            e.nodes.iter().for_each(|n| density[*n as usize] += 0.25 * stiffness * change);
        }
        for (k, t) in elements.triples.iter().enumerate() {
            let weights = triple::Weights::new(t);
            let kappa = potential.bend(t, &weights, x);
            let stiffness =
                fabric.bending[t.direction].evaluate(kappa.value, state.history.triples[k]).stiffness;
            let spread = weights.spread(&kappa.gradient);
            let change: Vec3 = t.nodes.iter().zip(&spread).map(|(n, g)| along(g, at(*n))).sum();
            density[t.site as usize] += 0.5 * stiffness * change.norm_squared();
        }
        for (k, s) in elements.shears.iter().enumerate() {
            let weights = shear::Weights::new(s);
            let phi = potential.angle(s, &weights, x);
            let stiffness = fabric.shear.evaluate(phi.value, state.history.shears[k]).stiffness;
            let spread = weights.spread(&phi.gradient);
            let change: Vec3 = s.nodes.iter().zip(&spread).map(|(n, g)| along(g, at(*n))).sum();
            s.nodes.iter().for_each(|n| density[*n as usize] += 0.125 * stiffness * change.norm_squared());
        }
        // The energy of a block falls with the square of its size, as does what merging it may change.
        let total: f64 = grid.active().map(|n| density[n] * elements.areas[n]).sum();
        let mean = total / model.area;
        for n in grid.active() {
            let score = (density[n] / mean.max(f64::MIN_POSITIVE)).sqrt() / self.settings.sensitivity;
            self.by_size.iter_mut().for_each(|scores| scores[n] = scores[n].max(score));
        }
    }

    /// The scores along warp and weft of a cell that is, or of one that others would make.
    pub fn of(&self, cell: &Cell) -> [f64; 2] {
        self.up_to(cell, [f64::INFINITY; 2])
    }

    /// The same; obstacles, which take the most time, are only looked at where all else is below these limits.
    pub fn up_to(&self, cell: &Cell, limits: [f64; 2]) -> [f64; 2] {
        if self.is_guarded(cell) {
            return [f64::INFINITY; 2];
        }
        let scores = self.of_shape(cell);
        if (0..2).any(|k| scores[k] >= limits[k]) {
            return scores;
        }
        let pressed = self.depth(cell).max(self.pressing(cell));
        scores.map(|score| score.max(pressed))
    }

    /// What a cell's turn, compression and tension say, with the ring around it, one cell of its size wide.
    fn of_shape(&self, cell: &Cell) -> [f64; 2] {
        let grid = &self.model.grid;
        let [i, j] = [0, 1].map(|k| {
            cell.corner[k].saturating_sub(cell.size[k])
                ..=(cell.end()[k] + cell.size[k]).min(grid.counts[k] - 1)
        });
        let mut scores = [0, 1].map(|d| self.buckling(cell, d).max(self.unevenness(cell, d)));
        for n in i.flat_map(|i| j.clone().map(move |j| grid.index([i, j]))) {
            for (d, score) in scores.iter_mut().enumerate() {
                *score = score.max(self.by_size[d][n] * cell.size[d] as f64).max(self.flat[d][n]);
            }
        }
        scores
    }

    /// Whether a half wave of two cells could buckle, at B (π / 2 size)², as a score.
    fn buckling(&self, cell: &Cell, d: Direction) -> f64 {
        let grid = &self.model.grid;
        let tensions: Vec<f64> = sites(grid, cell).filter_map(|n| self.tension[d][n]).collect();
        let mean = tensions.iter().sum::<f64>() / tensions.len().max(1) as f64;
        let size = grid.spacing(d) * cell.size[d] as f64;
        2.0 * size / PI * (-mean / self.rigidity[d]).max(0.0).sqrt() * MERGE / self.settings.buckling
    }

    /// How much tension differs between the ends of a cell's sides, as a score: each side knows one tension.
    fn unevenness(&self, cell: &Cell, d: Direction) -> f64 {
        let corners = self.model.grid.corners(cell).map(|n| n as usize);
        let sides = if d == 0 { [[0, 1], [2, 3]] } else { [[0, 2], [1, 3]] };
        let mut most: f64 = 0.0;
        for tension in &self.tension {
            for [a, b] in sides.map(|side| side.map(|corner| tension[corners[corner]])) {
                most = a.zip(b).map_or(most, |(a, b)| most.max((a - b).abs()));
            }
        }
        most / (self.settings.tension * self.pull)
    }

    /// Cells within the rings around a fixed particle stay fine.
    fn is_guarded(&self, cell: &Cell) -> bool {
        let rings = self.settings.rings;
        let near = |k: usize, at: usize| cell.corner[k] < at + rings && at < cell.end()[k] + rings;
        self.fixed.iter().any(|site| (0..2).all(|k| near(k, site[k])))
    }

    /// How deep the sides and diagonals of a cell would cut into obstacles, as a score.
    fn depth(&self, cell: &Cell) -> f64 {
        let model = self.model;
        let corners = model.grid.corners(cell).map(|n| self.state.positions[n as usize]);
        let limit = DEPTH * model.contact.barrier.activation;
        let mut deepest: f64 = 0.0;
        for (obstacle, pose) in model.obstacles.iter().zip(&self.state.poses) {
            let gaps = corners.map(|p| obstacle.distance_at(pose, p));
            for (a, b) in [(0, 1), (0, 2), (1, 3), (2, 3), (0, 3), (1, 2)] {
                if gaps[a] + gaps[b] < (corners[a] - corners[b]).norm() {
                    deepest = deepest.max(obstacle.depth(pose, corners[a], corners[b]));
                }
            }
        }
        deepest / limit
    }

    /// How much nearer to obstacles, within reach of contact, particles would come that a cell stands for, as a score.
    fn pressing(&self, cell: &Cell) -> f64 {
        let (model, x) = (self.model, &self.state.positions);
        let (grid, reach) = (&model.grid, model.contact.barrier.activation);
        let corners = grid.corners(cell);
        let [a, b, c, d] = corners.map(|n| x[n as usize]);
        let diagonal = (d - a).norm().max((c - b).norm());
        let merged = || sites(grid, cell).filter(|&n| grid.is_active(n) && !corners.contains(&(n as u32)));
        let flat = |n: usize| {
            let [u, v] = [0, 1].map(|k| (grid.site(n)[k] - cell.corner[k]) as f64 / cell.size[k] as f64);
            (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v
        };
        let mut most: f64 = 0.0;
        for (obstacle, pose) in model.obstacles.iter().zip(&self.state.poses) {
            if obstacle.distance_at(pose, a) > diagonal + reach {
                continue;
            }
            for n in merged() {
                let [was, is] = [x[n], flat(n)].map(|p| obstacle.distance_at(pose, p).min(reach));
                most = most.max(was - is);
            }
        }
        most / (NEARER * reach)
    }
}

/// The particles in and on a cell.
pub fn sites<'a>(grid: &'a Grid, cell: &Cell) -> impl Iterator<Item = usize> + 'a {
    let ([i, j], [last_i, last_j]) = (cell.corner, cell.end());
    (i..=last_i).flat_map(move |a| (j..=last_j).map(move |b| grid.index([a, b])))
}
