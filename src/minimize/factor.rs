//! Multifrontal Cholesky factor of a `System`: symbolic once per mesh, numeric once per Newton step.
//!
//! Every region of the pattern's nested dissection is a dense front; a front's update matrix waits on a stack for its
//! parent [Duff & Reid 1983]. Nothing is allocated after `new`. It does not reorder or pivot: a matrix that is not positive
//! definite is refused. Both halves of the dissection are factorized at once where a core is free; results are the same bits either way.

use super::{
    Method,
    cores::{self, Core},
};
use crate::potential::pattern::Pattern;
use dense::{eliminate, extend};
use fronts::{Fork, Front, Tree};
use lanes::{Lanes, Plain};
use std::ops::Range;
use triangular::{backward, forward};

mod fronts;
mod lanes;
mod dense;
mod triangular;
pub mod reference;

/// The matrix was not positive definite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Indefinite;

/// Most right-hand sides solved at once: the residual and the hand's three columns.
pub const COLUMNS: usize = 4;

/// A factor by either method.
pub enum Cholesky {
    /// Ours.
    Fronts(Factor),
    /// faer's.
    Faer(reference::Reference),
}

impl Cholesky {
    /// Symbolic factorization of a pattern.
    pub fn new(pattern: &Pattern, method: Method) -> Cholesky {
        match method {
            Method::Fronts | Method::Multigrid => Cholesky::Fronts(Factor::new(pattern)),
            Method::Faer => Cholesky::Faer(reference::Reference::new(pattern)),
        }
    }

    /// Numeric factorization of the lower triangle `values`.
    pub fn factorize(&mut self, pattern: &Pattern, values: &[f64]) -> Result<(), Indefinite> {
        match self {
            Cholesky::Fronts(factor) => factor.factorize(pattern, values),
            Cholesky::Faer(factor) => factor.factorize(pattern, values),
        }
    }

    /// Solves for `columns` right-hand sides in place, column by column in `rhs`.
    pub fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        match self {
            Cholesky::Fronts(factor) => factor.solve(rhs, columns),
            Cholesky::Faer(factor) => factor.solve(rhs, columns),
        }
    }
}

/// Multiplications and additions in the smaller half from which on a second core pays: at 39 × 39 (2e7) it gains nothing.
const WORTH: f64 = 5e7;

/// A factor and its scratch memory.
pub struct Factor {
    tree: Tree,
    /// Columns of all fronts, diagonals inverted.
    values: Aligned,
    stacks: [Aligned; 4],
    /// Right-hand sides on a front's rows.
    rows: Aligned,
    machine: Machine,
}

impl Factor {
    /// Symbolic factorization of a pattern, in the pattern's own order.
    pub fn new(pattern: &Pattern) -> Factor {
        let tree = Tree::new(pattern);
        Factor {
            values: Aligned::new(tree.len),
            stacks: tree.stacks.map(Aligned::new),
            rows: Aligned::new(tree.tallest * COLUMNS),
            machine: Machine::here(),
            tree,
        }
    }

    /// Values in the factor.
    #[expect(clippy::len_without_is_empty, reason = "a factor is never empty")]
    pub fn len(&self) -> usize {
        self.tree.len
    }

    /// Numeric factorization of the lower triangle `values`.
    pub fn factorize(&mut self, _pattern: &Pattern, values: &[f64]) -> Result<(), Indefinite> {
        let pays = self.tree.fork.is_some_and(|fork| fork.work > WORTH);
        self.factorize_on(if pays { cores::claim() } else { None }, values)
    }

    /// The same with a core for one half, or without.
    fn factorize_on(&mut self, core: Option<Core>, values: &[f64]) -> Result<(), Indefinite> {
        let Factor { tree, values: columns, stacks, machine, .. } = self;
        let [a, b, c, d] = stacks.each_mut().map(Aligned::get);
        let columns = columns.get();
        let (fronts, machine) = (&tree.fronts, *machine);
        let Some(Fork { middle, end, .. }) = tree.fork else {
            let fronts = 0..fronts.len();
            return machine.run(Factorize { tree, fronts, values, columns, stacks: [a, b], beside: [c, d] });
        };
        let (first, second) = columns.split_at_mut(fronts[middle].values.start);
        let one =
            Factorize { tree, fronts: 0..middle, values, columns: first, stacks: [a, b], beside: [&[], &[]] };
        let two = Factorize {
            tree,
            fronts: middle..end,
            values,
            columns: second,
            stacks: [c, d],
            beside: [&[], &[]],
        };
        if let Some(core) = core {
            let (one, two) = cores::both(core, || machine.run(one), || machine.run(two));
            one.and(two)?;
        } else {
            machine.run(one)?;
            machine.run(two)?;
        }
        machine.run(Factorize {
            tree,
            fronts: end..fronts.len(),
            values,
            columns: &mut columns[fronts[end].values.start..],
            stacks: [a, b],
            beside: [c, d],
        })
    }

    /// Solves for `columns` right-hand sides in place, column by column in `rhs`.
    pub fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        let Factor { tree, values, rows, machine, .. } = self;
        let size = rhs.len() / columns;
        let (columns_of, rows) = (values.get(), rows.get());
        match columns {
            1 => machine.run(Solve::<1> { tree, columns: columns_of, rows, rhs, size }),
            2 => machine.run(Solve::<2> { tree, columns: columns_of, rows, rhs, size }),
            3 => machine.run(Solve::<3> { tree, columns: columns_of, rows, rhs, size }),
            4 => machine.run(Solve::<4> { tree, columns: columns_of, rows, rhs, size }),
            _ => panic!("{columns} right-hand sides; at most {COLUMNS} are solved at once"),
        }
    }
}

/// Numbers that begin at a cache line.
struct Aligned {
    memory: Vec<f64>,
    start: usize,
    len: usize,
}

impl Aligned {
    fn new(len: usize) -> Aligned {
        let memory = vec![0.0; len + fronts::LANES];
        // Without alignment (it may be refused) all is as right, only slower.
        let start = memory.as_ptr().align_offset(64).min(fronts::LANES);
        Aligned { memory, start, len }
    }

    fn get(&mut self) -> &mut [f64] {
        &mut self.memory[self.start..self.start + self.len]
    }
}

/// Work that runs on any kind of lanes.
trait Work {
    type Output;
    fn run<V: Lanes>(self) -> Self::Output;
}

/// What the processor offers; asked once.
#[derive(Clone, Copy)]
enum Machine {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Any,
}

impl Machine {
    fn here() -> Machine {
        #[cfg(target_arch = "x86_64")]
        {
            use crate::math::pack::{Arch, instructions};
            match instructions() {
                Arch::V4(_) => return Machine::Avx512,
                Arch::V3(_) => return Machine::Avx2,
                _ => {}
            }
        }
        Machine::Any
    }

    fn run<T: Work>(self, work: T) -> T::Output {
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f")]
        fn avx512<T: Work>(work: T) -> T::Output {
            work.run::<lanes::Wide>()
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        fn avx2<T: Work>(work: T) -> T::Output {
            work.run::<Plain<true>>()
        }
        match self {
            // Safety: `here` has asked the processor for these instructions.
            #[cfg(target_arch = "x86_64")]
            Machine::Avx512 => unsafe { avx512(work) },
            #[cfg(target_arch = "x86_64")]
            Machine::Avx2 => unsafe { avx2(work) },
            Machine::Any => work.run::<Plain<{ cfg!(target_arch = "aarch64") }>>(),
        }
    }
}

/// Factorizes some of the fronts, in order.
struct Factorize<'a> {
    tree: &'a Tree,
    fronts: Range<usize>,
    values: &'a [f64],
    /// Their columns, one front after the other.
    columns: &'a mut [f64],
    /// Their updates.
    stacks: [&'a mut [f64]; 2],
    /// Updates of the other part of a fork.
    beside: [&'a [f64]; 2],
}

impl Work for Factorize<'_> {
    type Output = Result<(), Indefinite>;

    #[inline(always)]
    fn run<V: Lanes>(self) -> Result<(), Indefinite> {
        let Factorize { tree, fronts, values, columns, stacks: [even, odd], beside } = self;
        let base = tree.fronts[fronts.start].values.start;
        for front in &tree.fronts[fronts] {
            let (own_stack, child_stack) =
                if front.stack.is_multiple_of(2) { (&mut *even, &*odd) } else { (&mut *odd, &*even) };
            let columns = &mut columns[front.values.start - base..front.values.end - base];
            let updates = |child: &Front| {
                let same_part = child.stack / 2 == front.stack / 2;
                let stack = if same_part { child_stack } else { beside[child.stack % 2] };
                &stack[child.update.clone()]
            };
            let update = &mut own_stack[front.update.clone()];
            columns.fill(0.0);
            for (&place, value) in
                tree.places[front.entries.clone()].iter().zip(&values[front.entries.clone()])
            {
                columns[place as usize] = *value;
            }
            for &child in &front.children {
                let child = &tree.fronts[child as usize];
                let runs = child.into_own;
                extend::<V>(child, updates(child), 0..runs, columns, front.stride, 0);
            }
            eliminate::<V>(front, columns, update)?;
            for &child in &front.children {
                let child = &tree.fronts[child as usize];
                let runs = child.into_own..child.into_parent.len();
                let stride = front.update_stride;
                extend::<V>(child, updates(child), runs, update, stride, front.below);
            }
        }
        Ok(())
    }
}

struct Solve<'a, const N: usize> {
    tree: &'a Tree,
    columns: &'a [f64],
    rows: &'a mut [f64],
    rhs: &'a mut [f64],
    size: usize,
}

impl<const N: usize> Work for Solve<'_, N> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let Solve { tree, columns, rows, rhs, size } = self;
        for front in &tree.fronts {
            forward::<V, N>(front, &columns[front.values.clone()], rows, rhs, size);
        }
        for front in tree.fronts.iter().rev() {
            backward::<V, N>(front, &columns[front.values.clone()], rows, rhs, size);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Grid;

    /// A pattern with values that make it positive definite.
    fn filled(counts: [usize; 2]) -> (Pattern, Vec<f64>) {
        let grid = Grid::uniform(counts, [0.1, 0.1]);
        let pattern = Pattern::new(&grid, &grid.elements(|_| false));
        let mut values: Vec<f64> = (0..pattern.rows.len()).map(|k| (k as f64 * 0.7).sin()).collect();
        pattern.columns[..3 * grid.particles()]
            .iter()
            .for_each(|&diagonal| values[diagonal as usize] = 100.0);
        (pattern, values)
    }

    #[test]
    fn two_cores_give_the_same_bits_as_one() {
        let (pattern, mut values) = filled([34, 41]);
        let mut factor = Factor::new(&pattern);
        let fork = factor.tree.fork.expect("two halves");
        let work: f64 = factor.tree.fronts.iter().map(fronts::Front::work).sum();
        assert!(fork.work > 0.25 * work, "{fork:?} of {work}");
        factor.factorize_on(None, &values).unwrap();
        let alone = factor.values.get().to_vec();
        factor.values.get().fill(f64::NAN);
        factor.factorize_on(Some(Core::another()), &values).unwrap();
        assert!(factor.values.get().iter().zip(&alone).all(|(a, b)| a.to_bits() == b.to_bits()));
        values[0] = -1.0;
        assert_eq!(factor.factorize_on(Some(Core::another()), &values), Err(Indefinite));
    }

    #[test]
    fn every_kind_of_lanes_gives_the_same_solution() {
        let (pattern, values) = filled([13, 22]);
        let mut machines = vec![Machine::Any];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                machines.push(Machine::Avx2);
            }
            if is_x86_feature_detected!("avx512f") {
                machines.push(Machine::Avx512);
            }
        }
        let solutions: Vec<Vec<f64>> = machines
            .into_iter()
            .map(|machine| {
                let mut factor = Factor { machine, ..Factor::new(&pattern) };
                factor.factorize(&pattern, &values).unwrap();
                let mut x: Vec<f64> =
                    (0..12 * pattern.particles.len()).map(|k| (k as f64 * 0.3).cos()).collect();
                factor.solve(&mut x, COLUMNS);
                x
            })
            .collect();
        for other in &solutions[1..] {
            let off = other.iter().zip(&solutions[0]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-13, "{off}");
        }
    }
}
