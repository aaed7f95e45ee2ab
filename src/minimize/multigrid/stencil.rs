//! A level in single precision, plane by plane: whole registers of neighbouring particles, smoothed by block Jacobi.

use super::{
    DAMPING,
    halves::{parts, parts_mut},
    matrix::Node,
    transfer::Transfer,
};
use crate::{
    math::pack::dispatch,
    minimize::cores::Team,
    potential::{
        pattern::{Lines, PADDING, Run, plane},
        system::System,
    },
};
use pulp::{Simd, WithSimd};
use std::{ops::Range, sync::Arc};

/// Rows that are done with before the next ones begin, so that what goes with them stays in the nearest cache.
const TILE: usize = 512;

/// A matrix in planes.
#[derive(Clone)]
pub struct Numbers {
    /// How it lies.
    pub lines: Arc<Lines>,
    /// Planes of the blocks, those of the diagonals whole.
    pub blocks: Vec<f32>,
    /// Damped inverses of the diagonal blocks: 00, 10, 11, 20, 21, 22.
    inverses: Vec<f32>,
}

/// Matrix, smoother and vectors of a level.
pub struct Stencil {
    /// The matrix.
    pub numbers: Numbers,
    /// What it solves for, before it is smoothed for the last time.
    x: Vec<f32>,
    b: Vec<f32>,
    halves: [Half; 2],
    /// By nodes: what the first smoothing left, then the solution.
    pub nodes: Vec<Node>,
    /// The right-hand side of a level that is not the finest.
    pub rhs: Vec<Node>,
}

type Three<S> = [<S as Simd>::f32s; 3];

#[inline(always)]
fn load<S: Simd>(_: S, list: &[f32], at: usize) -> S::f32s {
    S::as_simd_f32s(&list[at..at + S::F32_LANES]).0[0]
}

#[inline(always)]
fn store<S: Simd>(_: S, list: &mut [f32], at: usize, value: S::f32s) {
    S::as_mut_simd_f32s(&mut list[at..at + S::F32_LANES]).0[0] = value;
}

#[inline(always)]
fn load3<S: Simd>(simd: S, list: &[f32], plane: usize, at: usize) -> Three<S> {
    [load(simd, list, at), load(simd, list, plane + at), load(simd, list, 2 * plane + at)]
}

/// Row of a matrix times a vector.
#[inline(always)]
fn row<S: Simd>(simd: S, a: S::f32s, b: S::f32s, c: S::f32s, x: Three<S>) -> S::f32s {
    simd.mul_add_e_f32s(a, x[0], simd.mul_add_e_f32s(b, x[1], simd.mul_f32s(c, x[2])))
}

#[inline(always)]
fn load9<S: Simd>(simd: S, blocks: &[f32], stride: usize, at: usize) -> [S::f32s; 9] {
    let mut own = [simd.splat_f32s(0.0); 9];
    for (k, own) in own.iter_mut().enumerate() {
        *own = load(simd, blocks, k * stride + at);
    }
    own
}

/// Adds a block times a vector to `out`.
#[inline(always)]
fn add<S: Simd>(simd: S, b: [S::f32s; 9], x: Three<S>, out: &mut [f32], plane: usize, at: usize) {
    for k in 0..3 {
        let at = k * plane + at;
        let [a, b, c] = [b[3 * k], b[3 * k + 1], b[3 * k + 2]];
        let sum = simd.mul_add_e_f32s(c, x[2], load(simd, out, at));
        store(simd, out, at, simd.mul_add_e_f32s(a, x[0], simd.mul_add_e_f32s(b, x[1], sum)));
    }
}

#[inline(always)]
fn turned<T: Copy>(b: [T; 9]) -> [T; 9] {
    [b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]]
}

impl Numbers {
    /// Memory for a matrix.
    pub fn new(lines: Arc<Lines>) -> Numbers {
        let (blocks, inverses) = (vec![0.0; 9 * lines.stride], vec![0.0; 6 * lines.plane]);
        Numbers { lines, blocks, inverses }
    }

    /// Takes over a system's matrix. Fixed particles have no part in it.
    #[inline(always)]
    pub fn set(&mut self, system: &System) {
        for (to, from) in self.blocks.iter_mut().zip(&system.blocks) {
            *to = *from as f32;
        }
        let (n, stride) = (self.lines.particles, self.lines.stride);
        for (place, &particle) in system.pattern.order.iter().enumerate() {
            if system.fixed[particle as usize] {
                (0..9).for_each(|k| self.blocks[k * stride + place] = 0.0);
            }
        }
        for [from, to] in [[3, 1], [6, 2], [7, 5]] {
            self.blocks.copy_within(from * stride..from * stride + n, to * stride);
        }
        self.invert();
    }

    /// What is no inverse of a positive definite block becomes zero.
    #[inline(always)]
    pub fn invert(&mut self) {
        let Lines { particles: n, stride, plane, .. } = *self.lines;
        let of = |k: usize| &self.blocks[k * stride..k * stride + n];
        let [a, b, c, d, e, f] = [of(0), of(3), of(6), of(4), of(7), of(8)];
        let (p0, rest) = self.inverses.split_at_mut(plane);
        let (p1, rest) = rest.split_at_mut(plane);
        let (p2, rest) = rest.split_at_mut(plane);
        let (p3, rest) = rest.split_at_mut(plane);
        let (p4, p5) = rest.split_at_mut(plane);
        let (p0, p1, p2) = (&mut p0[..n], &mut p1[..n], &mut p2[..n]);
        let (p3, p4, p5) = (&mut p3[..n], &mut p4[..n], &mut p5[..n]);
        let damping = f64::from(DAMPING);
        for k in 0..n {
            let [a, b, c] = [f64::from(a[k]), f64::from(b[k]), f64::from(c[k])];
            let [d, e, f] = [f64::from(d[k]), f64::from(e[k]), f64::from(f[k])];
            let (p, q, r) = (d * f - e * e, c * e - b * f, b * e - c * d);
            let determinant = a * p + b * q + c * r;
            let scale = if determinant > 0.0 { damping / determinant } else { 0.0 };
            p0[k] = (p * scale) as f32;
            p1[k] = (q * scale) as f32;
            p2[k] = ((a * f - c * c) * scale) as f32;
            p3[k] = (r * scale) as f32;
            p4[k] = ((b * c - a * e) * scale) as f32;
            p5[k] = ((a * d - b * b) * scale) as f32;
        }
    }

    /// A x − b, without b A x, in two halves; `finish` gets the rows of each as they are done.
    fn multiply<F: Finish>(
        &self,
        team: &Team,
        b: Option<&[f32]>,
        x: &[f32],
        [low, high]: &mut [Half; 2],
        [finish, other]: &mut [F; 2],
    ) {
        let numbers = self;
        let from = low.end;
        team.both(
            || dispatch(Multiply { numbers, b, x, half: low, finish, from: 0 }),
            || dispatch(Multiply { numbers, b, x, half: high, finish: other, from }),
        );
        high.take_over(low);
        dispatch(Close { half: high, finish: other, end: from });
    }
}

/// What becomes of the rows of a product.
trait Finish: Send {
    /// Takes rows that are done; the first is a multiple of a register's length.
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, half: &Half);
}

/// The first rows of a product, or the others. Pairs belong to the half of their first particle, so the first half has room for what its
/// pairs give to rows of the other one: sums do not depend on who does which half.
struct Half {
    /// Its rows, the first a multiple of a register's length.
    rows: Range<usize>,
    /// Where those end that its pairs reach, another such multiple.
    end: usize,
    /// Its pairs that do not stand in line.
    loose: Vec<Run>,
    plane: usize,
    sums: Vec<f32>,
}

impl Half {
    /// Both halves of a matrix' rows: about as long as each other, or all rows in the first if they are to stay together or pairs reach too
    /// far.
    fn both(lines: &Lines, is_parted: bool) -> [Half; 2] {
        let n = lines.particles;
        let middle = (n / 2).next_multiple_of(PADDING);
        let parted = if is_parted { Half::parted(lines, middle) } else { None };
        parted.unwrap_or_else(|| {
            let loose = lines.runs.iter().filter(|run| !run.is_padded).copied();
            [Half::new(0..n, n, loose.collect()), Half::new(n..n, n, Vec::new())]
        })
    }

    /// The rows before the middle and the others, if pairs reach no farther than to one another.
    fn parted(lines: &Lines, middle: usize) -> Option<[Half; 2]> {
        let n = lines.particles;
        let (mut low, mut high, mut end) = (Vec::new(), Vec::new(), middle);
        for run in &lines.runs {
            let before = middle.saturating_sub(run.first).min(run.len);
            if before > 0 {
                end = end.max(run.second + before);
            }
            if !run.is_padded {
                let [at, first, second] = [run.at, run.first, run.second].map(|place| place + before);
                low.push(Run { len: before, ..*run });
                high.push(Run { at, first, second, len: run.len - before, ..*run });
            }
        }
        let end = end.next_multiple_of(PADDING);
        (end < n).then(|| [Half::new(0..middle, end, low), Half::new(middle..n, n, high)])
    }

    fn new(rows: Range<usize>, end: usize, loose: Vec<Run>) -> Half {
        let plane = plane(end - rows.start);
        Half { rows, end, loose, plane, sums: vec![0.0; 3 * plane] }
    }

    /// Adds what the other half's pairs gave to rows of this one.
    fn take_over(&mut self, low: &Half) {
        for k in 0..3 {
            let from = &low.sums[k * low.plane..][low.rows.end..low.end];
            self.sums[k * self.plane..].iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
    }
}

struct Multiply<'a, F> {
    numbers: &'a Numbers,
    b: Option<&'a [f32]>,
    x: &'a [f32],
    half: &'a mut Half,
    finish: &'a mut F,
    /// Rows from here on are done when the half is.
    from: usize,
}

impl<F: Finish> WithSimd for Multiply<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Multiply { numbers, b, x, half, finish, from } = self;
        let plane = numbers.lines.plane;
        match b {
            None => half.sums.fill(0.0),
            Some(b) => {
                let rows = half.rows.clone();
                for k in 0..3 {
                    let (own, beyond) = half.sums[k * half.plane..][..half.plane].split_at_mut(rows.len());
                    for (sum, b) in own.iter_mut().zip(&b[k * plane..][rows.clone()]) {
                        *sum = -b;
                    }
                    beyond.fill(0.0);
                }
            }
        }
        let loose = std::mem::take(&mut half.loose);
        for run in &loose {
            (0..run.len).for_each(|k| add_one(numbers, run, k, x, half));
        }
        half.loose = loose;
        let Range { start, end } = half.rows;
        for from_row in (start..end).step_by(TILE) {
            let tile = from_row..(from_row + TILE).min(end);
            add_tile(simd, numbers, tile.clone(), x, half);
            let done = tile.start.max(from)..tile.end;
            if !done.is_empty() {
                finish.finish(simd, done, half);
            }
        }
    }
}

/// Finishes the rows that both halves gave to.
struct Close<'a, F> {
    half: &'a Half,
    finish: &'a mut F,
    end: usize,
}

impl<F: Finish> WithSimd for Close<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let rows = self.half.rows.start..self.end.min(self.half.rows.end);
        if !rows.is_empty() {
            self.finish.finish(simd, rows, self.half);
        }
    }
}

/// Adds to A x − b what the pairs give whose first particle is in the tile, and the diagonals. With the tiles before, that completes its
/// rows; later tiles do not look at them any more.
#[inline(always)]
fn add_tile<S: Simd>(simd: S, numbers: &Numbers, tile: Range<usize>, x: &[f32], half: &mut Half) {
    let (lines, blocks) = (&*numbers.lines, &numbers.blocks[..]);
    let Lines { plane, stride, .. } = *lines;
    let (own, start, sums) = (half.plane, half.rows.start, &mut half.sums[..]);
    // Registers are counted from the first of each list, which spares the loops much arithmetic of places.
    let registers = |rows: usize| (0..rows).step_by(S::F32_LANES);
    let (at, to) = (tile.start, tile.start - start);
    for k in registers(tile.len()) {
        add(simd, load9(simd, blocks, stride, at + k), load3(simd, x, plane, at + k), sums, own, to + k);
    }
    for run in lines.runs.iter().filter(|run| run.is_padded) {
        let rows = registers(tile.end.min(run.len).saturating_sub(tile.start));
        let [at, first, second] = [run.at, run.first, run.second].map(|place| place + tile.start);
        let (to_first, to_second) = (first - start, second - start);
        if second - first > 32 {
            for k in rows {
                let block = load9(simd, blocks, stride, at + k);
                add(simd, block, load3(simd, x, plane, second + k), sums, own, to_first + k);
                add(simd, turned(block), load3(simd, x, plane, first + k), sums, own, to_second + k);
            }
        } else {
            // What one line stores the next would load before it is there.
            for k in rows.clone() {
                let block = load9(simd, blocks, stride, at + k);
                add(simd, block, load3(simd, x, plane, second + k), sums, own, to_first + k);
            }
            for k in rows {
                let block = turned(load9(simd, blocks, stride, at + k));
                add(simd, block, load3(simd, x, plane, first + k), sums, own, to_second + k);
            }
        }
    }
}

impl Stencil {
    /// With room for vectors, whose rows come in halves or not.
    pub fn new(numbers: Numbers, is_parted: bool) -> Stencil {
        let halves = Half::both(&numbers.lines, is_parted);
        let Lines { particles, plane, .. } = *numbers.lines;
        let (zeros, nodes) = (vec![0.0; 3 * plane], vec![[0.0; 4]; particles]);
        Stencil { numbers, x: zeros.clone(), b: zeros, halves, rhs: nodes.clone(), nodes }
    }

    /// First row of the second half.
    pub fn middle(&self) -> usize {
        self.halves[1].rows.start
    }

    /// out = A x
    pub fn multiply(&mut self, team: &Team, x: &[f32], out: &mut [f32]) {
        let middle = self.middle();
        let Stencil { numbers, halves, .. } = self;
        let [low, high] = parts_mut(out, middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Image { out, from });
        numbers.multiply(team, None, x, halves, &mut finish);
    }

    /// Starts from zero towards the right-hand side and leaves what is left.
    pub fn smooth_first(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, rhs, .. } = self;
        let (numbers, n) = (&*numbers, numbers.lines.particles);
        let ([x, x_high], [b, b_high]) = (parts_mut(x, middle), parts_mut(b, middle));
        let (low, high) = rhs.split_at(middle);
        team.both(
            || dispatch(Begin { numbers, rhs: ByNodes(low), b, x, rows: 0..middle }),
            || dispatch(Begin { numbers, rhs: ByNodes(high), b: b_high, x: x_high, rows: middle..n }),
        );
        self.leave(team);
    }

    /// The same towards a right-hand side in planes.
    pub fn smooth_towards(&mut self, team: &Team, rhs: &[f64]) {
        let middle = self.middle();
        let Stencil { numbers, x, b, .. } = self;
        let (numbers, n) = (&*numbers, numbers.lines.particles);
        let ([x, x_high], [b, b_high]) = (parts_mut(x, middle), parts_mut(b, middle));
        let [low, high] = parts(rhs, middle);
        team.both(
            || dispatch(Begin { numbers, rhs: ByPlanes(low), b, x, rows: 0..middle }),
            || dispatch(Begin { numbers, rhs: ByPlanes(high), b: b_high, x: x_high, rows: middle..n }),
        );
        self.leave(team);
    }

    fn leave(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, halves, nodes, .. } = self;
        let (low, high) = nodes.split_at_mut(middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Left { out, from });
        numbers.multiply(team, Some(b), x, halves, &mut finish);
    }

    /// Adds what a coarser level solved.
    pub fn follow(&mut self, team: &Team, transfer: &Transfer, coarser: impl Fn(usize) -> Node + Sync) {
        let middle = self.middle();
        let Stencil { numbers, x, .. } = self;
        let [low, high] = parts_mut(x, middle);
        let (numbers, coarser, n) = (&*numbers, &coarser, numbers.lines.particles);
        team.both(
            || dispatch(Follow { numbers, transfer, coarser, x: low, rows: 0..middle }),
            || dispatch(Follow { numbers, transfer, coarser, x: high, rows: middle..n }),
        );
    }

    /// Smooths once more, into a solution in planes.
    pub fn smooth_into(&mut self, team: &Team, z: &mut [f32]) {
        let middle = self.middle();
        let Stencil { numbers, x, b, halves, .. } = self;
        let (numbers, x) = (&*numbers, &x[..]);
        let [low, high] = parts_mut(z, middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Smoothed { numbers, x, out, from });
        numbers.multiply(team, Some(b), x, halves, &mut finish);
    }

    /// Smooths once more, into a solution by nodes, as finer levels follow it.
    pub fn smooth_last(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, halves, nodes, .. } = self;
        let (numbers, x) = (&*numbers, &x[..]);
        let (low, high) = nodes.split_at_mut(middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Solved { numbers, x, out, from });
        numbers.multiply(team, Some(b), x, halves, &mut finish);
    }
}

/// Some rows of a right-hand side, by nodes or in planes.
trait Rows {
    /// Lays them in planes.
    fn lay(&self, b: &mut [&mut [f32]; 3]);
}

struct ByNodes<'a>(&'a [Node]);

impl Rows for ByNodes<'_> {
    #[inline(always)]
    fn lay(&self, [b0, b1, b2]: &mut [&mut [f32]; 3]) {
        for (node, (b0, (b1, b2))) in self.0.iter().zip(b0.iter_mut().zip(b1.iter_mut().zip(b2.iter_mut()))) {
            [*b0, *b1, *b2, _] = *node;
        }
    }
}

struct ByPlanes<'a>([&'a [f64]; 3]);

impl Rows for ByPlanes<'_> {
    #[inline(always)]
    fn lay(&self, b: &mut [&mut [f32]; 3]) {
        for (to, from) in b.iter_mut().zip(self.0) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to = *from as f32);
        }
    }
}

/// Starts smoothing in some rows: takes over the right-hand side, x = S b.
struct Begin<'a, R> {
    numbers: &'a Numbers,
    rhs: R,
    b: [&'a mut [f32]; 3],
    x: [&'a mut [f32]; 3],
    rows: Range<usize>,
}

impl<R: Rows> WithSimd for Begin<'_, R> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Begin { numbers, rhs, mut b, x, rows } = self;
        rhs.lay(&mut b);
        let plane = numbers.lines.plane;
        let ([b0, b1, b2], [x0, x1, x2]) = (b, x);
        for k in (0..rows.len()).step_by(S::F32_LANES) {
            let own = [load(simd, b0, k), load(simd, b1, k), load(simd, b2, k)];
            let change = smoothed(simd, &numbers.inverses, own, plane, rows.start + k);
            store(simd, x0, k, change[0]);
            store(simd, x1, k, change[1]);
            store(simd, x2, k, change[2]);
        }
    }
}

/// Adds what a coarser level solved to some rows.
struct Follow<'a, F> {
    numbers: &'a Numbers,
    transfer: &'a Transfer,
    coarser: &'a F,
    x: [&'a mut [f32]; 3],
    rows: Range<usize>,
}

impl<F: Fn(usize) -> Node> WithSimd for Follow<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Follow { numbers, transfer, coarser, x, rows } = self;
        for row in rows.clone() {
            // What has no smoother does not move.
            if numbers.inverses[row] != 0.0 {
                let node = transfer.followed::<S>(row, coarser);
                (0..3).for_each(|k| x[k][row - rows.start] += node[k]);
            }
        }
    }
}

/// Keeps a product, in planes.
struct Image<'a> {
    out: [&'a mut [f32]; 3],
    from: usize,
}

impl Finish for Image<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, half: &Half) {
        let [a, b, c] = &mut self.out;
        let (at, to) = (rows.start - half.rows.start, rows.start - self.from);
        for k in (0..rows.len()).step_by(S::F32_LANES) {
            let sums = load3(simd, &half.sums, half.plane, at + k);
            store(simd, a, to + k, sums[0]);
            store(simd, b, to + k, sums[1]);
            store(simd, c, to + k, sums[2]);
        }
    }
}

/// Keeps what is left, by nodes.
struct Left<'a> {
    out: &'a mut [Node],
    from: usize,
}

impl Finish for Left<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, _: S, rows: Range<usize>, half: &Half) {
        let at = rows.start - half.rows.start;
        let sums = |k: usize| &half.sums[k * half.plane + at..][..rows.len()];
        let (a, b, c) = (sums(0), sums(1), sums(2));
        let out = &mut self.out[rows.start - self.from..][..rows.len()];
        for (k, out) in out.iter_mut().enumerate() {
            *out = [-a[k], -b[k], -c[k], 0.0];
        }
    }
}

/// Smooths x by what is left of it, in planes.
struct Smoothed<'a> {
    numbers: &'a Numbers,
    x: &'a [f32],
    out: [&'a mut [f32]; 3],
    from: usize,
}

impl Finish for Smoothed<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, half: &Half) {
        let [a, b, c] = &mut self.out;
        let (at, to) = (rows.start - half.rows.start, rows.start - self.from);
        for k in (0..rows.len()).step_by(S::F32_LANES) {
            let sums = load3(simd, &half.sums, half.plane, at + k);
            let x = improved(simd, self.numbers, self.x, sums, rows.start + k);
            store(simd, a, to + k, x[0]);
            store(simd, b, to + k, x[1]);
            store(simd, c, to + k, x[2]);
        }
    }
}

/// The same by nodes.
struct Solved<'a> {
    numbers: &'a Numbers,
    x: &'a [f32],
    out: &'a mut [Node],
    from: usize,
}

impl Finish for Solved<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, half: &Half) {
        let at = rows.start - half.rows.start;
        let out = &mut self.out[rows.start - self.from..][..rows.len()];
        for (k, out) in (0..).step_by(S::F32_LANES).zip(out.chunks_mut(S::F32_LANES)) {
            let sums = load3(simd, &half.sums, half.plane, at + k);
            let mut lanes = [[0.0; PADDING]; 3];
            let x = improved(simd, self.numbers, self.x, sums, rows.start + k);
            lanes.iter_mut().zip(x).for_each(|(lanes, x)| store(simd, lanes, 0, x));
            for (lane, out) in out.iter_mut().enumerate() {
                *out = [lanes[0][lane], lanes[1][lane], lanes[2][lane], 0.0];
            }
        }
    }
}

/// x − S (A x − b)
#[inline(always)]
fn improved<S: Simd>(simd: S, numbers: &Numbers, x: &[f32], excess: Three<S>, row: usize) -> Three<S> {
    let plane = numbers.lines.plane;
    let change = smoothed(simd, &numbers.inverses, excess, plane, row);
    let x = load3(simd, x, plane, row);
    [simd.sub_f32s(x[0], change[0]), simd.sub_f32s(x[1], change[1]), simd.sub_f32s(x[2], change[2])]
}

/// Smoother times a vector.
#[inline(always)]
fn smoothed<S: Simd>(simd: S, inverses: &[f32], v: Three<S>, plane: usize, at: usize) -> Three<S> {
    let mut own = [simd.splat_f32s(0.0); 6];
    for (k, own) in own.iter_mut().enumerate() {
        *own = load(simd, inverses, k * plane + at);
    }
    [
        row(simd, own[0], own[1], own[3], v),
        row(simd, own[1], own[2], own[4], v),
        row(simd, own[3], own[4], own[5], v),
    ]
}

/// Adds to A x − b what one pair gives.
#[inline(always)]
fn add_one(numbers: &Numbers, run: &Run, k: usize, x: &[f32], half: &mut Half) {
    let Lines { plane, stride, .. } = *numbers.lines;
    let (a, b) = (run.first + k, run.second + k);
    let (a_own, b_own) = (a - half.rows.start, b - half.rows.start);
    for r in 0..3 {
        for c in 0..3 {
            let value = numbers.blocks[(3 * r + c) * stride + run.at + k];
            half.sums[r * half.plane + a_own] += value * x[c * plane + b];
            half.sums[c * half.plane + b_own] += value * x[r * plane + a];
        }
    }
}
