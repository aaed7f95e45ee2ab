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
    potential::system::{Pattern, System},
};
use coarsen::{Masters, coarsen};
use dense::Dense;
use matrix::{Block, Matrix, Node, Wide, fused, inverse, transposed};
use pulp::{Simd, WithSimd};
use std::ops::Range;
use stencil::Stencil;

mod coarsen;
mod dense;
mod matrix;
mod stencil;

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

/// How a level hangs together with the next coarser one.
struct Transfer {
    /// First master of each particle, masters, weights.
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

/// How much of the coarser levels is built anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// All.
    All,
    /// One of `TURNS` that together make all, of about the same length.
    Turn(u32),
}

/// Turns in which coarser levels are built: the finest blocks are copied; half of the next matrix; the other half; all beyond.
pub const TURNS: u32 = 4;

impl Part {
    /// Whether it holds this turn.
    fn has(self, turn: u32) -> bool {
        self == Part::All || self == Part::Turn(turn)
    }
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

impl Transfer {
    /// From a matrix and masters of its rows; and the next coarser matrix, empty.
    fn new(matrix: &Matrix, masters: Vec<Masters>) -> (Transfer, Matrix) {
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
        products.sort_by_key(|&(a, b, place, _)| (a, b, place));
        let coarser = Matrix::new(columns);
        let mut targets: Vec<[u32; 3]> = Vec::new();
        let mut last = None;
        for (end, &(a, b, ..)) in products.iter().enumerate() {
            if last != Some((a, b)) {
                let place = |a, b| coarser.place(a, b).expect("a block of the pattern");
                targets.push([place(a, b), place(b, a), 0]);
                last = Some((a, b));
            }
            targets.last_mut().expect("just pushed")[2] = end as u32 + 1;
        }
        let mut starts = vec![0];
        masters.iter().for_each(|m| starts.push(starts[starts.len() - 1] + m.len() as u32));
        let flat = masters.concat();
        let transfer = Transfer {
            starts,
            masters: flat.iter().map(|m| m.0).collect(),
            weights: flat.iter().map(|m| m.1).collect(),
            targets,
            products: products.iter().map(|p| (p.2, p.3)).collect(),
        };
        (transfer, coarser)
    }

    /// Computes the blocks of the next matrix that lie in this range of the targets.
    #[inline(always)]
    fn coarser<S: Simd>(&self, simd: S, from: &Matrix, to: &mut Matrix, range: Range<usize>) {
        let mut start = range.start.checked_sub(1).map_or(0, |last| self.targets[last][2] as usize);
        for &[place, mirrored, end] in &self.targets[range] {
            // Two sums, so that additions need not wait for each other.
            let (mut sum, mut other) = ([0.0; 16], [0.0; 16]);
            let (pairs, rest) = self.products[start..end as usize].as_chunks::<2>();
            for &[(a, u), (b, v)] in pairs {
                plus(simd, &mut sum, from.window(a as usize), u);
                plus(simd, &mut other, from.window(b as usize), v);
            }
            for &(block, weight) in rest {
                plus(simd, &mut sum, from.window(block as usize), weight);
            }
            plus(simd, &mut sum, &other, 1.0);
            start = end as usize;
            let block: Block = std::array::from_fn(|k| sum[k]);
            *to.block_mut(place as usize) = block;
            if mirrored != place {
                *to.block_mut(mirrored as usize) = transposed(&block);
            }
        }
    }

    /// Computes the next matrix, or the half of it whose turn it is.
    #[inline(always)]
    fn coarser_in_turns<S: Simd>(&self, simd: S, from: &Matrix, to: &mut Matrix, part: Part) {
        let all = self.targets.len();
        let from_to = if part.has(1) { 0 } else { all / 2 }..if part.has(2) { all } else { all / 2 };
        self.coarser(simd, from, to, from_to);
    }

    #[inline(always)]
    fn restrict<S: Simd>(&self, from: &[Node], to: &mut [Node]) {
        to.fill([0.0; 4]);
        for (row, r) in from.iter().enumerate() {
            for m in self.starts[row] as usize..self.starts[row + 1] as usize {
                let (to, weight) = (&mut to[self.masters[m] as usize], self.weights[m]);
                for k in 0..4 {
                    to[k] = fused::<S>(r[k], weight, to[k]);
                }
            }
        }
    }

    /// What a row follows of its masters.
    #[inline(always)]
    fn followed<S: Simd>(&self, row: usize, from: impl Fn(usize) -> Node) -> Node {
        let mut x = [0.0; 4];
        for m in self.starts[row] as usize..self.starts[row + 1] as usize {
            let (from, weight) = (from(self.masters[m] as usize), self.weights[m]);
            for k in 0..4 {
                x[k] = fused::<S>(from[k], weight, x[k]);
            }
        }
        x
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

/// sum += block · weight, and so for what lies behind the block.
#[inline(always)]
fn plus<S: Simd>(simd: S, sum: &mut [f32; 16], block: &[f32; 16], weight: f32) {
    let weight = simd.splat_f32s(weight);
    for (sum, block) in S::as_mut_simd_f32s(sum).0.iter_mut().zip(S::as_simd_f32s(block).0) {
        *sum = simd.mul_add_e_f32s(*block, weight, *sum);
    }
}

struct Build<'a> {
    top: &'a mut Top,
    levels: &'a mut [Level],
    coarsest: &'a mut Dense,
    entries: &'a [[u32; 3]],
    system: &'a System,
    part: Part,
}

impl WithSimd for Build<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Build { top, levels, coarsest, entries, system, part } = self;
        match top {
            Top::Planes(stencil, finest) => {
                let Finest { matrix, transfer, .. } = &mut **finest;
                stencil.set(simd, system);
                if part.has(0) {
                    fill(matrix, entries, system);
                }
                let to = levels.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
                transfer.coarser_in_turns(simd, matrix, to, part);
            }
            Top::Blocks => match levels.split_first_mut() {
                Some((finest, coarse)) => {
                    fill(&mut finest.matrix, entries, system);
                    finest.invert();
                    let to = coarse.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
                    finest.transfer.coarser_in_turns(simd, &finest.matrix, to, part);
                }
                None => {
                    fill(&mut coarsest.matrix, entries, system);
                    return coarsest.factorize();
                }
            },
        }
        let first = usize::from(matches!(top, Top::Blocks));
        // What a sweep leaves is right only where inverses are those of the blocks, new or not.
        levels[first..].iter_mut().take(1).for_each(Level::invert);
        if !part.has(TURNS - 1) {
            return;
        }
        for l in first..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            if l > first {
                fine.invert();
            }
            let to = coarse.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
            fine.transfer.coarser(simd, &fine.matrix, to, 0..fine.transfer.targets.len());
        }
        coarsest.factorize();
    }
}

/// Places of each pair's block in the planes and, straight and transposed, in the finest matrix: the diagonals, then the pairs.
fn entries(pattern: &Pattern, matrix: &Matrix) -> Vec<[u32; 3]> {
    let mut entries: Vec<[u32; 3]> = matrix
        .starts
        .iter()
        .zip(0..pattern.order.len())
        .map(|(&start, n)| [n as u32, start, start])
        .collect();
    for run in &pattern.runs {
        for k in 0..run.len {
            let [first, second] = [run.first + k, run.second + k].map(|n| n as u32);
            // Where lines end there is no pair.
            if let Some(straight) = matrix.place(first, second) {
                let turned = matrix.place(second, first).expect("a symmetric pattern");
                entries.push([(run.at + k) as u32, straight, turned]);
            }
        }
    }
    entries
}

/// Blocks from planes. Fixed particles have no part in the matrix.
#[inline(always)]
fn fill(matrix: &mut Matrix, entries: &[[u32; 3]], system: &System) {
    let (order, stride) = (&system.pattern.order, system.pattern.stride);
    let plane = |k: usize| &system.blocks[k * stride..][..stride];
    let [p0, p1, p2, p3, p4, p5, p6, p7, p8] =
        [plane(0), plane(1), plane(2), plane(3), plane(4), plane(5), plane(6), plane(7), plane(8)];
    let (own, pairs) = entries.split_at(order.len());
    for (&[at, place, _], &particle) in own.iter().zip(order) {
        let k = at as usize;
        // Of the diagonals only what lies on and below theirs counts.
        let [a, b, c, d, e, f] = [p0[k], p3[k], p6[k], p4[k], p7[k], p8[k]].map(|value| value as f32);
        *matrix.block_mut(place as usize) =
            if system.fixed[particle as usize] { [0.0; 9] } else { [a, b, c, b, d, e, c, e, f] };
    }
    for &[at, straight, turned] in pairs {
        let k = at as usize;
        let b = [p0[k], p1[k], p2[k], p3[k], p4[k], p5[k], p6[k], p7[k], p8[k]].map(|value| value as f32);
        // Blocks go column by column.
        *matrix.block_mut(straight as usize) = transposed(&b);
        *matrix.block_mut(turned as usize) = b;
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
