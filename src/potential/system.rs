//! The linear system of a Newton step: assembly, and which particles are fixed.
//!
//! The pattern belongs to a mesh; fixed particles keep their rows as identity, so pinning and grabbing never change it.

use super::{
    ghosted::Nine,
    pattern::{PADDING, Pattern, no_sums},
    product::{Apply, Weigh},
    values::Values,
};
use crate::{
    batch::Planes,
    cores::Team,
    math::{Mat3, Vec3, pack::dispatch},
};
use std::{ops::Range, sync::Arc};

/// A Hessian and a right-hand side, with fixed particles and the hand's coupling kept apart.
pub struct System {
    /// Pattern of the mesh.
    pub pattern: Arc<Pattern>,
    /// Blocks of the pairs, plane by plane; of the diagonals what is on and below them.
    pub blocks: Vec<f64>,
    /// Memory for what elements that name ghosts add.
    sums: Vec<Nine>,
    /// Values of the lower triangle, in elimination order: those of the blocks at the last `compress`.
    pub values: Vec<f64>,
    /// Gradient, plus what fixed particles' prescribed displacements add [N].
    pub rhs: Vec<Vec3>,
    /// Particles without degrees of freedom.
    pub fixed: Vec<bool>,
    /// Prescribed displacement of fixed particles in this step [m], and which of them are displaced.
    shift: Vec<Vec3>,
    displaced: Vec<u32>,
    /// The hand's particle, if any; it is fixed.
    pub hand: Option<u32>,
    /// Columns that couple each particle to the hand [N/m]; zero but for the particles that are coupled.
    pub coupling: Vec<Mat3>,
    /// Free particles that are coupled to the hand.
    pub coupled: Vec<u32>,
    /// The hand's own block [N/m].
    pub handle: Mat3,
    /// Whether the shape is that of the middle of a step, whose right-hand side is that of its beginning.
    pub(crate) is_middle: bool,
    /// The shape it was assembled at [m], and what linearized tensions exceed the true ones [N], zero but while they are added.
    pub(crate) shape: Planes,
    pub(crate) excess: Planes,
}

impl System {
    /// An empty system over a pattern.
    pub fn new(pattern: Arc<Pattern>) -> System {
        let n = pattern.rank.len();
        System {
            blocks: vec![0.0; 9 * pattern.lines.stride],
            sums: no_sums(&pattern),
            values: vec![0.0; pattern.rows.len()],
            rhs: vec![Vec3::zeros(); n],
            fixed: vec![false; n],
            shift: vec![Vec3::zeros(); n],
            displaced: Vec::new(),
            hand: None,
            coupling: vec![Mat3::zeros(); n],
            coupled: Vec::new(),
            handle: Mat3::zeros(),
            shape: Planes::new(pattern.named),
            is_middle: false,
            excess: Planes::new(pattern.named),
            pattern,
        }
    }

    /// The shape to assemble at: positions of the nodes that elements name [m].
    pub fn set_shape(&mut self, x: &[Vec3], named: &[u32]) {
        self.shape.set(x, named);
        self.is_middle = false;
    }

    /// The shape to assemble at: half way [m] from these positions.
    pub fn set_middle(&mut self, x: &[Vec3], way: &[Vec3], named: &[u32]) {
        self.shape.set_from(named, |n| x[n] + way[n] * 0.5);
        self.is_middle = true;
    }

    /// Empties the matrix.
    pub fn clear(&mut self) {
        self.blocks.fill(0.0);
        self.forget_hand();
    }

    /// Lets fixed particles stay where they are.
    pub fn prescribe_nothing(&mut self) {
        self.displaced.drain(..).for_each(|n| self.shift[n as usize] = Vec3::zeros());
    }

    /// Prescribes a fixed particle's displacement [m].
    pub fn prescribe(&mut self, particle: usize, displacement: Vec3) {
        self.shift[particle] = displacement;
        if !self.displaced.contains(&(particle as u32)) {
            self.displaced.push(particle as u32);
        }
    }

    /// A fixed particle's prescribed displacement [m].
    pub fn shift(&self, particle: usize) -> Vec3 {
        self.shift[particle]
    }

    /// Those that are prescribed and not zero.
    pub fn shifts(&self) -> impl Iterator<Item = (u32, Vec3)> {
        let all = self.displaced.iter().map(|&n| (n, self.shift[n as usize]));
        all.filter(|(_, shift)| *shift != Vec3::zeros())
    }

    /// Forgets what couples to the hand.
    pub fn forget_hand(&mut self) {
        self.coupled.drain(..).for_each(|n| self.coupling[n as usize] = Mat3::zeros());
        self.handle = Mat3::zeros();
    }

    /// The blocks, to add to, the shape and what linearized tensions exceed the true ones.
    pub(super) fn parts(&mut self) -> (Values<'_>, &Planes, &mut Planes) {
        let System { blocks, pattern, sums, shape, excess, .. } = self;
        (Values::new(blocks, pattern, sums), shape, excess)
    }

    /// Brings the blocks into the lower triangle, as direct factors want it.
    pub fn compress(&mut self) {
        for (value, &source) in self.values.iter_mut().zip(&self.pattern.sources) {
            *value = self.blocks[source as usize];
        }
    }

    /// The diagonal block at a place of the pattern's order [N/m].
    pub fn diagonal(&self, place: usize) -> Mat3 {
        Mat3::from_row_slice(&self.pattern.diagonal_entries(place).map(|at| self.blocks[at as usize]))
    }

    /// Takes the fixed particles out once all is added: what their prescribed displacements pull goes to the right-hand side, the
    /// hand's columns to `coupling`, and their rows become the identity.
    pub fn close(&mut self) {
        let pattern = &self.pattern;
        for (place, f) in pattern.order.iter().map(|&n| n as usize).enumerate() {
            if !self.fixed[f] {
                continue;
            }
            let (is_hand, shift) = (self.hand == Some(f as u32), self.shift[f]);
            for &(n, slot) in pattern.neighbours(place) {
                let entries = slot.entries(pattern.lines.stride).map(|at| at as usize);
                if !self.fixed[n as usize] {
                    let block = Mat3::from_fn(|row, column| self.blocks[entries[3 * row + column]]);
                    self.rhs[n as usize] += block * shift;
                    if is_hand {
                        self.coupling[n as usize] += block;
                        self.coupled.push(n);
                    }
                }
                entries.iter().for_each(|&at| self.blocks[at] = 0.0);
            }
            if is_hand {
                self.handle = self.diagonal(place);
            }
            for (k, at) in pattern.diagonal_entries(place).into_iter().enumerate() {
                self.blocks[at as usize] = if k % 4 == 0 { 1.0 } else { 0.0 };
            }
        }
    }

    /// H_hh − H_hi X [N/m]: what the hand feels of a system that follows it by X, per particle.
    pub fn condensed(&self, response: &[Mat3]) -> Mat3 {
        let follow = |n: usize| self.coupling[n].tr_mul(&response[n]);
        self.handle - self.coupled.iter().map(|&n| follow(n as usize)).sum::<Mat3>()
    }

    /// Makes every diagonal entry larger by a part of itself: enough of it makes up for rounding in a factor, wherever the entries are
    /// large.
    pub fn stiffen(&mut self, part: f64) {
        for k in [0, 4, 8] {
            let from = k * self.pattern.lines.stride;
            self.blocks[from..from + self.pattern.order.len()].iter_mut().for_each(|v| *v *= 1.0 + part);
        }
    }

    /// The blocks times a vector, both in planes in the order of the lattice.
    pub fn apply(&self, x: &[f64], out: &mut [f64]) {
        let rows = 0..self.pattern.order.len();
        dispatch(Apply { pattern: &self.pattern, blocks: &self.blocks, rows, x, out });
    }

    /// r = b − A x, in two halves of the pairs; `products` is memory.
    pub fn leave(&self, team: &Team, b: &[f64], x: &[f64], products: &mut [Vec<f64>; 2], r: &mut [f64]) {
        let (pattern, blocks, n) = (&*self.pattern, &self.blocks[..], self.pattern.order.len());
        let middle = self.middle();
        let end = Apply::end(pattern, middle);
        let [low, high] = products;
        team.both(
            || dispatch(Apply { pattern, blocks, rows: 0..middle, x, out: low }),
            || dispatch(Apply { pattern, blocks, rows: middle..n, x, out: high }),
        );
        // Each half made the rows of its own; both what the first one's pairs reach of the others.
        for k in [0, 1, 2].map(|k| k * pattern.lines.plane) {
            let minus = |rows: Range<usize>, product: &[f64], r: &mut [f64]| {
                let rows = k + rows.start..k + rows.end;
                r[rows.clone()].iter_mut().zip(&product[rows]).for_each(|(r, product)| *r -= product);
            };
            r[k..][..n].copy_from_slice(&b[k..][..n]);
            minus(0..end, low, r);
            minus(middle..n, high, r);
        }
    }

    /// How far A x may be off by in single precision [N], as if the diagonal blocks were all of A: twice what rounding them and x does at the
    /// most, which is what the other blocks add where an obstacle pokes hardest, and more elsewhere, as signs differ (tested).
    pub fn rounding(&self, team: &Team, x: &[f64]) -> f64 {
        let (pattern, blocks, n) = (&*self.pattern, &self.blocks[..], self.pattern.order.len());
        let (middle, mut low, mut high) = (self.middle(), 0.0, 0.0);
        team.both(
            || low = dispatch(Weigh { pattern, blocks, rows: 0..middle, x }),
            || high = dispatch(Weigh { pattern, blocks, rows: middle..n, x }),
        );
        f64::from(f32::EPSILON) * (low + high).sqrt()
    }

    /// The place in the order where the second of two halves begins, in whole registers.
    fn middle(&self) -> usize {
        let n = self.pattern.order.len();
        (n / 2).next_multiple_of(PADDING).min(n)
    }

    /// The lower triangle, mirrored, times a vector, both with three numbers per particle in elimination order.
    pub fn multiply(&self, x: &[f64], out: &mut [f64]) {
        out.fill(0.0);
        let blocks = &self.pattern.blocks;
        for c in 0..self.pattern.particles.len() {
            let rows = blocks.column(c);
            let stride = 3 * rows.len();
            let first = blocks.start(c) as usize;
            let (second, third) = (first + 3 + stride, first + 5 + 2 * stride);
            let v = &self.values;
            let [x0, x1, x2] = [x[3 * c], x[3 * c + 1], x[3 * c + 2]];
            let mut sum = [
                v[first] * x0 + v[first + 1] * x1 + v[first + 2] * x2,
                v[first + 1] * x0 + v[second] * x1 + v[second + 1] * x2,
                v[first + 2] * x0 + v[second + 1] * x1 + v[third] * x2,
            ];
            let columns = [&v[first + 3..][..stride], &v[second + 2..][..stride], &v[third + 1..][..stride]];
            for (t, &row) in rows.iter().enumerate() {
                let at = 3 * row as usize;
                let (below, target) = (&x[at..at + 3], &mut out[at..at + 3]);
                let [a, b, d] = columns.map(|column| &column[3 * t..3 * t + 3]);
                for k in 0..3 {
                    target[k] += a[k] * x0 + b[k] * x1 + d[k] * x2;
                }
                sum[0] += a[0] * below[0] + a[1] * below[1] + a[2] * below[2];
                sum[1] += b[0] * below[0] + b[1] * below[1] + b[2] * below[2];
                sum[2] += d[0] * below[0] + d[1] * below[1] + d[2] * below[2];
            }
            (0..3).for_each(|k| out[3 * c + k] += sum[k]);
        }
    }

    /// The matrix times a vector per node; fixed particles' rows are their identity, ghosts' are zero.
    pub fn product(&self, v: &[Vec3]) -> Vec<Vec3> {
        let particles = &self.pattern.particles;
        let by_rank: Vec<f64> = particles.iter().flat_map(|&n| v[n as usize].iter().copied()).collect();
        let mut out = vec![0.0; by_rank.len()];
        self.multiply(&by_rank, &mut out);
        let mut product = vec![Vec3::zeros(); v.len()];
        for (&n, value) in particles.iter().zip(out.chunks_exact(3)) {
            product[n as usize] = Vec3::from_column_slice(value);
        }
        product
    }
}
