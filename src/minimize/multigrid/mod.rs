//! Conjugate gradients with a multigrid preconditioner, whose finest level is that of the solve; coarser ones may be those of a while ago
//! (`Coarser` makes them, at once or in turns).
//!
//! Coarse matrices are Galerkin products Pᵀ A P with linear P; smoothing is one sweep before and one after, forward and backward by
//! Gauss and Seidel, or by damped block Jacobi where a level lies in planes; the coarsest level is solved directly [Briggs,
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
use coarser::{Made, Planes, entries, fill, single};
use dense::Dense;
use level::{Level, Sweeps, Swept};
use matrix::{Matrix, Node, Wide};
use pulp::{Simd, WithSimd};
use std::sync::Arc;
use stencil::{Numbers, Stencil};
use transfer::Transfer;

pub use coarser::{Coarser, TURNS};

mod coarsen;
mod coarser;
mod dense;
mod level;
mod matrix;
mod stencil;
mod transfer;

/// Damping of the smoother.
const DAMPING: f32 = 0.5;

/// A hierarchy of a mesh's matrices.
pub struct Multigrid {
    /// All but the coarsest.
    levels: Vec<Level>,
    coarsest: Dense,
    /// Where the finest blocks lie in the system's planes, unless they are used so.
    entries: Vec<[u32; 3]>,
    /// From the finest level to the next, and so on.
    transfers: Arc<[Transfer]>,
    residual: Vec<f64>,
    direction: Vec<f32>,
    image: Vec<f32>,
    preconditioned: Vec<f32>,
    /// A direction and its image where single precision does not do.
    exact: [Vec<f64>; 2],
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
        let lines = &pattern.lines;
        let entries = entries(lines, &finest);
        let (mut last, mut transfers, mut matrices) = (finest.clone(), Vec::new(), Vec::new());
        for masters in coarsen(sites) {
            let (transfer, coarser) = Transfer::new(&last, masters);
            transfers.push(transfer);
            matrices.push(std::mem::replace(&mut last, coarser));
        }
        let transfers: Arc<[Transfer]> = transfers.into();
        let beyond = matrices.iter().enumerate().skip(1);
        let made: Vec<Made> = beyond.map(|(l, matrix)| Made::new(matrix.clone(), l == 1)).collect();
        let mut planes = None;
        let first = matrices.into_iter().next().map(|matrix| {
            if lines.are_long() {
                let numbers = Numbers::new(lines.clone());
                planes = Some(Planes { numbers: numbers.clone(), entries: entries.clone() });
                Level::Planes(Box::new(Stencil::new(numbers)))
            } else {
                Level::Blocks(Box::new(Sweeps::new(Swept::new(matrix))))
            }
        });
        let levels = first.into_iter().chain(made.iter().map(Made::level)).collect();
        let coarser = Coarser {
            planes,
            finest,
            levels: made,
            coarsest: Dense::new(last.clone()),
            transfers: transfers.clone(),
            done: 0,
        };
        let (single, double) = (vec![0.0; 3 * pattern.lines.plane], vec![0.0; 3 * pattern.lines.plane]);
        let multigrid = Multigrid {
            levels,
            coarsest: Dense::new(last),
            entries,
            transfers,
            residual: double.clone(),
            direction: single.clone(),
            image: single.clone(),
            preconditioned: single,
            exact: [double.clone(), double],
        };
        (multigrid, coarser)
    }

    /// Takes over the system's matrix on the finest level.
    pub fn set(&mut self, system: &System) {
        let Multigrid { levels, coarsest, entries, .. } = self;
        dispatch(Set { levels, coarsest, entries, system });
    }

    /// Makes all coarser levels of the finest one.
    pub fn renew(&mut self, coarser: &mut Coarser) {
        match (self.levels.first(), &mut coarser.planes) {
            (Some(Level::Planes(stencil)), Some(planes)) => {
                planes.numbers.blocks.copy_from_slice(&stencil.numbers.blocks);
            }
            (Some(Level::Blocks(finest)), _) => coarser.finest.copy_from(&finest.swept.matrix),
            _ => return,
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
        match (self.levels.first_mut(), &mut coarser.planes) {
            (Some(Level::Planes(stencil)), Some(planes)) => {
                std::mem::swap(&mut planes.numbers, &mut stencil.numbers);
            }
            (Some(Level::Blocks(finest)), _) => {
                std::mem::swap(&mut coarser.finest, &mut finest.swept.matrix);
            }
            _ => {}
        }
    }

    fn take(&mut self, coarser: &mut Coarser) {
        for (level, made) in self.levels.iter_mut().skip(1).zip(&mut coarser.levels) {
            match (level, made) {
                (Level::Planes(stencil), Made::Planes(_, planes)) => {
                    std::mem::swap(&mut stencil.numbers, &mut planes.numbers);
                }
                (Level::Blocks(sweeps), Made::Blocks(swept)) => std::mem::swap(&mut sweeps.swept, swept),
                _ => unreachable!("both were made alike"),
            }
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
        let Multigrid { levels, coarsest, transfers, exact, .. } = self;
        let (r, d, image, z) =
            (&mut self.residual, &mut self.direction, &mut self.image, &mut self.preconditioned);
        let plane = system.pattern.lines.plane;
        // In single: what ends the iteration is made anew.
        d.iter_mut().zip(&*x).for_each(|(d, x)| *d = *x as f32);
        dispatch(Product { levels, system, x: d, exact, out: image });
        r.iter_mut().zip(b.iter().zip(&*image)).for_each(|(r, (b, image))| *r = b - f64::from(*image));
        d.fill(0.0);
        if is_met(r) {
            leave(system, b, x, r);
            if is_met(r) {
                return (End::Met, 0);
            }
        }
        let (mut restarts, mut old) = (true, 0.0);
        for iteration in 1..=iterations {
            dispatch(Precondition { levels, coarsest, transfers, plane, r, z });
            let new = dot(r, z);
            let beta = if restarts { 0.0 } else { new / old };
            (old, restarts) = (new, false);
            dispatch(Conjugate { d, beta: beta as f32, z });
            dispatch(Product { levels, system, x: d, exact, out: image });
            let mut curvature = dot(d, image);
            if curvature <= 0.0 {
                // That may be rounding.
                curvature = curvature_of(system, d, exact);
            }
            // Not a number counts as negative.
            if !(curvature > 0.0 && new > 0.0) {
                return (if new == 0.0 { End::Met } else { End::Indefinite }, iteration - 1);
            }
            dispatch(Advance { factor: new / curvature, d, image, x, r });
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

/// d · A d, in double precision.
fn curvature_of(system: &System, d: &[f32], [exact, image]: &mut [Vec<f64>; 2]) -> f64 {
    exact.iter_mut().zip(d).for_each(|(exact, d)| *exact = f64::from(*d));
    system.apply(exact, image);
    dot(exact, image)
}

/// a · b, in sixteen sums.
pub fn dot<A: Number, B: Number>(a: &[A], b: &[B]) -> f64 {
    dispatch(Dots { a, others: [b] })[0]
}

/// A number of either precision.
pub trait Number: Copy + Into<f64> {}

impl<T: Copy + Into<f64>> Number for T {}

/// Products of one vector with others, each in sixteen sums.
pub struct Dots<'a, A, B, const N: usize> {
    /// The one.
    pub a: &'a [A],
    /// The others, of the same length.
    pub others: [&'a [B]; N],
}

impl<A: Number, B: Number, const N: usize> WithSimd for Dots<'_, A, B, N> {
    type Output = [f64; N];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> [f64; N] {
        let mut sums = [[0.0; 16]; N];
        let (a, a_rest) = self.a.as_chunks::<16>();
        for (sums, b) in sums.iter_mut().zip(self.others) {
            let (b, b_rest) = b.as_chunks::<16>();
            // Sums in a list would go through memory.
            let mut own = [0.0; 16];
            for (a, b) in a.iter().zip(b) {
                for k in 0..16 {
                    own[k] += a[k].into() * b[k].into();
                }
            }
            for (k, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
                own[k] += (*a).into() * (*b).into();
            }
            *sums = own;
        }
        sums.map(|sums| sums.iter().sum())
    }
}

/// d ← z + β d
struct Conjugate<'a> {
    d: &'a mut [f32],
    beta: f32,
    z: &'a [f32],
}

impl WithSimd for Conjugate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (d, z) in self.d.iter_mut().zip(self.z) {
            *d = z + self.beta * *d;
        }
    }
}

/// x ← x + factor · d and r ← r − factor · image
struct Advance<'a> {
    factor: f64,
    d: &'a [f32],
    image: &'a [f32],
    x: &'a mut [f64],
    r: &'a mut [f64],
}

impl WithSimd for Advance<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (x, d) in self.x.iter_mut().zip(self.d) {
            *x += self.factor * f64::from(*d);
        }
        for (r, image) in self.r.iter_mut().zip(self.image) {
            *r -= self.factor * f64::from(*image);
        }
    }
}

/// Takes over a system's matrix on the finest level. Fixed particles have no part in it.
struct Set<'a> {
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    entries: &'a [[u32; 3]],
    system: &'a System,
}

impl WithSimd for Set<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Set { levels, coarsest, entries, system } = self;
        match levels.first_mut() {
            Some(Level::Planes(stencil)) => stencil.numbers.set(system),
            Some(Level::Blocks(finest)) => {
                take_over(&mut finest.swept.matrix, entries, system);
                finest.swept.invert();
            }
            None => {
                take_over(&mut coarsest.matrix, entries, system);
                coarsest.factorize();
            }
        }
    }
}

#[inline(always)]
fn take_over(matrix: &mut Matrix, entries: &[[u32; 3]], system: &System) {
    fill(matrix, entries, &system.blocks, system.pattern.lines.stride);
    for (row, &particle) in system.pattern.order.iter().enumerate() {
        if system.fixed[particle as usize] {
            matrix.forget_diagonal(row);
        }
    }
}

/// The finest level's matrix times a vector.
struct Product<'a> {
    levels: &'a mut [Level],
    system: &'a System,
    x: &'a [f32],
    exact: &'a mut [Vec<f64>; 2],
    out: &'a mut [f32],
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Product { levels, system, x, exact, out } = self;
        match levels.first_mut() {
            Some(Level::Planes(stencil)) => stencil.numbers.multiply(simd, x, out),
            Some(Level::Blocks(finest)) => {
                let Sweeps { swept: Swept { matrix, .. }, x: wide, .. } = &mut **finest;
                let plane = system.pattern.lines.plane;
                for (row, wide) in wide.iter_mut().enumerate() {
                    *wide = Wide::new(&node(x, plane, row));
                }
                for row in 0..wide.len() {
                    let product = matrix.product(simd, matrix.row(row), wide);
                    (0..3).for_each(|k| out[k * plane + row] = product[k]);
                }
            }
            None => {
                curvature_of(system, x, exact);
                out.iter_mut().zip(&exact[1]).for_each(|(out, image)| *out = *image as f32);
            }
        }
    }
}

/// A row's numbers of a vector in planes.
#[inline(always)]
fn node<T: Number>(x: &[T], plane: usize, row: usize) -> Node {
    [single(x[row]), single(x[plane + row]), single(x[2 * plane + row]), 0.0]
}

struct Precondition<'a> {
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    transfers: &'a [Transfer],
    /// Length of a plane of the vectors.
    plane: usize,
    r: &'a [f64],
    z: &'a mut [f32],
}

impl WithSimd for Precondition<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Precondition { levels, coarsest, transfers, plane, r, z } = self;
        match levels.first_mut() {
            Some(Level::Planes(stencil)) => stencil.smooth_towards(simd, r),
            Some(level @ Level::Blocks(_)) => {
                for (row, b) in level.rhs().iter_mut().enumerate() {
                    *b = node(r, plane, row);
                }
                level.smooth_first(simd);
            }
            None => coarsest.x.iter_mut().enumerate().for_each(|(row, b)| *b = node(r, plane, row)),
        }
        for l in 0..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let to = coarse.first_mut().map_or(&mut coarsest.x[..], Level::rhs);
            transfers[l].restrict::<S>(fine[l].left(), to);
            if let Some(coarse) = coarse.first_mut() {
                coarse.smooth_first(simd);
            }
        }
        coarsest.solve();
        for l in (0..levels.len()).rev() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let (fine, transfer) = (&mut fine[l], &transfers[l]);
            match coarse.first() {
                Some(Level::Planes(stencil)) => fine.follow::<S>(
                    transfer,
                    #[inline(always)]
                    |n| stencil.nodes[n],
                ),
                Some(Level::Blocks(sweeps)) => fine.follow::<S>(
                    transfer,
                    #[inline(always)]
                    |n| sweeps.x[n].node(),
                ),
                None => fine.follow::<S>(
                    transfer,
                    #[inline(always)]
                    |n| coarsest.x[n],
                ),
            }
            fine.smooth_last(simd);
            if let (Level::Planes(stencil), true) = (fine, l > 0) {
                stencil.hand_over();
            }
        }
        match levels.first_mut() {
            Some(Level::Planes(stencil)) => z.copy_from_slice(&stencil.x),
            Some(Level::Blocks(finest)) => {
                for (row, x) in finest.x.iter().enumerate() {
                    let x = x.node();
                    (0..3).for_each(|k| z[k * plane + row] = x[k]);
                }
            }
            None => {
                for (row, x) in coarsest.x.iter().enumerate() {
                    (0..3).for_each(|k| z[k * plane + row] = x[k]);
                }
            }
        }
    }
}
