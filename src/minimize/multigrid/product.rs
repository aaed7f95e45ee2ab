//! A matrix in planes times a vector, in two halves of its rows.

use super::numbers::{Numbers, Sixteen, Three, load3, plus, store, turned};
use crate::{
    cores::Team,
    math::pack::dispatch,
    potential::pattern::{Lines, PADDING, Run, plane},
};
use pulp::{Simd, WithSimd};
use std::ops::{Deref, Range};

/// Rows that are done with before the next ones begin, so that what goes with them stays in the nearest cache.
const TILE: usize = 512;
/// Rows within which what one register stores the next would load before it is there.
const NEAR: usize = 2 * PADDING;

impl Numbers {
    /// A x − b, without b A x, in two halves; `finish` gets the rows of each as they are done.
    pub fn multiply<F: Finish>(
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
pub trait Finish: Send {
    /// Takes rows that are done; the first is a multiple of a register's length.
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, sums: &Sums);
}

/// The first rows of a product, or the others. Pairs belong to the half of their first particle, so the first half has room for what its
/// pairs give to rows of the other one: sums do not depend on who does which half.
pub struct Half {
    /// Its rows, the first a multiple of a register's length.
    pub rows: Range<usize>,
    /// Where those end that its pairs reach, another such multiple.
    end: usize,
    /// Pairs that stand in line, with neighbours on the same line and with others; its pairs that do not.
    near: Vec<Run>,
    far: Vec<Run>,
    loose: Vec<Run>,
    sums: Sums,
}

/// Rows of a vector in planes, from one of them on.
pub struct Sums<L = Vec<f32>> {
    list: L,
    plane: usize,
    start: usize,
}

impl Sums {
    /// The same with everything at hand: what is read behind a reference is read again after every store.
    fn at_hand(&mut self) -> Sums<&mut [f32]> {
        Sums { list: &mut self.list, plane: self.plane, start: self.start }
    }

    /// Rows of one of the planes.
    pub fn rows(&self, plane: usize, rows: Range<usize>) -> &[f32] {
        &self.list[plane * self.plane + rows.start - self.start..][..rows.len()]
    }

    fn rows_mut(&mut self, plane: usize, rows: Range<usize>) -> &mut [f32] {
        &mut self.list[plane * self.plane + rows.start - self.start..][..rows.len()]
    }
}

impl<L: Deref<Target = [f32]>> Sums<L> {
    /// A register of rows.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, row: usize) -> Three<S> {
        load3(simd, &self.list, self.plane, row - self.start)
    }
}

impl Sums<&mut [f32]> {
    #[inline(always)]
    fn store<S: Simd>(&mut self, simd: S, row: usize, value: Three<S>) {
        (0..3).for_each(|k| store(simd, self.list, k * self.plane + row - self.start, value[k]));
    }
}

impl Half {
    /// Both halves of a matrix' rows: about as long as each other, or all rows in the first if they are to stay together or pairs reach too
    /// far.
    pub fn both(lines: &Lines, is_parted: bool) -> [Half; 2] {
        let n = lines.particles;
        let middle = (n / 2).next_multiple_of(PADDING);
        let parted = if is_parted { Half::parted(lines, middle) } else { None };
        parted.unwrap_or_else(|| {
            let loose = lines.runs.iter().filter(|run| !run.is_padded).copied();
            [Half::new(lines, 0..n, n, loose.collect()), Half::new(lines, n..n, n, Vec::new())]
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
        (end < n).then(|| [Half::new(lines, 0..middle, end, low), Half::new(lines, middle..n, n, high)])
    }

    fn new(lines: &Lines, rows: Range<usize>, end: usize, loose: Vec<Run>) -> Half {
        let in_line = lines.runs.iter().filter(|run| run.is_padded);
        let (near, far) = in_line.partition(|run| run.second - run.first <= NEAR);
        let plane = plane(end - rows.start);
        let sums = Sums { list: vec![0.0; 3 * plane], plane, start: rows.start };
        Half { rows, end, near, far, loose, sums }
    }

    /// Adds what the other half's pairs gave to rows of this one.
    fn take_over(&mut self, low: &Half) {
        let rows = low.rows.end..low.end;
        for k in 0..3 {
            let from = low.sums.rows(k, rows.clone());
            self.sums.rows_mut(k, rows.clone()).iter_mut().zip(from).for_each(|(to, from)| *to += from);
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
        let Half { rows, near, far, loose, sums, .. } = half;
        for k in 0..3 {
            let (own, beyond) = sums.list[k * sums.plane..][..sums.plane].split_at_mut(rows.len());
            match b {
                None => own.fill(0.0),
                Some(b) => {
                    let b = &b[k * numbers.lines.plane..][rows.clone()];
                    own.iter_mut().zip(b).for_each(|(sum, b)| *sum = -b);
                }
            }
            beyond.fill(0.0);
        }
        let mut to = Addition { numbers, x, sums };
        for run in loose.iter() {
            (0..run.len).for_each(|k| to.add_one(run, k));
        }
        let Range { start, end } = *rows;
        for from_row in (start..end).step_by(TILE) {
            let tile = from_row..(from_row + TILE).min(end);
            match (&near[..], &far[..]) {
                // The finest level of a sheet that is uniform: loops of known length go a third faster.
                ([a, b], [c, d, e, f]) => to.add_tile(simd, tile.clone(), [a, b], [c, d, e, f]),
                _ => to.add_tile(simd, tile.clone(), near.iter(), far.iter()),
            }
            let done = tile.start.max(from)..tile.end;
            if !done.is_empty() {
                finish.finish(simd, done, to.sums);
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
            self.finish.finish(simd, rows, &self.half.sums);
        }
    }
}

/// A matrix times a vector, added to the sums of a half.
struct Addition<'a> {
    numbers: &'a Numbers,
    x: &'a [f32],
    sums: &'a mut Sums,
}

impl Addition<'_> {
    /// Adds to A x − b what the pairs give whose first particle is in the tile, and the diagonals. With the tiles before, that completes its
    /// rows; later tiles do not look at them any more.
    #[inline(always)]
    fn add_tile<'r, S: Simd>(
        &mut self,
        simd: S,
        tile: Range<usize>,
        near: impl IntoIterator<Item = &'r Run> + Clone,
        far: impl IntoIterator<Item = &'r Run> + Clone,
    ) {
        let Addition { numbers, x, .. } = *self;
        let (blocks, plane, mut sums) = (&numbers.blocks[..], numbers.lines.plane, self.sums.at_hand());
        let of = |run: &Run, sixteen: usize| -> &Sixteen<9> { &blocks[run.at / PADDING + sixteen] };
        let registers = PADDING / S::F32_LANES;
        for first in tile.clone().step_by(PADDING) {
            let sixteen = first / PADDING;
            for j in 0..registers {
                let row = first + j * S::F32_LANES;
                let own = load3(simd, x, plane, row);
                let mut sum = plus(simd, blocks[sixteen].load(simd, j), own, sums.load(simd, row));
                for run in near.clone() {
                    if row < run.len {
                        let block = of(run, sixteen).load(simd, j);
                        sum = plus(simd, block, load3(simd, x, plane, run.second + row), sum);
                    }
                }
                for run in far.clone() {
                    if row < run.len {
                        let block = of(run, sixteen).load(simd, j);
                        let other = run.second + row;
                        sum = plus(simd, block, load3(simd, x, plane, other), sum);
                        sums.store(simd, other, plus(simd, turned(block), own, sums.load(simd, other)));
                    }
                }
                sums.store(simd, row, sum);
            }
        }
        for run in near {
            for first in (tile.start..tile.end.min(run.len)).step_by(PADDING) {
                for j in 0..registers {
                    let row = first + j * S::F32_LANES;
                    let (block, other) = (turned(of(run, first / PADDING).load(simd, j)), run.second + row);
                    let sum = plus(simd, block, load3(simd, x, plane, row), sums.load(simd, other));
                    sums.store(simd, other, sum);
                }
            }
        }
    }

    /// Adds what one pair gives.
    #[inline(always)]
    fn add_one(&mut self, run: &Run, k: usize) {
        let Addition { numbers, x, sums: Sums { list, plane: own, start } } = self;
        let (plane, block) = (numbers.lines.plane, numbers.block(run.at + k));
        let (a, b) = (run.first + k, run.second + k);
        let [of_a, of_b]: [[f32; 3]; 2] = [a, b].map(|n| std::array::from_fn(|k| x[k * plane + n]));
        for k in 0..3 {
            let row = block[3 * k] * of_b[0] + block[3 * k + 1] * of_b[1] + block[3 * k + 2] * of_b[2];
            let column = block[k] * of_a[0] + block[3 + k] * of_a[1] + block[6 + k] * of_a[2];
            list[k * *own + a - *start] += row;
            list[k * *own + b - *start] += column;
        }
    }
}
