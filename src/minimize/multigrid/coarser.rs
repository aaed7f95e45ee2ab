//! Coarser levels in the making, from the finest matrix of a moment ago: in turns of about the same length, on any thread.

use super::{
    dense::Dense,
    lattice::Lattice,
    level::{Level, Sweeps, Swept},
    matrix::{Matrix, Rows, transposed},
    numbers::Numbers,
    products::Products,
    stencil::Stencil,
    transfer::Transfer,
    yarns::Yarns,
};
use crate::{
    cores::{Team, Work},
    math::pack::dispatch,
    potential::pattern::Lines,
};
use pulp::{Simd, WithSimd};
use std::sync::Arc;

/// Matrices of all levels, and how each is made of the one before.
pub struct Coarser {
    /// All levels but the coarsest, from the finest on.
    pub(super) levels: Vec<Made>,
    pub(super) coarsest: Dense,
    merges: Vec<Merge>,
    /// Turns that are done.
    pub(super) done: u32,
}

/// A level's matrix in the making: as it is used, and as others are made of it.
pub(super) struct Made {
    pub planes: Option<Planes>,
    pub rows: Option<Swept>,
    pub is_used_in_planes: bool,
}

/// A matrix in planes, and where its blocks lie otherwise, if they do.
pub(super) struct Planes {
    pub numbers: Numbers,
    sources: Vec<Source>,
}

/// How a matrix becomes the next coarser one.
enum Merge {
    /// In planes.
    Lattice(Box<Lattice>),
    /// Row by row.
    Products(Products),
}

/// Particles from which on the level next to the finest lies in planes: there reading it takes longer than what Jacobi's weaker smoothing
/// costs. Were the levels beyond in planes too, steps ended in trouble now and then at no gain.
const FEWEST_IN_PLANES: usize = 1000;

/// Turns in which coarser levels are made: the one next to the finest; all beyond.
pub const TURNS: u32 = 2;

impl Coarser {
    /// Room for the levels of a mesh, of which these are the matrices. The finest lies in planes like `lines`, and particles line by line where
    /// they are a whole lattice with so many lines.
    pub fn new(
        lines: &Arc<Lines>,
        lattice: Option<[usize; 2]>,
        mut matrices: Vec<Matrix>,
        transfers: &[Transfer],
    ) -> Coarser {
        let coarsest = matrices.pop().expect("at least one level");
        let (mut levels, mut merges): (Vec<Made>, Vec<Merge>) = (Vec::new(), Vec::new());
        let (mut counts, mut lines) = (lattice, lines.clone());
        let mut matrices = matrices.into_iter().peekable();
        while let (l, Some(matrix)) = (levels.len(), matrices.next()) {
            let next = matrices.peek().map(|matrix| Arc::new(lines_of(matrix)));
            let made_in_planes = matches!(merges.last(), Some(Merge::Lattice(_)));
            let used_in_planes = match l {
                0 => lines.are_long(),
                1 => lines.are_long() && lines.particles >= FEWEST_IN_PLANES,
                _ => false,
            };
            let lattice = match (counts, &next) {
                (Some(counts), Some(next)) if made_in_planes || used_in_planes => {
                    Lattice::new(counts, &lines, next)
                }
                _ => None,
            };
            counts = counts.filter(|_| lattice.is_some()).map(|counts| counts.map(|lines| lines / 2 + 1));
            let made_by_rows = l > 0 && !made_in_planes;
            let in_rows = made_by_rows || !used_in_planes || lattice.is_none();
            let to = matrices.peek().unwrap_or(&coarsest);
            merges.push(match lattice {
                Some(lattice) => Merge::Lattice(Box::new(lattice)),
                None => Merge::Products(Products::new(&matrix, &transfers[l], to)),
            });
            let planes = (made_in_planes || used_in_planes).then(|| Planes {
                sources: if in_rows { sources(&lines, &matrix) } else { Vec::new() },
                numbers: Numbers::new(lines.clone()),
            });
            let rows = in_rows.then(|| Swept::new(matrix));
            levels.push(Made { planes, rows, is_used_in_planes: used_in_planes });
            lines = next.unwrap_or(lines);
        }
        Coarser { levels, coarsest: Dense::new(coarsest), merges, done: 0 }
    }

    /// Makes all turns at once, in halves.
    pub fn make(&mut self, team: &Team) {
        (0..self.merges.len()).for_each(|l| self.merge(l, team));
        self.done = TURNS;
    }

    /// Makes the level beyond one.
    fn merge(&mut self, l: usize, team: &Team) {
        let Coarser { levels, coarsest, merges, .. } = self;
        let (fine, coarse) = levels.split_at_mut(l + 1);
        let (fine, coarse) = (&mut fine[l], coarse.first_mut());
        match &mut merges[l] {
            Merge::Lattice(lattice) => {
                let made = coarse.expect("a lattice is never the coarsest");
                lattice.merge(team, fine.numbers(), made.numbers_mut());
                made.copy(team);
                made.invert(team);
            }
            Merge::Products(products) => {
                if l == 0 {
                    fine.copy(team);
                }
                let to = coarse.map_or(&mut coarsest.matrix, |made| made.matrix_mut());
                products.merge(team, fine.matrix(), to);
                match levels.get_mut(l + 1) {
                    Some(made) => {
                        made.spread();
                        made.invert(team);
                    }
                    None => coarsest.factorize(),
                }
            }
        }
    }
}

impl Work for Coarser {
    /// Makes the next turn.
    fn work(&mut self) {
        let alone = Team::nobody();
        if self.merges.is_empty() || self.done == TURNS {
            return;
        }
        if self.done == 0 {
            self.merge(0, alone);
        } else {
            (1..self.merges.len()).for_each(|l| self.merge(l, alone));
        }
        self.done += 1;
    }
}

impl Made {
    /// A level of this kind, whose rows come in halves or not.
    pub fn level(&self, is_parted: bool, yarns: Option<Yarns>) -> Level {
        match (&self.planes, &self.rows) {
            (Some(planes), _) if self.is_used_in_planes => {
                Level::Planes(Box::new(Stencil::new(planes.numbers.clone(), is_parted, yarns)))
            }
            (_, Some(rows)) => Level::Blocks(Box::new(Sweeps::new(rows.clone()))),
            _ => unreachable!("it lies one way or the other"),
        }
    }

    /// Exchanges its matrix with a level's.
    pub fn exchange(&mut self, level: &mut Level) {
        match (level, &mut self.planes, &mut self.rows) {
            (Level::Planes(stencil), Some(planes), _) => {
                std::mem::swap(&mut stencil.numbers, &mut planes.numbers);
            }
            (Level::Blocks(sweeps), _, Some(rows)) => std::mem::swap(&mut sweeps.swept, rows),
            _ => unreachable!("both were made alike"),
        }
    }

    fn numbers(&self) -> &Numbers {
        &self.planes.as_ref().expect("in planes").numbers
    }

    fn numbers_mut(&mut self) -> &mut Numbers {
        &mut self.planes.as_mut().expect("in planes").numbers
    }

    pub fn matrix(&self) -> &Matrix {
        &self.rows.as_ref().expect("in rows").matrix
    }

    fn matrix_mut(&mut self) -> &mut Matrix {
        &mut self.rows.as_mut().expect("in rows").matrix
    }

    /// Copies blocks in planes to rows, where it lies in both.
    fn copy(&mut self, team: &Team) {
        if let (Some(Planes { numbers, sources }), Some(rows)) = (&self.planes, &mut self.rows) {
            let middle = rows.matrix.len() / 2;
            let [low, high] = rows.matrix.rows_mut(middle);
            let (sources, others) = sources.split_at(high.first as usize);
            team.both(
                || dispatch(Copy { numbers, sources, to: low }),
                || dispatch(Copy { numbers, sources: others, to: high }),
            );
        }
    }

    /// Copies blocks in rows to planes, where it lies in both.
    fn spread(&mut self) {
        if let (Some(Planes { numbers, sources }), Some(rows)) = (&mut self.planes, &self.rows) {
            spread(numbers, sources, &rows.matrix);
        }
    }

    /// Makes the inverses of the diagonal blocks.
    fn invert(&mut self, team: &Team) {
        match (&mut self.planes, &mut self.rows) {
            (Some(planes), _) if self.is_used_in_planes => planes.numbers.invert(team),
            (_, Some(rows)) => rows.invert(),
            _ => unreachable!("it lies one way or the other"),
        }
    }
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

/// How a matrix lies in planes.
pub fn lines_of(matrix: &Matrix) -> Lines {
    let pairs = |row: usize| {
        let columns = &matrix.columns[matrix.row(row)];
        columns.iter().filter(move |&&column| column as usize > row).map(move |&column| (row as u32, column))
    };
    Lines::new(matrix.len(), (0..matrix.len()).flat_map(pairs).collect())
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

/// Copies blocks in rows to planes.
pub fn spread(numbers: &mut Numbers, sources: &[Source], matrix: &Matrix) {
    for (place, source) in sources.iter().enumerate().filter(|(_, source)| !source.is_turned()) {
        // Blocks go column by column.
        numbers.set_block(source.at(), transposed(matrix.block(place)));
    }
}
