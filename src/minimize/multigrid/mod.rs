//! Conjugate gradients with a multigrid preconditioner, whose finest level is that of the solve; coarser ones may be those of a while ago
//! (`Coarser` makes them, at once or in turns).
//!
//! Coarse matrices are Galerkin products Pᵀ A P with linear P; smoothing is one sweep before and one after, forward and backward by
//! Gauss and Seidel, or by damped block Jacobi where the finest level lies in planes; the coarsest level is solved directly [Briggs,
//! Henson & McCormick 2000]. Matrices are single, as reading them is most of the time; what decides is double: no residual is believed
//! and no curvature negative but in double precision. Nothing is allocated after `new`.

#![expect(clippy::needless_range_loop, reason = "components read best by their numbers")]

use crate::{
    grid::Grid,
    math::pack::dispatch,
    minimize::cores::Work,
    phase::{Phase, Watch},
    potential::{pattern::Pattern, system::System},
};
use coarsen::coarsen;
use coarser::{Planes, entries, fill};
use dense::Dense;
use matrix::{Block, Matrix, Node, Wide, inverse};
use pulp::{Simd, WithSimd};
use std::sync::Arc;
use stencil::Stencil;
use transfer::Transfer;

pub use coarser::{Coarser, TURNS};

mod coarsen;
mod coarser;
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
    /// From the finest level to the next, and so on.
    transfers: Arc<[Transfer]>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    image: Vec<f64>,
    preconditioned: Vec<f64>,
}

/// How the finest level lies in memory.
enum Top {
    /// In planes, and its residual once more by nodes: where most pairs stand in line, whole registers of neighbours go at once.
    Planes(Box<Stencil>, Vec<Node>),
    /// By blocks as the coarser ones, of which it is the first; where each lies in the planes.
    Blocks(Vec<[u32; 3]>),
}

/// One level by blocks.
struct Level {
    coarse: Coarse,
    x: Vec<Wide>,
    b: Vec<Node>,
    r: Vec<Node>,
}

/// A level's matrix, and the inverses of its diagonal blocks.
#[derive(Clone)]
struct Coarse {
    matrix: Matrix,
    inverses: Vec<Block>,
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
    /// The hierarchy of a mesh, and what makes its coarser levels.
    pub fn new(grid: &Grid, pattern: &Pattern) -> (Multigrid, Coarser) {
        let n = pattern.order.len();
        let sites = pattern.order.iter().map(|&p| grid.site(p as usize)).collect();
        let rows = (0..n).map(|place| {
            let others = pattern.neighbours(place).iter().map(|(p, _)| pattern.place[*p as usize]);
            std::iter::once(place as u32).chain(others).collect()
        });
        let finest = Matrix::new(rows.collect());
        let entries = entries(pattern, &finest);
        let pairs = |is_padded: bool| -> usize {
            pattern.runs.iter().filter(|run| run.is_padded == is_padded).map(|run| run.len).sum()
        };
        let (mut last, mut transfers, mut levels) = (finest.clone(), Vec::new(), Vec::new());
        for masters in coarsen(sites) {
            let (transfer, coarser) = Transfer::new(&last, masters);
            transfers.push(transfer);
            levels.push(Coarse::new(std::mem::replace(&mut last, coarser)));
        }
        let in_planes = !transfers.is_empty() && pairs(true) > pairs(false);
        let beyond: Vec<Coarse> = levels.iter().skip(1).cloned().collect();
        let transfers: Arc<[Transfer]> = transfers.into();
        let (top, levels, planes) = if in_planes {
            let blocks = vec![0.0; 9 * pattern.stride];
            let top = Top::Planes(Box::new(Stencil::new(pattern)), vec![[0.0; 4]; n]);
            (top, beyond.clone(), Some(Planes { blocks, stride: pattern.stride, entries }))
        } else {
            (Top::Blocks(entries), levels, None)
        };
        let coarser = Coarser {
            planes,
            finest,
            levels: beyond,
            coarsest: Dense::new(last.clone()),
            transfers: transfers.clone(),
            done: 0,
        };
        let zeros = || vec![0.0; 3 * pattern.plane];
        let multigrid = Multigrid {
            top,
            levels: levels.into_iter().map(Level::new).collect(),
            coarsest: Dense::new(last),
            transfers,
            residual: zeros(),
            direction: zeros(),
            image: zeros(),
            preconditioned: zeros(),
        };
        (multigrid, coarser)
    }

    /// Takes over the system's matrix on the finest level.
    pub fn set(&mut self, system: &System) {
        let Multigrid { top, levels, coarsest, .. } = self;
        dispatch(Set { top, levels, coarsest, system });
    }

    /// Makes all coarser levels of the finest one.
    pub fn renew(&mut self, coarser: &mut Coarser) {
        match (&self.top, self.levels.first()) {
            (Top::Planes(stencil, _), _) => {
                coarser.planes.iter_mut().for_each(|planes| planes.blocks.copy_from_slice(&stencil.blocks));
            }
            (Top::Blocks(_), Some(finest)) => coarser.finest.copy_from(&finest.coarse.matrix),
            (Top::Blocks(_), None) => return,
        }
        coarser.done = 0;
        (0..TURNS).for_each(|_| coarser.work());
        self.take(coarser);
    }

    /// Before the finest level is set: takes over coarser ones that are finished, and hands on the finest for what is to be made next.
    pub fn exchange(&mut self, coarser: &mut Coarser) {
        if coarser.done == TURNS {
            self.take(coarser);
        }
        if coarser.done > 0 {
            return;
        }
        match (&mut self.top, self.levels.first_mut()) {
            (Top::Planes(stencil, _), _) => {
                let planes = coarser.planes.iter_mut();
                planes.for_each(|planes| std::mem::swap(&mut planes.blocks, &mut stencil.blocks));
            }
            (Top::Blocks(_), Some(finest)) => {
                std::mem::swap(&mut coarser.finest, &mut finest.coarse.matrix);
            }
            (Top::Blocks(_), None) => {}
        }
    }

    fn take(&mut self, coarser: &mut Coarser) {
        let own = self.levels.len() - coarser.levels.len();
        for (level, made) in self.levels[own..].iter_mut().zip(&mut coarser.levels) {
            std::mem::swap(&mut level.coarse, made);
        }
        if !self.transfers.is_empty() {
            std::mem::swap(&mut self.coarsest, &mut coarser.coarsest);
        }
        coarser.done = 0;
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
        let Multigrid { top, levels, coarsest, transfers, .. } = self;
        let (r, d, image, z) =
            (&mut self.residual, &mut self.direction, &mut self.image, &mut self.preconditioned);
        let plane = system.pattern.plane;
        // In single: what ends the iteration is made anew.
        dispatch(Product { top, levels, system, x, out: image });
        r.iter_mut().zip(b.iter().zip(&*image)).for_each(|(r, (b, image))| *r = b - image);
        d.fill(0.0);
        if is_met(r) {
            leave(system, b, x, r);
            if is_met(r) {
                return (End::Met, 0);
            }
        }
        let (mut restarts, mut old) = (true, 0.0);
        for iteration in 1..=iterations {
            dispatch(Precondition { top, levels, coarsest, transfers, plane, r, z });
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

impl Coarse {
    fn new(matrix: Matrix) -> Coarse {
        Coarse { inverses: vec![[0.0; 9]; matrix.len()], matrix }
    }

    /// Particles that cannot move have no inverse; neither do they follow their masters.
    #[inline(always)]
    fn invert(&mut self) {
        for row in 0..self.matrix.len() {
            self.inverses[row] = inverse(self.matrix.diagonal(row));
        }
    }
}

impl Level {
    fn new(coarse: Coarse) -> Level {
        let n = coarse.matrix.len();
        let (b, r) = (vec![[0.0; 4]; n], vec![[0.0; 4]; n]);
        Level { coarse, x: vec![Wide::new(&[0.0; 4]); n], b, r }
    }

    #[inline(always)]
    fn smooth_first<S: Simd>(&mut self, simd: S) {
        let Level { coarse, b, x, r } = self;
        coarse.matrix.sweep_forward(simd, &coarse.inverses, b, x, r);
    }

    #[inline(always)]
    fn smooth_last<S: Simd>(&mut self, simd: S) {
        let Level { coarse, b, x, .. } = self;
        coarse.matrix.sweep_backward(simd, &coarse.inverses, b, x);
    }

    #[inline(always)]
    fn prolong<S: Simd>(&mut self, transfer: &Transfer, from: impl Fn(usize) -> Node) {
        for (row, x) in self.x.iter_mut().enumerate() {
            // What has no inverse is held.
            if self.coarse.inverses[row][0] != 0.0 {
                let (own, follow) = (x.node(), transfer.followed::<S>(row, &from));
                *x = Wide::new(&std::array::from_fn(|k| own[k] + follow[k]));
            }
        }
    }
}

/// Takes over a system's matrix on the finest level. Fixed particles have no part in it.
struct Set<'a> {
    top: &'a mut Top,
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    system: &'a System,
}

impl WithSimd for Set<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Set { top, levels, coarsest, system } = self;
        let entries = match top {
            Top::Planes(stencil, _) => return stencil.set(simd, system),
            Top::Blocks(entries) => entries,
        };
        let (finest, is_coarsest) = match levels.first_mut() {
            Some(level) => (&mut level.coarse.matrix, false),
            None => (&mut coarsest.matrix, true),
        };
        fill(finest, entries, &system.blocks, system.pattern.stride);
        for (row, &particle) in system.pattern.order.iter().enumerate() {
            if system.fixed[particle as usize] {
                finest.forget_diagonal(row);
            }
        }
        if is_coarsest {
            coarsest.factorize();
        } else {
            levels[0].coarse.invert();
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
            (Top::Blocks(_), Some(Level { coarse: Coarse { matrix, .. }, x: wide, .. })) => {
                let plane = system.pattern.plane;
                for (row, wide) in wide.iter_mut().enumerate() {
                    *wide = Wide::new(&node(x, plane, row));
                }
                for row in 0..wide.len() {
                    let product = matrix.product(simd, matrix.row(row), wide);
                    (0..3).for_each(|k| out[k * plane + row] = f64::from(product[k]));
                }
            }
            (Top::Blocks(_), None) => system.apply(x, out),
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
    transfers: &'a [Transfer],
    /// Length of a plane of the vectors.
    plane: usize,
    r: &'a [f64],
    z: &'a mut [f64],
}

impl WithSimd for Precondition<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Precondition { top, levels, coarsest, transfers, plane, r, z } = self;
        let first = levels.first_mut().map_or(&mut coarsest.x, |level| &mut level.b);
        let beyond = match top {
            Top::Planes(stencil, carry) => {
                stencil.smooth_first(simd, r);
                for (row, carry) in carry.iter_mut().enumerate() {
                    *carry = [stencil.r[row], stencil.r[plane + row], stencil.r[2 * plane + row], 0.0];
                }
                transfers[0].restrict::<S>(carry, first);
                &transfers[1..]
            }
            Top::Blocks(_) => {
                for (row, b) in first.iter_mut().enumerate() {
                    *b = node(r, plane, row);
                }
                transfers
            }
        };
        for l in 0..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            fine.smooth_first(simd);
            let to = coarse.first_mut().map_or(&mut coarsest.x, |level| &mut level.b);
            beyond[l].restrict::<S>(&fine.r, to);
        }
        coarsest.solve();
        for l in (0..levels.len()).rev() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            fine[l].prolong::<S>(&beyond[l], |n| solved(coarse, coarsest, n));
            fine[l].smooth_last(simd);
        }
        match top {
            Top::Planes(stencil, carry) => {
                for row in 0..carry.len() {
                    // What has no smoother is fixed.
                    if !stencil.is_fixed(row) {
                        let x = transfers[0].followed::<S>(row, |n| solved(levels, coarsest, n));
                        (0..3).for_each(|k| stencil.x[k * plane + row] += x[k]);
                    }
                }
                stencil.smooth_last(simd, z);
            }
            Top::Blocks(_) => {
                let n = levels.first().map_or(coarsest.x.len(), |level| level.x.len());
                for row in 0..n {
                    let x = solved(levels, coarsest, row);
                    (0..3).for_each(|k| z[k * plane + row] = f64::from(x[k]));
                }
            }
        }
    }
}
