//! Conjugate gradients with a multigrid preconditioner that is rebuilt at every solve.
//!
//! Coarse matrices are Galerkin products Pᵀ A P with linear P; smoothing is one sweep before and one after, forward and backward by
//! Gauss and Seidel, or by damped block Jacobi where the finest level lies in planes; the coarsest level is solved directly [Briggs,
//! Henson & McCormick 2000]. Matrices are single, as reading them is most of the time; what decides is double: no residual is believed
//! and no curvature negative but in double precision. Nothing is allocated after `new`.

#![expect(clippy::needless_range_loop, reason = "components read best by their numbers")]

use crate::{
    grid::Grid,
    math::pack::dispatch,
    phase::{Phase, Watch},
    potential::{pattern::Pattern, system::System},
};
use build::{Build, entries};
use coarsen::coarsen;
use dense::Dense;
use matrix::{Block, Matrix, Node, Wide, inverse};
use pulp::{Simd, WithSimd};
use stencil::Stencil;
use transfer::Transfer;

pub use build::{Part, TURNS};

mod build;
mod coarsen;
mod dense;
mod matrix;
mod stencil;
mod transfer;

/// Damping of the smoother.
const DAMPING: f32 = 0.5;

/// A hierarchy of a mesh's matrices.
pub struct Multigrid {
    top: Top,
    levels: Vec<Level>,
    coarsest: Dense,
    /// Places of each pair's block in the planes and, straight and transposed, in the finest matrix.
    entries: Vec<[u32; 3]>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    image: Vec<f64>,
    preconditioned: Vec<f64>,
}

/// How the finest level lies in memory.
enum Top {
    /// In planes, and its way to coarser levels by blocks: where most pairs stand in line, whole registers of neighbours go at once.
    Planes(Box<Stencil>, Box<Finest>),
    /// By blocks as the coarser ones, before which it stands.
    Blocks,
}

/// The finest level's way to coarser ones, by blocks.
struct Finest {
    matrix: Matrix,
    transfer: Transfer,
    carry: Vec<Node>,
}

/// One coarser level.
struct Level {
    matrix: Matrix,
    transfer: Transfer,
    /// Inverses of the diagonal blocks.
    inverses: Vec<Block>,
    x: Vec<Wide>,
    b: Vec<Node>,
    r: Vec<Node>,
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
        let n = pattern.order.len();
        let sites = pattern.order.iter().map(|&p| grid.site(p as usize)).collect();
        let rows = (0..n).map(|place| {
            let others = pattern.neighbours(place).iter().map(|(p, _)| pattern.place[*p as usize]);
            std::iter::once(place as u32).chain(others).collect()
        });
        let mut matrix = Matrix::new(rows.collect());
        let entries = entries(pattern, &matrix);
        let pairs = |is_padded: bool| -> usize {
            pattern.runs.iter().filter(|run| run.is_padded == is_padded).map(|run| run.len).sum()
        };
        let in_line = pairs(true) > pairs(false);
        let mut top = Top::Blocks;
        let mut levels = Vec::new();
        for (depth, masters) in coarsen(sites).into_iter().enumerate() {
            let (transfer, coarser) = Transfer::new(&matrix, masters);
            let matrix = std::mem::replace(&mut matrix, coarser);
            if depth == 0 && in_line {
                let carry = vec![[0.0; 4]; n];
                let finest = Finest { matrix, transfer, carry };
                top = Top::Planes(Box::new(Stencil::new(pattern)), Box::new(finest));
            } else {
                levels.push(Level::new(matrix, transfer));
            }
        }
        let coarsest = Dense::new(matrix);
        let zeros = || vec![0.0; 3 * pattern.plane];
        Multigrid {
            top,
            levels,
            coarsest,
            entries,
            residual: zeros(),
            direction: zeros(),
            image: zeros(),
            preconditioned: zeros(),
        }
    }

    /// Builds the preconditioner of the system's matrix: the finest level, and as much of the coarser ones as asked for.
    pub fn build(&mut self, system: &System, part: Part) {
        let Multigrid { top, levels, coarsest, entries, .. } = self;
        dispatch(Build { top, levels, coarsest, entries, system, part });
    }

    /// Improves `x` towards A x = b by conjugate gradients, until `is_met`, asked with each residual b − A x, says so.
    /// Gives how it ended and the iterations it took. All vectors are in planes in the order of the lattice, zero for fixed particles.
    pub fn solve(
        &mut self,
        system: &System,
        b: &[f64],
        x: &mut [f64],
        iterations: u32,
        mut is_met: impl FnMut(&[f64]) -> bool,
        watch: Watch,
    ) -> (End, u32) {
        let Multigrid { top, levels, coarsest, .. } = self;
        let (r, d, image, z) =
            (&mut self.residual, &mut self.direction, &mut self.image, &mut self.preconditioned);
        let plane = system.pattern.plane;
        leave(system, b, x, r);
        d.fill(0.0);
        if is_met(r) {
            return (End::Met, 0);
        }
        let (mut restarts, mut old) = (true, 0.0);
        for iteration in 1..=iterations {
            dispatch(Precondition { top, levels, coarsest, plane, r, z });
            let new = dot(r, z);
            let beta = if restarts { 0.0 } else { new / old };
            (old, restarts) = (new, false);
            dispatch(Combine { to: d, scale: beta, factor: 1.0, from: z });
            dispatch(Product { top, levels, system, x: d, out: image });
            let mut curvature = dot(d, image);
            if curvature <= 0.0 {
                // That may be rounding.
                system.apply(d, image);
                curvature = dot(d, image);
            }
            // Not a number counts as negative.
            if !(curvature > 0.0 && new > 0.0) {
                return (if new == 0.0 { End::Met } else { End::Indefinite }, iteration - 1);
            }
            let alpha = new / curvature;
            dispatch(Combine { to: x, scale: 1.0, factor: alpha, from: d });
            dispatch(Combine { to: r, scale: 1.0, factor: -alpha, from: image });
            let mut met = is_met(r);
            if met {
                // Residuals are updated by products in single precision; before one is believed it is made anew.
                leave(system, b, x, r);
                restarts = true;
                met = is_met(r);
            }
            watch.ended(Phase::Iteration);
            if met {
                return (End::Met, iteration);
            }
        }
        (End::Spent, iterations)
    }
}

/// r = b − A x
fn leave(system: &System, b: &[f64], x: &[f64], r: &mut [f64]) {
    system.apply(x, r);
    r.iter_mut().zip(b).for_each(|(r, b)| *r = b - *r);
}

/// a · b, in sixteen sums.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    dispatch(Dot { a, b })
}

struct Dot<'a> {
    a: &'a [f64],
    b: &'a [f64],
}

impl WithSimd for Dot<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> f64 {
        let mut sums = [0.0; 16];
        let ((a, a_rest), (b, b_rest)) = (self.a.as_chunks::<16>(), self.b.as_chunks::<16>());
        for (a, b) in a.iter().zip(b) {
            for k in 0..16 {
                sums[k] += a[k] * b[k];
            }
        }
        for (k, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
            sums[k] += a * b;
        }
        sums.iter().sum()
    }
}

/// to ← scale · to + factor · from
struct Combine<'a> {
    to: &'a mut [f64],
    scale: f64,
    factor: f64,
    from: &'a [f64],
}

impl WithSimd for Combine<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (to, from) in self.to.iter_mut().zip(self.from) {
            *to = self.scale * *to + self.factor * from;
        }
    }
}

impl Finest {
    #[inline(always)]
    fn restrict<S: Simd>(&mut self, stencil: &Stencil, to: &mut [Node]) {
        let Finest { transfer, carry, .. } = self;
        let plane = stencil.plane();
        for (row, carry) in carry.iter_mut().enumerate() {
            *carry = [stencil.r[row], stencil.r[plane + row], stencil.r[2 * plane + row], 0.0];
        }
        transfer.restrict::<S>(carry, to);
    }

    #[inline(always)]
    fn prolong<S: Simd>(&self, from: impl Fn(usize) -> Node, stencil: &mut Stencil) {
        let Finest { transfer, carry, .. } = self;
        let plane = stencil.plane();
        for row in 0..carry.len() {
            // What has no smoother is fixed.
            if !stencil.is_fixed(row) {
                let x = transfer.followed::<S>(row, &from);
                (0..3).for_each(|k| stencil.x[k * plane + row] += x[k]);
            }
        }
    }
}

impl Level {
    fn new(matrix: Matrix, transfer: Transfer) -> Level {
        let n = matrix.len();
        let (b, r) = (vec![[0.0; 4]; n], vec![[0.0; 4]; n]);
        Level { inverses: vec![[0.0; 9]; n], x: vec![Wide::new(&[0.0; 4]); n], b, r, matrix, transfer }
    }

    /// Particles that cannot move have no inverse; neither do they follow their masters.
    #[inline(always)]
    fn invert(&mut self) {
        for row in 0..self.matrix.len() {
            self.inverses[row] = inverse(self.matrix.diagonal(row));
        }
    }

    #[inline(always)]
    fn smooth_first<S: Simd>(&mut self, simd: S) {
        let Level { matrix, inverses, b, x, r, .. } = self;
        matrix.sweep_forward(simd, inverses, b, x, r);
    }

    #[inline(always)]
    fn smooth_last<S: Simd>(&mut self, simd: S) {
        let Level { matrix, inverses, b, x, .. } = self;
        matrix.sweep_backward(simd, inverses, b, x);
    }

    #[inline(always)]
    fn prolong<S: Simd>(&mut self, from: impl Fn(usize) -> Node) {
        for (row, x) in self.x.iter_mut().enumerate() {
            // What has no inverse is held.
            if self.inverses[row][0] != 0.0 {
                let (own, follow) = (x.node(), self.transfer.followed::<S>(row, &from));
                *x = Wide::new(&std::array::from_fn(|k| own[k] + follow[k]));
            }
        }
    }
}

/// The finest level's matrix times a vector.
struct Product<'a> {
    top: &'a mut Top,
    levels: &'a mut [Level],
    system: &'a System,
    x: &'a [f64],
    out: &'a mut [f64],
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Product { top, levels, system, x, out } = self;
        match (top, levels.first_mut()) {
            (Top::Planes(stencil, _), _) => stencil.multiply(simd, x, out),
            (Top::Blocks, Some(Level { matrix, x: wide, .. })) => {
                let plane = system.pattern.plane;
                for (row, wide) in wide.iter_mut().enumerate() {
                    *wide = Wide::new(&node(x, plane, row));
                }
                for row in 0..wide.len() {
                    let product = matrix.product(simd, matrix.row(row), wide);
                    (0..3).for_each(|k| out[k * plane + row] = f64::from(product[k]));
                }
            }
            (Top::Blocks, None) => system.apply(x, out),
        }
    }
}

/// A row's numbers of a vector in planes.
#[inline(always)]
fn node(x: &[f64], plane: usize, row: usize) -> Node {
    [x[row] as f32, x[plane + row] as f32, x[2 * plane + row] as f32, 0.0]
}

/// What the first of these levels solved for a row; without one, the coarsest.
#[inline(always)]
fn solved(levels: &[Level], coarsest: &Dense, row: usize) -> Node {
    match levels.first() {
        Some(level) => level.x[row].node(),
        None => coarsest.x[row],
    }
}

struct Precondition<'a> {
    top: &'a mut Top,
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    /// Length of a plane of the vectors.
    plane: usize,
    r: &'a [f64],
    z: &'a mut [f64],
}

impl WithSimd for Precondition<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Precondition { top, levels, coarsest, plane, r, z } = self;
        let first = levels.first_mut().map_or(&mut coarsest.x, |level| &mut level.b);
        match top {
            Top::Planes(stencil, finest) => {
                stencil.smooth_first(simd, r);
                finest.restrict::<S>(stencil, first);
            }
            Top::Blocks => {
                for (row, b) in first.iter_mut().enumerate() {
                    *b = node(r, plane, row);
                }
            }
        }
        for l in 0..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            fine.smooth_first(simd);
            let to = coarse.first_mut().map_or(&mut coarsest.x, |level| &mut level.b);
            fine.transfer.restrict::<S>(&fine.r, to);
        }
        coarsest.solve();
        for l in (0..levels.len()).rev() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            fine[l].prolong::<S>(|n| solved(coarse, coarsest, n));
            fine[l].smooth_last(simd);
        }
        match top {
            Top::Planes(stencil, finest) => {
                finest.prolong::<S>(|n| solved(levels, coarsest, n), stencil);
                stencil.smooth_last(simd, z);
            }
            Top::Blocks => {
                let n = levels.first().map_or(coarsest.x.len(), |level| level.x.len());
                for row in 0..n {
                    let x = solved(levels, coarsest, row);
                    (0..3).for_each(|k| z[k * plane + row] = f64::from(x[k]));
                }
            }
        }
    }
}
