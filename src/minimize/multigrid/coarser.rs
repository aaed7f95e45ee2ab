//! Coarser levels in the making, from the finest matrix of a moment ago: in turns of about the same length, on any thread.

use super::{
    dense::Dense,
    level::{Level, Sweeps, Swept},
    matrix::{Matrix, transposed},
    numbers::Numbers,
    stencil::Stencil,
    transfer::Transfer,
};
use crate::{cores::Work, math::pack::dispatch, potential::pattern::Lines};
use pulp::{Simd, WithSimd};
use std::sync::Arc;

/// Matrices of the coarser levels, and what they are made from.
pub struct Coarser {
    /// The finest matrix in planes, where it lies so.
    pub(super) planes: Option<Planes>,
    /// The same by blocks.
    pub(super) finest: Matrix,
    /// Levels between it and the coarsest.
    pub(super) levels: Vec<Made>,
    pub(super) coarsest: Dense,
    pub(super) transfers: Arc<[Transfer]>,
    /// Turns that are done.
    pub(super) done: u32,
}

/// A matrix in planes, and where its blocks lie otherwise.
pub(super) struct Planes {
    pub numbers: Numbers,
    pub entries: Vec<[u32; 3]>,
}

/// A coarser level in the making: by blocks, as the next one is made of it, and in planes where it is used so.
pub(super) enum Made {
    Planes(Matrix, Planes),
    Blocks(Swept),
}

impl Made {
    /// Room for a level; `is_next` to the finest.
    pub fn new(matrix: Matrix, is_next: bool) -> Made {
        let pairs = |row: usize| {
            let columns = &matrix.columns[matrix.row(row)];
            columns
                .iter()
                .filter(move |&&column| column as usize > row)
                .map(move |&column| (row as u32, column))
        };
        let lines = Lines::new(matrix.len(), (0..matrix.len()).flat_map(pairs).collect());
        if is_next && lines.are_long() && lines.particles >= FEWEST_IN_PLANES {
            let entries = entries(&lines, &matrix);
            Made::Planes(matrix, Planes { numbers: Numbers::new(Arc::new(lines)), entries })
        } else {
            Made::Blocks(Swept::new(matrix))
        }
    }

    /// A level of this kind, whose rows come in halves or not.
    pub fn level(&self, is_parted: bool) -> Level {
        match self {
            Made::Planes(_, planes) => {
                Level::Planes(Box::new(Stencil::new(planes.numbers.clone(), is_parted)))
            }
            Made::Blocks(swept) => Level::Blocks(Box::new(Sweeps::new(swept.clone()))),
        }
    }

    fn matrix(&self) -> &Matrix {
        match self {
            Made::Planes(matrix, _) => matrix,
            Made::Blocks(swept) => &swept.matrix,
        }
    }

    fn matrix_mut(&mut self) -> &mut Matrix {
        match self {
            Made::Planes(matrix, _) => matrix,
            Made::Blocks(swept) => &mut swept.matrix,
        }
    }

    /// Makes it ready for use.
    #[inline(always)]
    fn finish(&mut self) {
        match self {
            Made::Planes(matrix, Planes { numbers, entries }) => {
                spread(numbers, entries, matrix);
                numbers.invert();
            }
            Made::Blocks(swept) => swept.invert(),
        }
    }
}

/// Particles from which on the level next to the finest lies in planes: there reading it takes longer than what Jacobi's weaker smoothing
/// costs. Were the levels beyond in planes too, steps ended in trouble now and then at no gain.
const FEWEST_IN_PLANES: usize = 1000;

/// Turns in which coarser levels are made: the finest blocks are copied; half of the next matrix; the other half; all beyond.
pub const TURNS: u32 = 4;

impl Work for Coarser {
    /// Makes the next turn.
    fn work(&mut self) {
        if !self.transfers.is_empty() && self.done < TURNS {
            dispatch(Turn(self));
            self.done += 1;
        }
    }
}

struct Turn<'a>(&'a mut Coarser);

impl WithSimd for Turn<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Coarser { planes, finest, levels, coarsest, transfers, done } = self.0;
        match done {
            0 => {
                if let Some(Planes { numbers, entries }) = planes {
                    fill(
                        finest,
                        entries,
                        #[inline(always)]
                        |at| numbers.block(at),
                    );
                }
            }
            1 | 2 => {
                let half = *done as usize - 1;
                let to = levels.first_mut().map_or(&mut coarsest.matrix, Made::matrix_mut);
                transfers[0].coarser(simd, finest, to, half..half + 1);
            }
            _ => {
                for (l, transfer) in transfers[1..].iter().enumerate() {
                    let (fine, coarse) = levels.split_at_mut(l + 1);
                    let fine = &mut fine[l];
                    fine.finish();
                    let to = coarse.first_mut().map_or(&mut coarsest.matrix, Made::matrix_mut);
                    transfer.coarser(simd, fine.matrix(), to, 0..2);
                }
                coarsest.factorize();
            }
        }
    }
}

/// Places of each pair's block in the planes and, straight and transposed, in a matrix: the diagonals, then the pairs.
pub fn entries(lines: &Lines, matrix: &Matrix) -> Vec<[u32; 3]> {
    let mut entries: Vec<[u32; 3]> =
        matrix.starts.iter().zip(0..lines.particles).map(|(&start, n)| [n as u32, start, start]).collect();
    for run in &lines.runs {
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

/// A number in single precision.
#[inline(always)]
pub fn single(value: impl Into<f64>) -> f32 {
    value.into() as f32
}

/// A matrix from the blocks at places, of diagonals what is on and below theirs.
#[inline(always)]
pub fn fill(matrix: &mut Matrix, entries: &[[u32; 3]], block: impl Fn(usize) -> [f32; 9]) {
    let (own, pairs) = entries.split_at(matrix.len());
    for &[at, place, _] in own {
        let [a, _, _, b, d, _, c, e, f] = block(at as usize);
        *matrix.block_mut(place as usize) = [a, b, c, b, d, e, c, e, f];
    }
    for &[at, straight, turned] in pairs {
        let block = block(at as usize);
        // Blocks go column by column.
        *matrix.block_mut(straight as usize) = transposed(&block);
        *matrix.block_mut(turned as usize) = block;
    }
}

/// Blocks into planes.
#[inline(always)]
fn spread(numbers: &mut Numbers, entries: &[[u32; 3]], matrix: &Matrix) {
    for &[at, straight, _] in entries {
        // Blocks go column by column.
        numbers.set_block(at as usize, transposed(matrix.block(straight as usize)));
    }
}
