//! Conjugate gradients with a multigrid preconditioner, whose finest level is that of the solve; coarser ones may be those of a while ago
//! (`Coarser` makes them, at once or in turns).
//!
//! Coarse matrices are Galerkin products Pᵀ A P with linear P, made in planes of whole lattices (`Lattice`) or block by block (`Products`);
//! smoothing is one sweep before and one after, forward and backward by Gauss and Seidel, on large levels in two halves, or by damped block
//! Jacobi where a level lies in planes, with `Yarns` on the finest one of a large lattice where solves are long; what obstacles tie together
//! is eliminated (`Patch`); the coarsest level is solved directly [Briggs, Henson & McCormick 2000]. Matrices are single, as reading them is
//! most of the time; what decides is double where rounding matters: no residual is believed else, and no curvature negative. Nothing is
//! allocated after `new`.

#![expect(clippy::needless_range_loop, reason = "components read best by their numbers")]

use crate::{
    cores::Team,
    grid::Grid,
    math::pack::dispatch,
    phase::{Phase, Watch},
    potential::{halves::FEWEST_IN_HALVES, pattern::Pattern, system::System},
};
use coarsen::coarsen;
use coarser::{pairs, single, sources};
use dense::Dense;
use halves::Halves;
use level::{Level, restrict};
use matrix::{Matrix, Node, transposed};
use patch::Patch;
use pulp::{Simd, WithSimd};
use transfer::Transfer;
use yarns::Yarns;

pub use coarser::{Coarser, TURNS};
pub use halves::Residual;

mod coarsen;
mod coarser;
mod dense;
mod halved;
mod halves;
mod lattice;
mod level;
mod matrix;
mod numbers;
mod patch;
mod product;
mod products;
mod stencil;
mod transfer;
mod yarns;

/// Damping of the smoother.
const DAMPING: f32 = 0.5;
/// Iterations of a solve, times particles, after which another core is asked for, unless the last one was longer: less is over before it
/// wakes. On a graded mesh they take longer.
const ALONE: usize = 13_000;
const ALONE_GRADED: usize = 5_000;
/// Rows of a graded mesh's levels from which on two threads sweep a half each: below, what the seam costs is more than what is shared.
const FEWEST_GRADED: usize = 1000;

/// A hierarchy of a mesh's matrices.
pub struct Multigrid {
    /// All but the coarsest.
    levels: Vec<Level>,
    coarsest: Dense,
    patch: Patch,
    /// Where the finest blocks lie in the system's planes, unless they are used so.
    pairs: Vec<[u32; 3]>,
    /// From the finest level to the next, and so on.
    transfers: Vec<Transfer>,
    /// Whether iterations are done in halves, whether the mesh is no lattice, and whether the last solve was long enough for two.
    is_parted: bool,
    is_graded: bool,
    is_long: bool,
    /// Whether the last solve was one of many iterations, so that the next one should have what saves some: yarns, and coarser levels of
    /// the same matrix.
    pub is_hard: bool,
    /// Iterations up to which one that is hard is not followed by another, and beyond which one that is not is followed by one that is.
    hard: [u32; 2],
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
    /// The hierarchy of a mesh, and what makes its coarser levels; from how many iterations on solves are hard says `Accuracy`.
    pub fn new(grid: &Grid, pattern: &Pattern, hard: [u32; 2]) -> (Multigrid, Coarser) {
        let n = pattern.order.len();
        // Lattices lie in planes, which have halves of their own.
        let is_graded = !pattern.lines.are_long();
        let is_parted = n >= if is_graded { FEWEST_GRADED } else { FEWEST_IN_HALVES };
        let fewest = if is_graded { FEWEST_GRADED } else { usize::MAX };
        let sites = pattern.order.iter().map(|&p| grid.site(p as usize)).collect();
        let rows = (0..n).map(|place| {
            let others = pattern.neighbours(place).iter().map(|(p, _)| pattern.place[*p as usize]);
            std::iter::once(place as u32).chain(others).collect()
        });
        let lattice = (n == grid.counts[0] * grid.counts[1]).then_some(grid.counts);
        let (mut matrices, mut transfers) = (vec![Matrix::new(rows.collect(), n >= fewest)], Vec::new());
        let mut counts = lattice;
        for masters in coarsen(sites) {
            let (transfer, coarser) = Transfer::new(&matrices[matrices.len() - 1], masters, counts, fewest);
            counts = transfer.halved.map(|halved| halved.coarse);
            transfers.push(transfer);
            matrices.push(coarser);
        }
        let coarsest = Dense::new(matrices[matrices.len() - 1].clone());
        let coarser = Coarser::new(&pattern.lines, lattice, matrices, &transfers);
        let pairs = match coarser.levels.first() {
            Some(made) if made.is_used_in_planes => Vec::new(),
            made => {
                let finest = made.map_or(&coarsest.matrix, |made| made.matrix());
                pairs(&sources(&pattern.lines, finest), finest)
            }
        };
        let yarns = |l| lattice.filter(|_| l == 0).and_then(|counts| Yarns::new(counts, &pattern.lines));
        let made = coarser.levels.iter().enumerate();
        let levels = made.map(|(l, made)| made.level(is_parted, yarns(l))).collect();
        let (single, double) = (vec![0.0; 3 * pattern.lines.plane], vec![0.0; 3 * pattern.lines.plane]);
        let multigrid = Multigrid {
            levels,
            coarsest,
            patch: Patch::new(n, (0..n).map(|place| pattern.neighbours(place).len()).max().unwrap_or(0)),
            pairs,
            transfers,
            is_parted,
            is_graded,
            is_long: false,
            is_hard: true,
            hard,
            residual: double.clone(),
            direction: single.clone(),
            image: single.clone(),
            preconditioned: single,
            exact: [double.clone(), double],
        };
        (multigrid, coarser)
    }

    /// Whether the next solve should have both cores: what is made beside then waits for its end.
    pub fn is_for_two(&self) -> bool {
        self.is_parted && (self.is_long || !self.is_graded)
    }

    /// Work up to which a solve is one thread's.
    fn alone(&self) -> usize {
        if self.is_graded { ALONE_GRADED } else { ALONE }
    }

    /// Has a helper come where there is work for two, unless the last solve was over before it had.
    pub fn call(&self, team: &Team) {
        if self.is_parted && self.is_long {
            team.call(self.residual.len() / 3);
        }
    }

    /// Forgets what past solves took.
    pub fn forget(&mut self) {
        self.is_hard = true;
    }

    /// Takes over the system's matrix on the finest level.
    pub fn set(&mut self, system: &System, team: &Team) {
        let Multigrid { levels, coarsest, patch, pairs, is_hard, .. } = self;
        patch.set(system);
        match levels.first_mut() {
            Some(Level::Planes(stencil)) => stencil.set(system, *is_hard, team),
            Some(Level::Blocks(finest)) => {
                dispatch(TakeOver { matrix: &mut finest.swept.matrix, pairs, system });
                finest.swept.invert();
            }
            None => {
                dispatch(TakeOver { matrix: &mut coarsest.matrix, pairs, system });
                coarsest.factorize();
            }
        }
    }

    /// Makes all coarser levels of the finest one.
    pub fn renew(&mut self, coarser: &mut Coarser, team: &Team) {
        self.lend(coarser);
        coarser.make(team);
        self.lend(coarser);
        self.take(coarser);
    }

    /// Exchanges the finest level's matrix with the one that coarser ones are made of, before it is set anew.
    pub fn lend(&mut self, coarser: &mut Coarser) {
        if let (Some(level), Some(made)) = (self.levels.first_mut(), coarser.levels.first_mut()) {
            made.exchange(level);
        }
    }

    /// Takes over coarser levels that are finished.
    pub fn take(&mut self, coarser: &mut Coarser) {
        for (level, made) in self.levels.iter_mut().zip(&mut coarser.levels).skip(1) {
            made.exchange(level);
        }
        if !self.transfers.is_empty() {
            std::mem::swap(&mut self.coarsest, &mut coarser.coarsest);
        }
        coarser.done = 0;
    }

    /// Improves `x` towards A x = b by conjugate gradients, until `is_met`, asked with each residual b − A x, says so, with what it may be
    /// off by.
    /// Gives how it ended and the iterations it took; `team`, called where that is long, stays. All vectors are in planes in the order of the lattice, zero for fixed particles.
    pub fn solve(
        &mut self,
        system: &System,
        (b, x): (&[f64], &mut [f64]),
        iterations: u32,
        is_met: impl FnMut(Residual) -> Option<f64>,
        team: &Team,
        watch: Watch,
    ) -> (End, u32) {
        let (end, taken) = self.iterate(system, (b, x), iterations, is_met, team, watch);
        if iterations > 1 {
            self.is_long = taken as usize * system.pattern.lines.plane > self.alone();
            self.is_hard = taken > self.hard[usize::from(!self.is_hard)];
        }
        (end, taken)
    }

    fn iterate(
        &mut self,
        system: &System,
        (b, x): (&[f64], &mut [f64]),
        iterations: u32,
        mut is_met: impl FnMut(Residual) -> Option<f64>,
        team: &Team,
        watch: Watch,
    ) -> (End, u32) {
        let (is_parted, is_long, alone) = (self.is_parted, self.is_long, self.alone());
        let Multigrid { levels, coarsest, transfers, patch, exact, .. } = self;
        // A helper may have come for what is more than an iteration.
        let team = if is_parted { team } else { Team::nobody() };
        let (r, d, image, z) =
            (&mut self.residual, &mut self.direction, &mut self.image, &mut self.preconditioned);
        let plane = system.pattern.lines.plane;
        let middle = levels.first().map_or(plane / 2, |finest| finest.middle(plane));
        let halves = Halves { team, middle };
        // In single: what ends the iteration is made anew.
        d.iter_mut().zip(&*x).for_each(|(d, x)| *d = *x as f32);
        multiply(levels, team, system, d, exact, image);
        r.iter_mut().zip(b.iter().zip(&*image)).for_each(|(r, (b, image))| *r = b - f64::from(*image));
        d.fill(0.0);
        if is_met(Residual { r, halves }).is_some() {
            system.leave(team, b, x, exact, r);
            if is_met(Residual { r, halves }).is_some() {
                return (End::Met, 0);
            }
        }
        let (mut restarts, mut old) = (true, 0.0);
        for iteration in 1..=iterations {
            if is_parted && (is_long || iteration as usize * plane > alone) {
                team.call(plane);
            }
            patch.enter(plane, r);
            precondition(levels, coarsest, transfers, team, plane, r, z);
            patch.leave(plane, r, z);
            let [new] = halves.dots(r, [z]);
            let beta = if restarts { 0.0 } else { new / old };
            (old, restarts) = (new, false);
            halves.conjugate(d, beta as f32, z);
            multiply(levels, team, system, d, exact, image);
            let [mut curvature] = halves.dots(d, [image]);
            if curvature <= 0.0 {
                // That may be rounding.
                curvature = curvature_of(system, d, exact);
            }
            // Not a number counts as negative. In single precision the answer to a residual may be nothing where stiffness is beyond its range:
            // that solves nothing.
            if !(curvature > 0.0 && new > 0.0) {
                let is_zero = Residual { r, halves }.square() == 0.0;
                let nothing = if is_zero { End::Met } else { End::Spent };
                return (if new == 0.0 { nothing } else { End::Indefinite }, iteration - 1);
            }
            halves.advance(new / curvature, d, image, x, r);
            let mut met = is_met(Residual { r, halves });
            // Residuals are updated by products in single precision: before one is believed whose rounding may matter it is made anew.
            let is_believed = met.is_some_and(|off| system.rounding(team, x) <= off);
            if met.is_some() && !is_believed {
                system.leave(team, b, x, exact, r);
                restarts = true;
                met = is_met(Residual { r, halves });
            }
            watch.ended(Phase::Iteration);
            if met.is_some() {
                return (End::Met, iteration);
            }
        }
        (End::Spent, iterations)
    }
}

/// d · A d, in double precision.
fn curvature_of(system: &System, d: &[f32], [exact, image]: &mut [Vec<f64>; 2]) -> f64 {
    exact.iter_mut().zip(d).for_each(|(exact, d)| *exact = f64::from(*d));
    system.apply(exact, image);
    exact.iter().zip(image).map(|(d, image)| d * *image).sum()
}

/// Takes over a system's matrix by blocks. Fixed particles have no part in it.
struct TakeOver<'a> {
    matrix: &'a mut Matrix,
    pairs: &'a [[u32; 3]],
    system: &'a System,
}

impl WithSimd for TakeOver<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let TakeOver { matrix, pairs, system } = self;
        let stride = system.pattern.lines.stride;
        let planes: [&[f64]; 9] = std::array::from_fn(|k| &system.blocks[k * stride..][..stride]);
        for row in 0..matrix.len() {
            // What is on and below the diagonal.
            let [a, _, _, b, d, _, c, e, f] = planes.map(|plane| single(plane[row]));
            *matrix.block_mut(matrix.starts[row] as usize) = [a, b, c, b, d, e, c, e, f];
        }
        // Each is read once, as its numbers lie far apart. Blocks go column by column.
        for &[at, place, turned] in pairs {
            let block = planes.map(|plane| single(plane[at as usize]));
            *matrix.block_mut(place as usize) = transposed(&block);
            *matrix.block_mut(turned as usize) = block;
        }
        for (row, &particle) in system.pattern.order.iter().enumerate() {
            if system.fixed[particle as usize] {
                matrix.forget_diagonal(row);
            }
        }
    }
}

/// The finest level's matrix times a vector.
fn multiply(
    levels: &mut [Level],
    team: &Team,
    system: &System,
    x: &[f32],
    exact: &mut [Vec<f64>; 2],
    out: &mut [f32],
) {
    match levels.first_mut() {
        Some(Level::Planes(stencil)) => stencil.multiply(team, x, out),
        Some(Level::Blocks(finest)) => {
            finest.multiply(team, system.pattern.lines.plane, x, out);
        }
        None => {
            curvature_of(system, x, exact);
            out.iter_mut().zip(&exact[1]).for_each(|(out, image)| *out = *image as f32);
        }
    }
}

/// A row's numbers of a vector in planes.
#[inline(always)]
fn node<T: Copy + Into<f64>>(x: &[T], plane: usize, row: usize) -> Node {
    [single(x[row]), single(x[plane + row]), single(x[2 * plane + row]), 0.0]
}

/// z = B r by one V-cycle B, in planes of this length.
fn precondition(
    levels: &mut [Level],
    coarsest: &mut Dense,
    transfers: &[Transfer],
    team: &Team,
    plane: usize,
    r: &[f64],
    z: &mut [f32],
) {
    match levels.first_mut() {
        Some(Level::Planes(stencil)) => stencil.smooth_towards(team, r),
        Some(level @ Level::Blocks(_)) => {
            level.rhs().iter_mut().enumerate().for_each(|(row, b)| *b = node(r, plane, row));
            level.smooth_first(team);
        }
        None => coarsest.x.iter_mut().enumerate().for_each(|(row, b)| *b = node(r, plane, row)),
    }
    for l in 0..levels.len() {
        let (fine, coarse) = levels.split_at_mut(l + 1);
        let to = coarse.first_mut().map_or(&mut coarsest.x[..], Level::rhs);
        restrict(team, &transfers[l], fine[l].left(), to);
        if let Some(coarse) = coarse.first_mut() {
            coarse.smooth_first(team);
        }
    }
    coarsest.solve();
    for l in (0..levels.len()).rev() {
        let (fine, coarse) = levels.split_at_mut(l + 1);
        let (fine, transfer) = (&mut fine[l], &transfers[l]);
        match coarse.first() {
            Some(Level::Planes(stencil)) => fine.follow(
                team,
                transfer,
                #[inline(always)]
                |n| stencil.nodes[n],
            ),
            Some(Level::Blocks(sweeps)) => fine.follow(
                team,
                transfer,
                #[inline(always)]
                |n| sweeps.x[n].node(),
            ),
            None => fine.follow(
                team,
                transfer,
                #[inline(always)]
                |n| coarsest.x[n],
            ),
        }
        match fine {
            Level::Planes(stencil) if l == 0 => stencil.smooth_into(team, z),
            _ => fine.smooth_last(team),
        }
    }
    let mut solved = |row: usize, x: Node| (0..3).for_each(|k| z[k * plane + row] = x[k]);
    match levels.first() {
        Some(Level::Planes(_)) => {}
        Some(Level::Blocks(finest)) => finest.x.iter().enumerate().for_each(|(row, x)| solved(row, x.node())),
        None => coarsest.x.iter().enumerate().for_each(|(row, x)| solved(row, *x)),
    }
}
