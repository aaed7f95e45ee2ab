//! Of which shapes the soft elements' blocks were made, batch by batch: those whose edges have hardly turned since are left as they are, and
//! for the others what they have become is added and what they were is taken off.

#![expect(clippy::needless_range_loop, reason = "lanes and nodes read best by their numbers")]

use super::{
    Curvature,
    halves::{Part, add_parts},
    kernels::{Given, gather_all, lean},
    pattern::Pattern,
    values::Values,
};
use crate::{
    batch::{Batches, ShearBatch, TripleBatch},
    cores::Team,
    math::pack::{Pack, Pack3, WIDTH, dispatch, dot, scale, sub},
};
use pulp::{Simd, WithSimd};

/// Shortest and longest that an edge may be over its rest length where blocks are changed by differences: what collapsed is so much stiffer
/// than what it becomes that the difference would be rounding.
const EXTENT: [f64; 2] = [0.25, 4.0];

/// A batch as its blocks were made: where its nodes were and what its elements remembered.
#[derive(Clone)]
pub struct Shape<const N: usize> {
    nodes: [[[f64; WIDTH]; 3]; N],
    history: [f64; WIDTH],
    /// Whether they are to be made anew.
    is_due: bool,
}

/// The batches of all parts as their blocks were made.
pub struct Made {
    parts: [Of; 3],
}

/// Those of one part.
struct Of {
    triples: Vec<Shape<5>>,
    cells: Vec<Shape<4>>,
}

/// What becomes of the blocks of a part's batches of one kind.
pub enum Making<'a, const N: usize> {
    /// All are made; nobody asks later of what.
    Once,
    /// All are made.
    Whole(&'a mut [Shape<N>]),
    /// Those that are due change.
    Due(&'a mut [Shape<N>]),
}

/// The same of all kinds.
struct Makings<'a> {
    triples: Making<'a, 5>,
    cells: Making<'a, 4>,
}

/// Adds what soft elements bring to a matrix that may lag, at the given shape, in halves; the sums are the same whoever does which.
pub fn add_lean(given: Given, kind: Curvature, values: &mut Values, team: &Team) {
    add_all(given, kind, values, [(); 3].map(|()| Makings::ONCE), team);
}

fn add_all(given: Given, kind: Curvature, values: &mut Values, makings: [Makings; 3], team: &Team) {
    add_parts(values, team, makings, |part, Makings { triples: making, cells }, values| {
        let Pattern { triples: slots, shears, ghosted, .. } = values.pattern;
        let stencils = &ghosted.lines;
        dispatch(lean::Triples { given, kind, part, making, slots, stencils, values });
        let (making, slots, stencils) = (cells, shears, (&ghosted.shears, &ghosted.mixed));
        dispatch(lean::Cells { given, kind, part, making, slots, stencils, values });
    });
}

impl Makings<'_> {
    const ONCE: Makings<'static> = Makings { triples: Making::Once, cells: Making::Once };
}

impl Made {
    /// Of nothing yet.
    pub fn new(pattern: &Pattern, batches: &Batches) -> Made {
        let count = |part: Part, kind: usize, of: usize| {
            (0..of).filter(|&k| Part::of(&pattern.parts[kind], k) == part).count()
        };
        let parts = [Part::Low, Part::High, Part::Across].map(|part| Of {
            triples: vec![Shape::unknown(); count(part, 0, batches.triples.len())],
            cells: vec![Shape::unknown(); count(part, 1, batches.shears.len())],
        });
        Made { parts }
    }

    /// Finds which batches are due at a shape: those with an edge that has turned or stretched farther than that, over its rest length.
    pub fn look(&mut self, given: Given, pattern: &Pattern, reach: f64, team: &Team) -> Looked {
        let [low, high, across] = &mut self.parts;
        let (mut one, mut other) = (Looked::default(), Looked::default());
        team.both(
            || one = dispatch(Look { given, part: Part::Low, pattern, of: low, reach }),
            || other = dispatch(Look { given, part: Part::High, pattern, of: high, reach }),
        );
        one.and(other).and(dispatch(Look { given, part: Part::Across, pattern, of: across, reach }))
    }

    /// Adds the blocks of all batches, or changes those that are due.
    pub fn add(&mut self, given: Given, kind: Curvature, values: &mut Values, is_whole: bool, team: &Team) {
        let makings = self.parts.each_mut().map(|Of { triples, cells }| match is_whole {
            true => Makings { triples: Making::Whole(triples), cells: Making::Whole(cells) },
            false => Makings { triples: Making::Due(triples), cells: Making::Due(cells) },
        });
        add_all(given, kind, values, makings, team);
    }
}

/// What became of batches since their blocks were made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Looked {
    /// Batches that are due.
    pub due: usize,
    /// All of them.
    pub all: usize,
    /// Whether an edge is or was beyond `EXTENT`, or a place is not a number.
    pub is_beyond: bool,
}

impl<const N: usize> Shape<N> {
    fn unknown() -> Shape<N> {
        Shape { nodes: [[[f64::NAN; WIDTH]; 3]; N], history: [0.0; WIDTH], is_due: true }
    }

    /// Nodes, and numbers that elements remember, in lanes from one on.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, from: usize) -> ([Pack3<S>; N], Pack<S>) {
        let mut nodes = [[Pack::splat(simd, 0.0); 3]; N];
        for n in 0..N {
            for k in 0..3 {
                nodes[n][k] = Pack::load(simd, &self.nodes[n][k], from);
            }
        }
        (nodes, Pack::load(simd, &self.history, from))
    }

    /// Keeps them.
    #[inline(always)]
    pub fn store<S: Simd>(&mut self, from: usize, (nodes, history): ([Pack3<S>; N], Pack<S>)) {
        for n in 0..N {
            for k in 0..3 {
                nodes[n][k].store(&mut self.nodes[n][k], from);
            }
        }
        history.store(&mut self.history, from);
    }
}

impl<'a, const N: usize> Making<'a, N> {
    /// What is known of a part's batch, by its number there: whether it is to be made, and what it was made of.
    #[inline(always)]
    pub fn of(&mut self, batch: usize) -> (bool, Option<&mut Shape<N>>) {
        match self {
            Making::Once => (true, None),
            Making::Whole(shapes) => (true, Some(&mut shapes[batch])),
            Making::Due(shapes) => (shapes[batch].is_due, Some(&mut shapes[batch])),
        }
    }

    /// Whether what was is to be taken off.
    #[inline(always)]
    pub fn replaces(&self) -> bool {
        matches!(self, Making::Due(_))
    }
}

/// Finds which batches of a part are due: those with an edge that has turned or stretched farther than that, over its rest length.
struct Look<'a> {
    given: Given<'a>,
    part: Part,
    pattern: &'a Pattern,
    of: &'a mut Of,
    reach: f64,
}

impl WithSimd for Look<'_> {
    type Output = Looked;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Looked {
        let Look { given: Given { batches, x, .. }, part, pattern, of, reach } = self;
        let mut looked = Looked::default();
        let mut shapes = of.triples.iter_mut();
        for (k, batch) in batches.triples.iter().enumerate() {
            if Part::of(&pattern.parts[0], k) != part {
                continue;
            }
            let shape = shapes.next().expect("one for each");
            let mut change = Change::new(simd);
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let now = gather_all(simd, x, batch.is_run, &batch.nodes, from);
                let size = Pack::load(simd, &batch.size, from);
                change.take(batch.edges(simd, from), size, now, shape.load(simd, from).0);
            }
            shape.is_due = looked.take(&change, reach);
        }
        let mut shapes = of.cells.iter_mut();
        for (k, batch) in batches.shears.iter().enumerate() {
            if Part::of(&pattern.parts[1], k) != part {
                continue;
            }
            let shape = shapes.next().expect("one for each");
            let mut change = Change::new(simd);
            for from in (0..WIDTH).step_by(S::F64_LANES) {
                let now = gather_all(simd, x, batch.is_run, &batch.nodes, from);
                let size = Pack::load(simd, &batch.size, from);
                change.take(batch.edges(simd, from), size, now, shape.load(simd, from).0);
            }
            shape.is_due = looked.take(&change, reach);
        }
        looked
    }
}

/// Two nodes and the reciprocal of how far they are apart at rest [1/m].
type Edge<S> = (usize, usize, Pack<S>);

impl TripleBatch {
    #[inline(always)]
    fn edges<S: Simd>(&self, simd: S, from: usize) -> [Edge<S>; 3] {
        [
            (0, 1, Pack::load(simd, &self.inverses[0], from)),
            (1, 2, Pack::load(simd, &self.inverses[1], from)),
            (3, 4, Pack::load(simd, &self.across, from)),
        ]
    }
}

impl ShearBatch {
    #[inline(always)]
    fn edges<S: Simd>(&self, simd: S, from: usize) -> [Edge<S>; 4] {
        let [u, v] = [Pack::load(simd, &self.halves[0], from), Pack::load(simd, &self.halves[1], from)];
        let (along, across) = (u + u, v + v);
        [(0, 1, along), (2, 3, along), (0, 2, across), (1, 3, across)]
    }
}

/// Squares over all lanes and edges of a batch: the largest change, and how long the shortest and the longest edge is or was.
struct Change<S: Simd> {
    most: Pack<S>,
    shortest: Pack<S>,
    longest: Pack<S>,
    sum: Pack<S>,
}

impl<S: Simd> Change<S> {
    #[inline(always)]
    fn new(simd: S) -> Change<S> {
        let (zero, one) = (Pack::splat(simd, 0.0), Pack::splat(simd, 1.0));
        Change { most: zero, shortest: one, longest: one, sum: zero }
    }

    #[inline(always)]
    fn take<const N: usize, const E: usize>(
        &mut self,
        edges: [Edge<S>; E],
        size: Pack<S>,
        now: [Pack3<S>; N],
        before: [Pack3<S>; N],
    ) {
        let [zero, one] = [size.like(0.0), size.like(1.0)];
        for e in 0..E {
            let (a, b, inverse) = edges[e];
            let (is, was) = (scale(sub(now[b], now[a]), inverse), scale(sub(before[b], before[a]), inverse));
            let change = sub(is, was);
            // Lanes that do not count have no size.
            let square = zero.select_less(size, dot(change, change), zero);
            self.most = self.most.max(square);
            self.sum = self.sum + square;
            for length in [dot(is, is), dot(was, was)] {
                let length = zero.select_less(size, length, one);
                self.longest = self.longest.max(length);
                self.shortest = length.select_less(self.shortest, length, self.shortest);
            }
        }
    }
}

impl Looked {
    /// Of two parts together.
    pub fn and(self, other: Looked) -> Looked {
        Looked {
            due: self.due + other.due,
            all: self.all + other.all,
            is_beyond: self.is_beyond || other.is_beyond,
        }
    }

    /// Counts a batch; whether it is due.
    #[inline(always)]
    fn take<S: Simd>(&mut self, change: &Change<S>, reach: f64) -> bool {
        let mut lanes = [[0.0; WIDTH]; 4];
        let Change { most, shortest, longest, sum } = *change;
        for (lanes, value) in lanes.iter_mut().zip([most, sum, longest, shortest]) {
            value.store(lanes, 0);
        }
        let [most, sum, longest, shortest] = lanes;
        let count = S::F64_LANES;
        let greatest = |list: &[f64; WIDTH]| list[..count].iter().copied().fold(0.0, f64::max);
        let least = shortest[..count].iter().copied().fold(f64::INFINITY, f64::min);
        let is_due = greatest(&most) > reach * reach;
        // What is not a number is left in the sum.
        let is_number = sum[..count].iter().sum::<f64>().is_finite();
        let is_within = least >= EXTENT[0] * EXTENT[0] && greatest(&longest) <= EXTENT[1] * EXTENT[1];
        self.all += 1;
        self.due += usize::from(is_due);
        self.is_beyond |= !(is_number && is_within);
        is_due
    }
}
