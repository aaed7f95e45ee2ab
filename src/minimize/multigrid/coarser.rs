//! Coarser levels in the making, from the finest matrix of a moment ago: in turns of about the same length, on any thread.

use super::{
    dense::Dense,
    level::{Level, Sweeps, Swept},
    matrix::{Matrix, Rows, transposed},
    numbers::Numbers,
    stencil::Stencil,
    transfer::Transfer,
};
use crate::{
    cores::{Team, Work},
    math::pack::dispatch,
    potential::pattern::Lines,
};
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
    pub sources: Vec<Source>,
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
            let sources = sources(&lines, &matrix);
            Made::Planes(matrix, Planes { numbers: Numbers::new(Arc::new(lines)), sources })
        } else {
            Made::Blocks(Swept::new(matrix))
        }
    }

    /// A level of this kind, whose rows come in halves or not.
    pub fn level(&self, is_parted: bool) -> Level {
        match self {
            Made::Planes(_, planes) => {
                Level::Planes(Box::new(Stencil::new(planes.numbers.clone(), is_parted, None)))
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
    fn finish(&mut self, team: &Team) {
        match self {
            Made::Planes(matrix, Planes { numbers, sources }) => {
                spread(numbers, sources, matrix);
                numbers.invert(team);
            }
            Made::Blocks(swept) => swept.invert(),
        }
    }
}

/// Particles from which on the level next to the finest lies in planes: there reading it takes longer than what Jacobi's weaker smoothing
/// costs. Were the levels beyond in planes too, steps ended in trouble now and then at no gain.
const FEWEST_IN_PLANES: usize = 1000;

/// Turns in which coarser levels are made: the finest blocks are copied, and half of the next matrix made; the other half, and all beyond.
pub const TURNS: u32 = 2;

impl Work for Coarser {
    /// Makes the next turn.
    fn work(&mut self) {
        if self.transfers.is_empty() || self.done == TURNS {
            return;
        }
        let (Coarser { planes, finest, levels, coarsest, transfers, done }, alone) = (self, Team::nobody());
        if *done == 0 {
            copy(alone, planes, finest);
            transfers[0].coarser_half(0, finest, next(levels, coarsest));
        } else {
            transfers[0].coarser_half(1, finest, next(levels, coarsest));
            beyond(alone, levels, coarsest, &transfers[1..]);
        }
        *done += 1;
    }
}

impl Coarser {
    /// Makes all turns at once, in halves.
    pub fn make(&mut self, team: &Team) {
        let Coarser { planes, finest, levels, coarsest, transfers, done, .. } = self;
        if let Some((first, others)) = transfers.split_first() {
            copy(team, planes, finest);
            let to = next(levels, coarsest);
            first.coarser(team, finest, to);
            beyond(team, levels, coarsest, others);
        }
        *done = TURNS;
    }
}

/// Copies the finest blocks.
fn copy(team: &Team, planes: &Option<Planes>, finest: &mut Matrix) {
    if let Some(Planes { numbers, sources }) = planes {
        let [low, high] = finest.rows_mut(finest.len() / 2);
        let (sources, others) = sources.split_at(high.first as usize);
        team.both(
            || dispatch(Copy { numbers, sources, to: low }),
            || dispatch(Copy { numbers, sources: others, to: high }),
        );
    }
}

/// The matrix of the first of these levels.
fn next<'a>(levels: &'a mut [Made], coarsest: &'a mut Dense) -> &'a mut Matrix {
    levels.first_mut().map_or(&mut coarsest.matrix, Made::matrix_mut)
}

/// Makes all levels beyond the first of them.
fn beyond(team: &Team, levels: &mut [Made], coarsest: &mut Dense, transfers: &[Transfer]) {
    for (l, transfer) in transfers.iter().enumerate() {
        let (fine, coarse) = levels.split_at_mut(l + 1);
        let fine = &mut fine[l];
        fine.finish(team);
        let to = next(coarse, coarsest);
        transfer.coarser(team, fine.matrix(), to);
    }
    coarsest.factorize();
}

/// Where a block of a matrix lies in planes: its place, and whether it lies there as its transpose.
#[derive(Clone, Copy, Default)]
pub struct Source(u32);

impl Source {
    fn new(at: usize, is_turned: bool) -> Source {
        Source(2 * at as u32 + u32::from(is_turned))
    }

    #[inline(always)]
    fn at(self) -> usize {
        self.0 as usize / 2
    }

    #[inline(always)]
    fn is_turned(self) -> bool {
        self.0 % 2 == 1
    }
}

/// Where each block of a matrix lies in planes.
pub fn sources(lines: &Lines, matrix: &Matrix) -> Vec<Source> {
    let mut sources = vec![Source::default(); matrix.columns.len()];
    for row in 0..lines.particles {
        sources[matrix.starts[row] as usize] = Source::new(row, false);
    }
    for run in &lines.runs {
        for k in 0..run.len {
            let [first, second] = [run.first + k, run.second + k].map(|n| n as u32);
            // Where lines end there is no pair.
            if let Some(straight) = matrix.place(first, second) {
                let turned = matrix.place(second, first).expect("a symmetric pattern");
                sources[straight as usize] = Source::new(run.at + k, false);
                sources[turned as usize] = Source::new(run.at + k, true);
            }
        }
    }
    sources
}

/// Places of each block above the diagonal: in planes, in a matrix, and there as its transpose.
pub fn pairs(sources: &[Source], matrix: &Matrix) -> Vec<[u32; 3]> {
    let above = |row: u32| {
        let places = matrix.row(row as usize).skip(1).filter(|&place| !sources[place].is_turned());
        places.map(move |place| {
            let turned = matrix.place(matrix.columns[place], row).expect("a symmetric pattern");
            [sources[place].at() as u32, place as u32, turned]
        })
    };
    (0..matrix.len() as u32).flat_map(above).collect()
}

/// A number in single precision.
#[inline(always)]
pub fn single(value: impl Into<f64>) -> f32 {
    value.into() as f32
}

/// Copies blocks in planes to rows.
struct Copy<'a> {
    numbers: &'a Numbers,
    sources: &'a [Source],
    to: Rows<'a>,
}

impl WithSimd for Copy<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Copy { numbers, sources, mut to } = self;
        for (source, place) in sources.iter().zip(to.first..) {
            let own = numbers.block(source.at());
            // Blocks go column by column.
            let own = if source.is_turned() { own } else { transposed(&own) };
            *to.block_mut(place).expect("a block of these rows") = own;
        }
    }
}

/// Blocks into planes.
fn spread(numbers: &mut Numbers, sources: &[Source], matrix: &Matrix) {
    for (place, source) in sources.iter().enumerate().filter(|(_, source)| !source.is_turned()) {
        // Blocks go column by column.
        numbers.set_block(source.at(), transposed(matrix.block(place)));
    }
}
