//! Multifrontal Cholesky factor of a `System`: symbolic once per mesh, numeric once per Newton step.
//!
//! Every region of the pattern's nested dissection is a dense front; a front's update matrix waits on a stack for its
//! parent [Duff & Reid 1983]. Nothing is allocated after `new`. It does not reorder or pivot: a matrix that is not positive
//! definite is refused. Both halves of the dissection are factorized at once where a core is free; results are the same bits either way.

use super::Method;
use crate::{
    cores::{self, Beside},
    potential::pattern::Pattern,
};
use dense::{eliminate, extend};
use fronts::{Fork, Front, Tree};
use lanes::{Lanes, Plain};
use std::{ops::Range, sync::Arc};
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
            Method::Fronts | Method::Multigrid | Method::Precise => Cholesky::Fronts(Factor::new(pattern)),
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

/// A factor and its scratch memory.
pub struct Factor {
    tree: Arc<Tree>,
    /// The fronts before the fork; none where nothing can be done at once.
    first: Half,
    /// The fronts beside those, which another core may factorize.
    second: Beside<Half>,
    /// Columns of all later fronts, diagonals inverted.
    columns: Aligned,
    /// Right-hand sides on a front's rows.
    rows: Aligned,
    machine: Machine,
}

impl Factor {
    /// Symbolic factorization of a pattern, in the pattern's own order.
    pub fn new(pattern: &Pattern) -> Factor {
        Factor::on(pattern, Machine::here())
    }

    fn on(pattern: &Pattern, machine: Machine) -> Factor {
        let tree = Arc::new(Tree::new(pattern));
        let (middle, end) = tree.fork.map_or((0, 0), |fork| (fork.middle, fork.end));
        let half = |fronts, [even, odd]: [usize; 2]| Half {
            columns: Aligned::new(tree.columns(&fronts).len()),
            fronts,
            stacks: [Aligned::new(even), Aligned::new(odd)],
            values: Vec::new(),
            done: Ok(()),
            machine,
            tree: tree.clone(),
        };
        let [a, b, c, d] = tree.stacks;
        let mut second = half(middle..end, [c, d]);
        if tree.fork.is_some_and(Fork::pays) {
            second.values.reserve(tree.entries(&second.fronts).len());
        }
        Factor {
            first: half(0..middle, [a, b]),
            second: Beside::new(second),
            columns: Aligned::new(tree.columns(&(end..tree.fronts.len())).len()),
            rows: Aligned::new(tree.tallest * COLUMNS),
            machine,
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
        self.halves(values, self.tree.fork.is_some_and(Fork::pays));
        let Factor { tree, first, second, columns, machine, .. } = self;
        let mut beside = second.take();
        let later = beside.fronts.end..tree.fronts.len();
        let halves = first.done.and(beside.done);
        let rest = halves.and_then(|()| {
            machine.run(Factorize {
                tree,
                values: &values[tree.entries(&later)],
                fronts: later,
                columns: columns.get(),
                stacks: first.stacks.each_mut().map(Aligned::get),
                beside: beside.stacks.each_mut().map(|stack| &*stack.get()),
            })
        });
        second.put(beside);
        rest
    }

    /// Factorizes both halves, the second on another core if it is `apart` and one is free.
    fn halves(&mut self, values: &[f64], apart: bool) {
        let Factor { tree, first, second, .. } = self;
        let mut beside = second.take();
        let its_values = &values[tree.entries(&beside.fronts)];
        if apart {
            beside.values.clear();
            beside.values.extend_from_slice(its_values);
            second.start(beside);
            first.factorize(&values[tree.entries(&first.fronts)]);
        } else {
            first.factorize(&values[tree.entries(&first.fronts)]);
            beside.factorize(its_values);
            second.put(beside);
        }
    }

    /// Solves for `columns` right-hand sides in place, column by column in `rhs`.
    pub fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        match columns {
            1 => self.solve_for::<1>(rhs),
            2 => self.solve_for::<2>(rhs),
            3 => self.solve_for::<3>(rhs),
            4 => self.solve_for::<4>(rhs),
            _ => panic!("{columns} right-hand sides; at most {COLUMNS} are solved at once"),
        }
    }

    fn solve_for<const N: usize>(&mut self, rhs: &mut [f64]) {
        let Factor { tree, first, second, columns, rows, machine } = self;
        let mut beside = second.take();
        let later = beside.fronts.end..tree.fronts.len();
        let parts = [
            Part { fronts: first.fronts.clone(), columns: first.columns.get() },
            Part { fronts: beside.fronts.clone(), columns: beside.columns.get() },
            Part { fronts: later, columns: columns.get() },
        ];
        machine.run(Solve::<N> { tree, parts, rows: rows.get(), rhs });
        second.put(beside);
    }
}

/// One of two parts of the tree that have nothing to do with each other, with all that its factorization needs.
struct Half {
    tree: Arc<Tree>,
    fronts: Range<usize>,
    /// Their columns, diagonals inverted.
    columns: Aligned,
    /// Their updates.
    stacks: [Aligned; 2],
    /// The matrix's values that belong to them, for another core.
    values: Vec<f64>,
    /// How the last factorization went.
    done: Result<(), Indefinite>,
    machine: Machine,
}

impl Half {
    /// Numeric factorization of its part of the lower triangle.
    fn factorize(&mut self, values: &[f64]) {
        self.done = self.machine.run(Factorize {
            tree: &self.tree,
            fronts: self.fronts.clone(),
            values,
            columns: self.columns.get(),
            stacks: self.stacks.each_mut().map(Aligned::get),
            beside: [&[], &[]],
        });
    }
}

impl cores::Work for Half {
    fn work(&mut self) {
        let values = std::mem::take(&mut self.values);
        self.factorize(&values);
        self.values = values;
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
    /// The matrix's values that belong to them.
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
        let [first_column, first_entry] = [tree.columns(&fronts).start, tree.entries(&fronts).start];
        for front in &tree.fronts[fronts] {
            let (own_stack, child_stack) =
                if front.stack.is_multiple_of(2) { (&mut *even, &*odd) } else { (&mut *odd, &*even) };
            let columns = &mut columns[from(&front.values, first_column)];
            let updates = |child: &Front| {
                let same_part = child.stack / 2 == front.stack / 2;
                let stack = if same_part { child_stack } else { beside[child.stack % 2] };
                &stack[child.update.clone()]
            };
            let update = &mut own_stack[front.update.clone()];
            columns.fill(0.0);
            let entries = from(&front.entries, first_entry);
            for (&place, value) in tree.places[front.entries.clone()].iter().zip(&values[entries]) {
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

/// A range counted from another place.
fn from(range: &Range<usize>, place: usize) -> Range<usize> {
    range.start - place..range.end - place
}

/// Columns of neighbouring fronts.
struct Part<'a> {
    fronts: Range<usize>,
    columns: &'a [f64],
}

struct Solve<'a, const N: usize> {
    tree: &'a Tree,
    parts: [Part<'a>; 3],
    rows: &'a mut [f64],
    rhs: &'a mut [f64],
}

impl<const N: usize> Work for Solve<'_, N> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes>(self) {
        let Solve { tree, parts, rows, rhs } = self;
        let size = rhs.len() / N;
        for Part { fronts, columns } in &parts {
            let first = tree.columns(fronts).start;
            for front in &tree.fronts[fronts.clone()] {
                forward::<V, N>(front, &columns[from(&front.values, first)], rows, rhs, size);
            }
        }
        for Part { fronts, columns } in parts.iter().rev() {
            let first = tree.columns(fronts).start;
            for front in tree.fronts[fronts.clone()].iter().rev() {
                backward::<V, N>(front, &columns[from(&front.values, first)], rows, rhs, size);
            }
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
        let mut halves = |values: &[f64], apart| {
            factor.halves(values, apart);
            let mut second = factor.second.take();
            let columns = [factor.first.columns.get().to_vec(), second.columns.get().to_vec()].concat();
            second.columns.get().fill(f64::NAN);
            let done = second.done;
            factor.second.put(second);
            (columns.into_iter().map(f64::to_bits).collect::<Vec<u64>>(), done)
        };
        let alone = halves(&values, false);
        assert_eq!(alone.1, Ok(()));
        for _ in 0..10 {
            assert!(halves(&values, true) == alone);
        }
        let fork = factor.tree.entries(&(fork.middle..fork.end));
        values[fork.start] = -1.0;
        factor.halves(&values, true);
        assert_eq!(factor.factorize(&pattern, &values), Err(Indefinite));
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
                let mut factor = Factor::on(&pattern, machine);
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
