//! Pᵀ A P of a whole lattice, in planes: whole lines of neighbours at once.
//!
//! P is linear along one direction times linear along the other, so lines are merged first along themselves, then across. A block couples
//! a particle with another that is `across` lines on and `along` places on; the other half of a symmetric matrix is its transpose.

use super::numbers::{Numbers, Sixteen, load, store};
use crate::{
    cores::Team,
    math::pack::dispatch,
    potential::pattern::{Lines, PADDING},
};
use pulp::{Simd, WithSimd};
use std::{array, mem, ops::Range};

/// How far a block reaches at the most, across and along.
const REACH: usize = 2;
/// How far blocks may reach along, and across.
const ALONG: usize = 2 * REACH + 1;
const ACROSS: usize = REACH + 1;
/// Kinds of blocks of a coarse lattice: those that reach two lines on are no longer than one place.
const PLANES: usize = 11;
/// Zeros beside a line, so that it may be read from beyond its ends.
const MARGIN: usize = PADDING;
/// Places of a block's numbers in its transpose.
const TURNED: [usize; 9] = [0, 3, 6, 1, 4, 7, 2, 5, 8];

/// How a lattice becomes the next coarser one.
pub struct Lattice {
    plan: Plan,
    /// Length of a coarser plane in sixteens.
    plane: usize,
    /// The coarser line with which the second half begins: before it, planes end with whole sixteens.
    middle: usize,
    scratch: [Scratch; 2],
}

/// What is made of what.
struct Plan {
    /// Finer and coarser particles: lines, and places on a line.
    fine: [usize; 2],
    coarse: [usize; 2],
    /// The finer blocks: how far they reach, and where the first of a kind lies.
    blocks: Vec<Kind>,
    /// For lines that are merged along themselves, by how far they reach then: what they are made of, even places of a finer line or odd ones.
    merged: [[Vec<Term>; ALONG]; ACROSS],
    /// The same for each coarser plane, of merged lines: of the finer line before its own, that one, and the next.
    coarser: [Vec<Term>; PLANES],
}

/// Blocks of a kind: how far they reach, across and (from −2 on) along, and where the first one lies.
type Kind = ([usize; 2], usize);

/// A line that another one is made of.
struct Term {
    /// Which of the finer lines, or whether the odd places of one; and how far its blocks reach.
    line: usize,
    reach: [usize; 2],
    /// From how many places on, and whether blocks are transposed.
    shift: isize,
    is_turned: bool,
    weight: f32,
}

/// Lines of blocks in the making, the nine numbers of a block one line after the other.
struct Scratch {
    /// A finer line, in whole sixteens.
    raw: [Vec<[f32; PADDING]>; 9],
    /// The even and the odd places of a finer line, by how far blocks reach along.
    parted: [[Vec<f32>; ALONG]; 2],
    /// Finer lines merged along themselves, by how far they reach.
    merged: [[[Vec<f32>; ALONG]; ACROSS]; 3],
    /// A coarser line.
    coarser: Vec<f32>,
}

impl Lattice {
    /// Between lattices whose particles lie line by line. None if either lies otherwise, or numbers of lines are even: every second line is
    /// kept, and the last.
    pub fn new(fine: [usize; 2], from: &Lines, to: &Lines) -> Option<Lattice> {
        let coarse = fine.map(|lines| lines / 2 + 1);
        let is_odd = fine.iter().all(|lines| lines % 2 == 1);
        if !is_odd || coarse.iter().any(|&lines| lines <= 2 * REACH) {
            return None;
        }
        let (blocks, kinds) = (kinds(fine, from)?, kinds(coarse, to)?);
        // Blocks of a plane follow those of the one before.
        let lie_in_planes = kinds.iter().enumerate().all(|(k, (_, at))| *at == k * to.plane);
        let kinds: [Kind; PLANES] = kinds.try_into().ok().filter(|_| lie_in_planes)?;
        let merged = array::from_fn(|across| {
            let along =
                blocks.iter().map(|kind| kind.0).filter(|reach| reach[0] == across).map(|reach| reach[1]);
            merged_along(across, &along.collect::<Vec<_>>())
        });
        let coarser = kinds.map(|(reach, _)| merged_across(reach, &merged));
        let middle = (coarse[0] / 2).next_multiple_of(PADDING).min(coarse[0]);
        let scratch = [(); 2].map(|_| Scratch::new(fine[1], coarse[1]));
        let plan = Plan { fine, coarse, blocks, merged, coarser };
        Some(Lattice { plan, plane: to.plane / PADDING, middle, scratch })
    }

    /// Makes the next matrix, in halves of its lines.
    pub fn merge(&mut self, team: &Team, from: &Numbers, to: &mut Numbers) {
        let Lattice { plan, plane, middle, scratch: [scratch, other] } = self;
        let [lines, step] = plan.coarse;
        let parted = (*middle * step).div_ceil(PADDING);
        let [mut low, mut high] = [(); 2].map(|_| [(); PLANES].map(|_| Default::default()));
        for ((plane, low), high) in to.blocks.chunks_mut(*plane).zip(&mut low).zip(&mut high) {
            (*low, *high) = plane.split_at_mut(parted);
        }
        let half = |to, scratch, lines, first| Half { plan, from, to, scratch, lines, first };
        let (low, high) = (half(low, scratch, 0..*middle, 0), half(high, other, *middle..lines, parted));
        team.both(|| dispatch(low), || dispatch(high));
    }
}

/// Kinds of blocks of a lattice; none where any lie otherwise.
fn kinds(counts: [usize; 2], lines: &Lines) -> Option<Vec<Kind>> {
    let [rows, step] = counts;
    if lines.particles != rows * step {
        return None;
    }
    let pairs = lines.runs.iter().map(|run| {
        let across = (run.second + step / 2) / step;
        let along = (run.second + REACH).checked_sub(across * step)?;
        let is_near = across < ACROSS && along < ALONG;
        (run.is_padded && is_near).then_some(([across, along], run.at))
    });
    std::iter::once(Some(([0, REACH], 0))).chain(pairs).collect()
}

/// What finer places, or lines, before a coarser one, at it and behind it count there.
const WEIGHTS: [(isize, f32); 3] = [(-1, 0.5), (0, 1.0), (1, 0.5)];

/// What lines that reach so far across are made of when they are merged along themselves, if finer blocks reach so far along. Of those
/// on one line only what reaches on, not back, is made.
fn merged_along(across: usize, along: &[usize]) -> [Vec<Term>; ALONG] {
    let mut merged: [Vec<Term>; ALONG] = array::from_fn(|_| Vec::new());
    for &along in along {
        for (here, u) in WEIGHTS {
            for (there, v) in WEIGHTS {
                // From place 2 i + here to 2 j + there.
                let twice = along as isize - REACH as isize + here - there;
                if twice % 2 != 0 || across == 0 && twice < 0 {
                    continue;
                }
                let term = |is_turned| Term {
                    line: usize::from(here != 0),
                    reach: [across, along],
                    shift: here.min(0),
                    is_turned,
                    weight: u * v,
                };
                let to = &mut merged[(twice / 2 + REACH as isize) as usize];
                to.push(term(false));
                // The same pair from its other end, where both ends come to one place.
                if across == 0 && twice == 0 && along > REACH {
                    to.push(term(true));
                }
            }
        }
    }
    merged
}

/// What coarser blocks are made of that reach so far.
fn merged_across([lines, along]: [usize; 2], merged: &[[Vec<Term>; ALONG]; ACROSS]) -> Vec<Term> {
    let (shift, mirrored) = (along as isize - REACH as isize, ALONG - 1 - along);
    let mut terms = Vec::new();
    for (here, u) in WEIGHTS {
        for (there, v) in WEIGHTS {
            // From line 2 i + here to 2 j + there.
            let across = 2 * lines as isize + there - here;
            let is_turned = across < 0 || across == 0 && shift < 0;
            // The line at which the pair begins.
            let first = if across < 0 { there } else { here };
            let reach = [across.unsigned_abs(), if is_turned { mirrored } else { along }];
            let is_known = reach[0] < ACROSS && !merged[reach[0]][reach[1]].is_empty();
            if is_known {
                let shift = if is_turned { shift } else { 0 };
                terms.push(Term { line: (first + 1) as usize, reach, shift, is_turned, weight: u * v });
            }
        }
    }
    terms
}

/// Length of a coarser line of one number: whole registers, and zeros beside them.
fn width(coarse: usize) -> usize {
    coarse.next_multiple_of(PADDING) + 2 * MARGIN
}

impl Scratch {
    fn new(fine: usize, coarse: usize) -> Scratch {
        let line = || vec![0.0; 9 * width(coarse)];
        Scratch {
            raw: array::from_fn(|_| vec![[0.0; PADDING]; fine.div_ceil(PADDING) + 1]),
            parted: array::from_fn(|_| array::from_fn(|_| line())),
            merged: array::from_fn(|_| array::from_fn(|_| array::from_fn(|_| line()))),
            coarser: line(),
        }
    }
}

/// Some coarser lines.
struct Half<'a> {
    plan: &'a Plan,
    from: &'a Numbers,
    to: [&'a mut [Sixteen<9>]; PLANES],
    scratch: &'a mut Scratch,
    /// Which they are, and the sixteen that their planes begin with.
    lines: Range<usize>,
    first: usize,
}

impl WithSimd for Half<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let [fine, _] = self.plan.fine;
        for line in self.lines.clone() {
            let [before, .., last] = &mut self.scratch.merged;
            mem::swap(before, last);
            let first = if line == self.lines.start { 0 } else { 1 };
            for place in first..3 {
                self.merge_along(simd, place, (2 * line + place).checked_sub(1).filter(|line| *line < fine));
            }
            for plane in 0..PLANES {
                let terms = &self.plan.coarser[plane];
                let Scratch { merged, coarser, .. } = &mut *self.scratch;
                sum(simd, coarser, terms, |term| &merged[term.line][term.reach[0]][term.reach[1]]);
                self.keep(line, plane);
            }
        }
    }
}

impl Half<'_> {
    /// Merges a finer line along itself; none counts as zero.
    #[inline(always)]
    fn merge_along<S: Simd>(&mut self, simd: S, place: usize, line: Option<usize>) {
        let Plan { fine: [_, fine], coarse: [_, coarse], blocks, merged: terms, .. } = self.plan;
        let Scratch { raw, parted: [even, odd], merged, .. } = &mut *self.scratch;
        for (across, (merged, terms)) in merged[place].iter_mut().zip(terms).enumerate() {
            let Some(line) = line else {
                merged.iter_mut().for_each(|line| line.fill(0.0));
                continue;
            };
            for &([.., along], at) in blocks.iter().filter(|kind| kind.0[0] == across) {
                part(self.from, at + line * fine, [*fine, *coarse], raw, [&mut even[along], &mut odd[along]]);
            }
            for (to, terms) in merged.iter_mut().zip(terms).filter(|(_, terms)| !terms.is_empty()) {
                sum(simd, to, terms, |term| &[&*even, &*odd][term.line][term.reach[1]]);
            }
        }
    }

    /// Keeps a coarser line of a plane.
    #[inline(always)]
    fn keep(&mut self, line: usize, plane: usize) {
        let [_, coarse] = self.plan.coarse;
        let (to, line_of) = (&mut self.to[plane], &self.scratch.coarser);
        let from = line * coarse - self.first * PADDING;
        let behind = from + coarse;
        for (sixteen, to) in to.iter_mut().enumerate().take(behind.div_ceil(PADDING)).skip(from / PADDING) {
            let start = sixteen * PADDING;
            for (k, to) in to.0.iter_mut().enumerate() {
                let own = &line_of[k * width(coarse) + MARGIN..];
                let (first, last) = (from.max(start), behind.min(start + PADDING));
                // Whole sixteens are copied by instructions of known length.
                if last - first == PADDING {
                    to.copy_from_slice(&own[first - from..][..PADDING]);
                } else {
                    to[first - start..last - start].copy_from_slice(&own[first - from..last - from]);
                }
            }
        }
    }
}

/// Parts a finer line of blocks, from a place on, into its even places and its odd ones.
#[inline(always)]
fn part(
    from: &Numbers,
    at: usize,
    [fine, coarse]: [usize; 2],
    raw: &mut [Vec<[f32; PADDING]>; 9],
    [even, odd]: [&mut [f32]; 2],
) {
    let sixteens = &from.blocks[at / PADDING..(at + fine).div_ceil(PADDING)];
    // In the order in which they lie, as memory is read ahead then.
    for (place, sixteen) in sixteens.iter().enumerate() {
        for (raw, numbers) in raw.iter_mut().zip(&sixteen.0) {
            raw[place] = *numbers;
        }
    }
    for (k, raw) in raw.iter().enumerate() {
        let line = &raw.as_flattened()[at % PADDING..][..fine];
        let start = k * width(coarse) + MARGIN;
        let (even, odd) = (&mut even[start..][..coarse], &mut odd[start..][..coarse - 1]);
        let (pairs, last) = line.as_chunks::<2>();
        for ((&[a, b], even), odd) in pairs.iter().zip(&mut *even).zip(odd) {
            (*even, *odd) = (a, b);
        }
        even[coarse - 1] = last[0];
    }
}

/// Adds up a line of blocks. Beyond the ends of lines nothing but zeros is added, as no block leads there.
#[inline(always)]
fn sum<'a, S: Simd>(simd: S, to: &mut [f32], terms: &[Term], of: impl Fn(&Term) -> &'a Vec<f32>) {
    let width = to.len() / 9;
    for at in (MARGIN..width - MARGIN).step_by(S::F32_LANES) {
        let mut sums = [simd.splat_f32s(0.0); 9];
        for term in terms {
            let (from, weight) = (of(term), simd.splat_f32s(term.weight));
            let at = at.wrapping_add_signed(term.shift);
            if term.is_turned {
                for k in 0..9 {
                    sums[k] = simd.mul_add_e_f32s(load(simd, from, TURNED[k] * width + at), weight, sums[k]);
                }
            } else {
                for k in 0..9 {
                    sums[k] = simd.mul_add_e_f32s(load(simd, from, k * width + at), weight, sums[k]);
                }
            }
        }
        for k in 0..9 {
            store(simd, to, k * width + at, sums[k]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::minimize::multigrid::{
        coarsen::coarsen,
        coarser::{lines_of, sources, spread},
        matrix::Matrix,
        products::Products,
        transfer::Transfer,
    };
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;
    use std::sync::Arc;

    /// A lattice's matrix whose rows couple with others as those of cloth do.
    fn cloth([rows, step]: [usize; 2]) -> Matrix {
        let reach: [[isize; 2]; 12] = [
            [0, 1],
            [0, 2],
            [1, -1],
            [1, 0],
            [1, 1],
            [2, 0],
            [0, -1],
            [0, -2],
            [-1, 1],
            [-1, 0],
            [-1, -1],
            [-2, 0],
        ];
        let row = |n: usize| -> Vec<u32> {
            let others = reach.iter().filter_map(|&[i, j]| {
                let [i, j] = [(n / step).checked_add_signed(i)?, (n % step).checked_add_signed(j)?];
                (i < rows && j < step).then_some((i * step + j) as u32)
            });
            std::iter::once(n as u32).chain(others).collect()
        };
        Matrix::new((0..rows * step).map(row).collect(), false)
    }

    #[test]
    fn lattices_merge_to_what_products_make() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for counts in [[13, 9], [45, 29], [77, 33], [9, 101]] {
            let mut finest = cloth(counts);
            let lines = Arc::new(lines_of(&finest));
            let mut numbers = Numbers::new(lines.clone());
            for row in 0..finest.len() as u32 {
                for place in finest.row(row as usize) {
                    let column = finest.columns[place];
                    if column < row {
                        continue;
                    }
                    // What is held has no part in anything.
                    let is_held = row == 5 || column == 5;
                    let mut block: [f32; 9] = [0.0; 9];
                    if !is_held {
                        block = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
                    }
                    if row == column {
                        block = std::array::from_fn(|k| block[k] + block[TURNED[k]]);
                    }
                    *finest.block_mut(place) = block;
                    let turned = finest.place(column, row).unwrap();
                    *finest.block_mut(turned as usize) = TURNED.map(|k| block[k]);
                }
            }
            let put = |numbers: &mut Numbers, matrix: &Matrix| {
                let sources = sources(&numbers.lines, matrix);
                spread(numbers, &sources, matrix);
            };
            put(&mut numbers, &finest);
            let sites = (0..finest.len()).map(|n| [n / counts[1], n % counts[1]]).collect();
            let (mut fine, mut counts) = (finest, counts);
            for masters in coarsen(sites).into_iter().take(2) {
                let (transfer, mut coarse) = Transfer::new(&fine, masters, None, usize::MAX);
                let lines = Arc::new(lines_of(&coarse));
                let Some(mut lattice) = Lattice::new(counts, &numbers.lines, &lines) else {
                    assert!(counts.iter().any(|lines| lines % 2 == 0 || *lines < 9), "{counts:?}");
                    break;
                };
                Products::new(&fine, &transfer, &coarse).merge(Team::nobody(), &fine, &mut coarse);
                let [mut expected, mut merged] = [(); 2].map(|_| Numbers::new(lines.clone()));
                put(&mut expected, &coarse);
                // Nothing of a matrix before is left.
                let places = (0..PLANES * lines.plane).filter(|at| at % lines.plane < lines.particles);
                places.for_each(|at| merged.set_block(at, [1e3; 9]));
                lattice.merge(Team::nobody(), &numbers, &mut merged);
                for at in 0..lines.stride {
                    for (a, b) in merged.block(at).iter().zip(expected.block(at)) {
                        assert!((a - b).abs() < 1e-4, "{counts:?}: {a} instead of {b} at {at}");
                    }
                }
                counts = counts.map(|lines| lines / 2 + 1);
                (fine, numbers) = (coarse, merged);
            }
        }
    }
}
