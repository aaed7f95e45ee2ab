//! Conjugate gradients with a multigrid preconditioner that is rebuilt at every solve.
//!
//! Coarse matrices are Galerkin products Pᵀ A P with linear P; smoothing is block Jacobi, damped, one sweep before and one after; the
//! coarsest level is solved directly. Single precision inside the preconditioner only: the iteration itself is double [Briggs, Henson &
//! McCormick 2000]. Nothing is allocated after `new`.

#![expect(clippy::needless_range_loop, reason = "components read best by their numbers")]

use crate::{
    grid::Grid,
    math::pack::dispatch,
    phase::{Phase, Watch},
    potential::system::{Pattern, System},
};
use coarsen::{Masters, coarsen};
use dense::Dense;
use matrix::{Block, Matrix, Node, fused, inverse, times, transposed};
use pulp::{Simd, WithSimd};

mod coarsen;
mod dense;
mod matrix;

/// Damping of the smoother.
const DAMPING: f32 = 0.5;

/// A hierarchy of a mesh's matrices.
pub struct Multigrid {
    levels: Vec<Level>,
    coarsest: Dense,
    /// Entries of the system's values for each number of the finest blocks, row by row of the blocks.
    entries: Vec<[u32; 9]>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    image: Vec<f64>,
    preconditioned: Vec<f64>,
}

/// One level: its matrix, and how it hangs together with the next coarser one.
struct Level {
    matrix: Matrix,
    /// Damped inverses of the diagonal blocks.
    smoother: Vec<Block>,
    x: Vec<Node>,
    b: Vec<Node>,
    r: Vec<Node>,
    /// First master of each particle, masters, weights (0 for fixed particles) and weights as of the mesh.
    starts: Vec<u32>,
    masters: Vec<u32>,
    weights: Vec<f32>,
    /// Per coarse block of the upper triangle: where it and its transpose lie, and the end of its list of products.
    targets: Vec<[u32; 3]>,
    /// Finer block and weight of each product.
    products: Vec<(u32, f32)>,
}

/// Why conjugate gradients ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The stopping rule was met.
    Met,
    /// A direction of negative curvature.
    Indefinite,
    /// Too many iterations.
    Spent,
}

impl Multigrid {
    /// The hierarchy of a mesh.
    pub fn new(grid: &Grid, pattern: &Pattern) -> Multigrid {
        let n = pattern.particles.len();
        let sites = pattern.particles.iter().map(|&p| grid.site(p as usize)).collect();
        let mut rows: Vec<Vec<u32>> = (0..n)
            .map(|place| {
                let others = pattern.neighbours(place).iter().map(|(p, _)| pattern.rank[*p as usize]);
                std::iter::once(place as u32).chain(others).collect()
            })
            .collect();
        let entries = (0..n)
            .flat_map(|place| {
                let own = pattern.diagonal_entries(place);
                let others = pattern.neighbours(place).iter().map(|(_, slot)| slot.entries());
                // The slot is that of (neighbour, particle), row by row: column by column it is the block in the particle's row.
                std::iter::once(own).chain(others)
            })
            .collect();
        let mut levels = Vec::new();
        for masters in coarsen(sites) {
            let (level, coarser) = Level::new(&rows, masters);
            levels.push(level);
            rows = coarser;
        }
        let coarsest = Dense::new(Matrix::new(&rows));
        let zeros = || vec![0.0; 3 * n];
        Multigrid {
            levels,
            coarsest,
            entries,
            residual: zeros(),
            direction: zeros(),
            image: zeros(),
            preconditioned: zeros(),
        }
    }

    /// Builds the preconditioner of the system's matrix.
    pub fn build(&mut self, system: &System) {
        let Multigrid { levels, coarsest, entries, .. } = self;
        dispatch(Build { levels, coarsest, entries, system });
    }

    /// Improves `x` towards A x = b by conjugate gradients, until `is_met`, asked with each residual b − A x, says so.
    /// Gives how it ended and the iterations it took. All vectors are in elimination order, zero for fixed particles.
    pub fn solve(
        &mut self,
        system: &System,
        b: &[f64],
        x: &mut [f64],
        iterations: u32,
        mut is_met: impl FnMut(&[f64]) -> bool,
        watch: Watch,
    ) -> (End, u32) {
        let Multigrid { levels, coarsest, residual: r, direction: d, image, preconditioned: z, .. } = self;
        system.multiply(x, image);
        for k in 0..b.len() {
            r[k] = b[k] - image[k];
        }
        let mut old = 0.0;
        for iteration in 0..iterations {
            if is_met(r) {
                return (End::Met, iteration);
            }
            dispatch(Precondition { levels, coarsest, r, z });
            let new = dot(r, z);
            let beta = if iteration == 0 { 0.0 } else { new / old };
            old = new;
            for k in 0..d.len() {
                d[k] = z[k] + beta * d[k];
            }
            system.multiply(d, image);
            let curvature = dot(d, image);
            // Not a number counts as negative.
            if !(curvature > 0.0 && new > 0.0) {
                return (if new == 0.0 { End::Met } else { End::Indefinite }, iteration);
            }
            let alpha = new / curvature;
            for k in 0..d.len() {
                x[k] += alpha * d[k];
                r[k] -= alpha * image[k];
            }
            watch.ended(Phase::Iteration);
        }
        (if is_met(r) { End::Met } else { End::Spent }, iterations)
    }
}

/// a · b, in eight sums.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    for (a, b) in a.iter().zip(b) {
        (0..8).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

impl Level {
    /// A level with these columns in each row and these masters, and the columns of the next coarser one.
    fn new(rows: &[Vec<u32>], masters: Vec<Masters>) -> (Level, Vec<Vec<u32>>) {
        let matrix = Matrix::new(rows);
        let coarse = masters.iter().flatten().map(|m| m.0 as usize + 1).max().unwrap_or(0);
        let mut columns: Vec<Vec<u32>> = (0..coarse as u32).map(|c| vec![c]).collect();
        let mut products: Vec<(u32, u32, u32, f32)> = Vec::new();
        for row in 0..matrix.len() {
            for place in matrix.row(row) {
                let column = matrix.columns[place] as usize;
                for &(a, u) in &masters[row] {
                    for &(b, v) in &masters[column] {
                        if a <= b {
                            products.push((a, b, place as u32, u * v));
                        }
                        if !columns[a as usize].contains(&b) {
                            columns[a as usize].push(b);
                        }
                    }
                }
            }
        }
        columns.iter_mut().for_each(|row| row[1..].sort_unstable());
        products.sort_by_key(|&(a, b, place, _)| (a, b, place));
        let coarser = Matrix::new(&columns);
        let mut targets: Vec<[u32; 3]> = Vec::new();
        let mut last = None;
        for (end, &(a, b, ..)) in products.iter().enumerate() {
            if last != Some((a, b)) {
                targets.push([coarser.place(a, b), coarser.place(b, a), 0]);
                last = Some((a, b));
            }
            targets.last_mut().expect("just pushed")[2] = end as u32 + 1;
        }
        let mut starts = vec![0];
        masters.iter().for_each(|m| starts.push(starts[starts.len() - 1] + m.len() as u32));
        let flat = masters.concat();
        let n = matrix.len();
        let level = Level {
            smoother: vec![[0.0; 16]; n],
            x: vec![[0.0; 4]; n],
            b: vec![[0.0; 4]; n],
            r: vec![[0.0; 4]; n],
            starts,
            masters: flat.iter().map(|m| m.0).collect(),
            weights: flat.iter().map(|m| m.1).collect(),
            targets,
            products: products.iter().map(|p| (p.2, p.3)).collect(),
            matrix,
        };
        (level, columns)
    }

    /// Particles that cannot move have no smoother; neither do they follow their masters.
    #[inline(always)]
    fn set_smoother(&mut self) {
        for row in 0..self.matrix.len() {
            self.smoother[row] = inverse(&self.matrix.blocks[self.matrix.starts[row] as usize], DAMPING);
        }
    }

    #[inline(always)]
    fn coarser<S: Simd>(&self, to: &mut Matrix) {
        let mut from = 0;
        for &[place, mirrored, end] in &self.targets {
            let mut sum = [0.0f32; 16];
            for &(block, weight) in &self.products[from..end as usize] {
                let block = &self.matrix.blocks[block as usize];
                for k in 0..16 {
                    sum[k] = fused::<S>(block[k], weight, sum[k]);
                }
            }
            from = end as usize;
            to.blocks[place as usize] = sum;
            if mirrored != place {
                to.blocks[mirrored as usize] = transposed(&sum);
            }
        }
    }

    #[inline(always)]
    fn smooth_first<S: Simd>(&mut self) {
        for row in 0..self.x.len() {
            self.x[row] = times(&self.smoother[row], &self.b[row]);
        }
        self.matrix.residual::<S>(&self.x, &self.b, &mut self.r);
    }

    #[inline(always)]
    fn smooth_last<S: Simd>(&mut self) {
        self.matrix.residual::<S>(&self.x, &self.b, &mut self.r);
        for row in 0..self.x.len() {
            let change = times(&self.smoother[row], &self.r[row]);
            for k in 0..4 {
                self.x[row][k] += change[k];
            }
        }
    }

    #[inline(always)]
    fn restrict<S: Simd>(&self, to: &mut [Node]) {
        to.fill([0.0; 4]);
        for (row, r) in self.r.iter().enumerate() {
            for m in self.starts[row] as usize..self.starts[row + 1] as usize {
                let (to, weight) = (&mut to[self.masters[m] as usize], self.weights[m]);
                for k in 0..4 {
                    to[k] = fused::<S>(r[k], weight, to[k]);
                }
            }
        }
    }

    #[inline(always)]
    fn prolong<S: Simd>(&mut self, from: &[Node]) {
        for (row, x) in self.x.iter_mut().enumerate() {
            // What has no smoother is fixed.
            if self.smoother[row][0] == 0.0 {
                continue;
            }
            for m in self.starts[row] as usize..self.starts[row + 1] as usize {
                let (from, weight) = (&from[self.masters[m] as usize], self.weights[m]);
                for k in 0..4 {
                    x[k] = fused::<S>(from[k], weight, x[k]);
                }
            }
        }
    }
}

struct Build<'a> {
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    entries: &'a [[u32; 9]],
    system: &'a System,
}

impl WithSimd for Build<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Build { levels, coarsest, entries, system } = self;
        let finest = match levels.first_mut() {
            Some(level) => &mut level.matrix,
            None => &mut coarsest.matrix,
        };
        for (block, entries) in finest.blocks.iter_mut().zip(entries) {
            for column in 0..3 {
                for row in 0..3 {
                    block[4 * column + row] = system.values[entries[3 * column + row] as usize] as f32;
                }
            }
        }
        for (place, &particle) in system.pattern.particles.iter().enumerate() {
            if system.fixed[particle as usize] {
                finest.blocks[finest.starts[place] as usize] = [0.0; 16];
            }
        }
        for l in 0..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            fine.set_smoother();
            fine.coarser::<S>(coarse.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix));
        }
        coarsest.factorize();
    }
}

struct Precondition<'a> {
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    r: &'a [f64],
    z: &'a mut [f64],
}

impl WithSimd for Precondition<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Precondition { levels, coarsest, r, z } = self;
        {
            let b = levels.first_mut().map_or(&mut coarsest.x, |level| &mut level.b);
            for (b, r) in b.iter_mut().zip(r.chunks_exact(3)) {
                *b = [r[0] as f32, r[1] as f32, r[2] as f32, 0.0];
            }
        }
        for l in 0..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            fine[l].smooth_first::<S>();
            fine[l].restrict::<S>(coarse.first_mut().map_or(&mut coarsest.x, |level| &mut level.b));
        }
        coarsest.solve();
        for l in (0..levels.len()).rev() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            fine[l].prolong::<S>(coarse.first().map_or(&coarsest.x, |level| &level.x));
            fine[l].smooth_last::<S>();
        }
        let x = levels.first().map_or(&coarsest.x, |level| &level.x);
        for (z, x) in z.chunks_exact_mut(3).zip(x) {
            (0..3).for_each(|k| z[k] = f64::from(x[k]));
        }
    }
}
