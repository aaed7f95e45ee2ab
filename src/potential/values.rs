//! The blocks of a Hessian while elements add to them, by one thread or by two.

use super::{
    ghosted::Nine,
    pattern::{Lie, Pattern, Slot, Slots},
};
use crate::math::{
    Mat3,
    block::{Block, Symmetric},
    pack::WIDTH,
};
use pulp::Simd;
use std::{marker::PhantomData, ops::Range, ptr::NonNull, slice};

/// The blocks while elements add to them: nine planes, one per number of a block.
pub struct Values<'a> {
    /// Planes, which another one may add to elsewhere.
    planes: NonNull<f64>,
    len: usize,
    /// Where blocks lie.
    pub pattern: &'a Pattern,
    /// Blocks of the elements that name ghosts, each in one place: many meet in few.
    pub sums: &'a mut [Nine],
    borrowed: PhantomData<&'a mut [f64]>,
}

// SAFETY: it stands for a slice that is borrowed for writing; of halves, which share it, see `Values::halves`.
unsafe impl Send for Values<'_> {}

impl<'a> Values<'a> {
    /// Over planes of a pattern's stride.
    pub fn new(planes: &'a mut [f64], pattern: &'a Pattern, sums: &'a mut [Nine]) -> Values<'a> {
        let len = planes.len();
        Values { planes: NonNull::from(planes).cast(), len, pattern, sums, borrowed: PhantomData }
    }

    /// Two for two threads, without sums.
    ///
    /// # Safety
    /// They must never add to the same place.
    pub unsafe fn halves(&mut self) -> [Values<'_>; 2] {
        let Values { planes, len, pattern, .. } = *self;
        [(); 2].map(|()| Values { planes, len, pattern, sums: &mut [], borrowed: PhantomData })
    }

    /// Numbers from a place on.
    #[inline(always)]
    fn numbers(&mut self, at: usize, count: usize) -> &mut [f64] {
        assert!(at.checked_add(count).is_some_and(|end| end <= self.len), "within the planes");
        // SAFETY: within what is borrowed, and nobody else is at these places.
        unsafe { slice::from_raw_parts_mut(self.planes.add(at).as_ptr(), count) }
    }

    /// Adds what the elements that name ghosts summed up.
    pub fn add_sums(&mut self) {
        let diagonals = self.pattern.order.len();
        let pattern = self.pattern;
        for (n, &at) in pattern.sums.iter().enumerate() {
            for (k, value) in std::mem::replace(&mut self.sums[n], [0.0; 9]).into_iter().enumerate() {
                // Of the diagonals only what lies on and below theirs counts.
                if at as usize >= diagonals || k % 3 <= k / 3 {
                    let at = k * self.pattern.lines.stride + at as usize;
                    self.numbers(at, 1)[0] += value;
                }
            }
        }
    }

    /// Adds a number per particle to the diagonals of all of them.
    pub fn add_to_diagonals(&mut self, numbers: &[f64]) {
        let Pattern { lines, order, .. } = self.pattern;
        for k in [0, 4, 8] {
            let diagonals = self.numbers(k * lines.stride, order.len());
            diagonals.iter_mut().zip(order).for_each(|(value, &n)| *value += numbers[n as usize]);
        }
    }

    /// Adds a symmetric block, given entry by entry, to a particle's diagonal.
    #[inline(always)]
    pub fn add_diagonal(&mut self, particle: u32, block: impl Fn(usize, usize) -> f64) {
        let at = self.pattern.place[particle as usize] as usize;
        for row in 0..3 {
            (0..=row).for_each(|column| *self.entry(row, column, at) += block(row, column));
        }
    }

    /// Adds a block, given entry by entry, to the pair of a slot.
    #[inline(always)]
    pub fn add_pair(&mut self, Slot { at, lie }: Slot, block: impl Fn(usize, usize) -> f64) {
        let at = at as usize;
        for row in 0..3 {
            for column in 0..3 {
                let value = block(row, column);
                match lie {
                    Lie::Straight => *self.entry(row, column, at) += value,
                    Lie::Transposed => *self.entry(column, row, at) += value,
                    Lie::Diagonal if column < row => {
                        *self.entry(row, column, at) += value + block(column, row);
                    }
                    Lie::Diagonal if column == row => *self.entry(row, column, at) += value + value,
                    Lie::Diagonal => {}
                }
            }
        }
    }

    #[inline(always)]
    fn entry(&mut self, row: usize, column: usize, at: usize) -> &mut f64 {
        &mut self.numbers((3 * row + column) * self.pattern.lines.stride + at, 1)[0]
    }

    /// Adds a block to two particles that share an element, once for both orders, or to a particle's diagonal.
    pub fn add_block(&mut self, row: u32, column: u32, block: &Mat3) {
        if row == column {
            return self.add_diagonal(row, |r, c| block[(r, c)]);
        }
        let place = self.pattern.place[column as usize] as usize;
        let found = self.pattern.neighbours(place).iter().find(|(n, _)| *n == row);
        let slot = found.expect("particles of one cell share an element").1;
        self.add_pair(slot, |r, c| block[(r, c)]);
    }

    /// Adds a block per lane to the pairs of a batch, from lane `from` on.
    #[inline(always)]
    pub fn add_lanes<S: Simd>(&mut self, slots: Slots, from: usize, block: &Block<S>) {
        if !slots.is_run {
            return self.add_each(slots, from, block, false);
        }
        let (places, stride) = self.nine(slots, from, S::F64_LANES);
        // One code for both lies: kernels should fit the cache for instructions.
        let (down, along) =
            if slots.lie == Lie::Straight { (3 * stride, stride) } else { (stride, 3 * stride) };
        for row in 0..3 {
            for column in 0..3 {
                // SAFETY: one of the nine places.
                unsafe { block.0[row][column].add_at(places.add(row * down + column * along)) };
            }
        }
    }

    /// Adds a symmetric block per lane to the diagonals of a batch, from lane `from` on.
    #[inline(always)]
    pub fn add_own<S: Simd>(&mut self, slots: Slots, from: usize, block: &Symmetric<S>) {
        self.add_symmetric(slots, from, block, true);
    }

    /// Adds a symmetric block per lane to the pairs of a batch, from lane `from` on.
    #[inline(always)]
    pub fn add_even<S: Simd>(&mut self, slots: Slots, from: usize, block: &Symmetric<S>) {
        self.add_symmetric(slots, from, block, false);
    }

    /// Of a diagonal only what lies on and below it counts.
    #[inline(always)]
    fn add_symmetric<S: Simd>(&mut self, slots: Slots, from: usize, block: &Symmetric<S>, own: bool) {
        if !slots.is_run {
            return self.add_each(slots, from, &block.block(), own);
        }
        let (places, stride) = self.nine(slots, from, S::F64_LANES);
        for row in 0..3 {
            for column in 0..if own { row + 1 } else { 3 } {
                // SAFETY: one of the nine places.
                unsafe { block.entry(row, column).add_at(places.add((3 * row + column) * stride)) };
            }
        }
    }

    /// Where so many lanes of a batch's blocks lie in the first of the nine planes, and how far it is to the next: looked up and checked once
    /// per block, as looking for each number took four fifths of the instructions.
    #[inline(always)]
    fn nine(&mut self, slots: Slots, from: usize, lanes: usize) -> (*mut f64, usize) {
        let (at, stride) = (slots.at as usize + from, self.pattern.lines.stride);
        assert!(at + 8 * stride + lanes <= self.len, "within the planes");
        // SAFETY: within what is borrowed, as are the lanes there and in the eight planes behind.
        (unsafe { self.planes.add(at) }.as_ptr(), stride)
    }

    #[inline(always)]
    fn add_each<S: Simd>(&mut self, slots: Slots, from: usize, block: &Block<S>, own: bool) {
        let mut lanes = [[0.0; WIDTH]; 9];
        for row in 0..3 {
            for column in 0..3 {
                block.0[row][column].store(&mut lanes[3 * row + column], 0);
            }
        }
        self.add_numbers(slots, from..from + S::F64_LANES, &lanes, own);
    }

    /// Apart from the kernels, which it would make longer than the cache for instructions.
    #[inline(never)]
    fn add_numbers(&mut self, slots: Slots, lanes_of: Range<usize>, lanes: &[[f64; WIDTH]; 9], own: bool) {
        let places = &self.pattern.lanes[slots.at as usize];
        for (lane, place) in lanes_of.enumerate() {
            let slot = places[place];
            for row in 0..3 {
                for column in 0..3 {
                    let (value, mirrored) = (lanes[3 * row + column][lane], lanes[3 * column + row][lane]);
                    let (row, column, value) = match slot.lie {
                        Lie::Straight => (row, column, value),
                        Lie::Transposed => (column, row, value),
                        Lie::Diagonal if column > row => continue,
                        Lie::Diagonal => (row, column, if own { value } else { value + mirrored }),
                    };
                    *self.entry(row, column, slot.at as usize) += value;
                }
            }
        }
    }
}
