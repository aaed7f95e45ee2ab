//! Symbolic side of the factor: which rows each front holds, where its values lie, and how a child's update falls into its parent.

use crate::potential::pattern::Pattern;
use std::ops::Range;

/// Values in a vector register of the widest machine; columns of fronts begin at multiples of it.
pub const LANES: usize = 8;

/// A stretch of rows that lie side by side on both sides of a copy.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// First row among the front's boundary rows.
    pub from: u32,
    /// First row at the other side.
    pub to: u32,
    /// Rows.
    pub len: u32,
}

/// A dense front: the columns of one region of the dissection, and the rows of later regions that they reach.
///
/// Rows are kept as own rows, zeros up to a multiple of `LANES`, boundary rows, zeros again.
#[derive(Debug)]
pub struct Front {
    /// First own unknown in elimination order.
    pub first: usize,
    /// Own columns.
    pub own: usize,
    /// First boundary row.
    pub below: usize,
    /// Boundary rows.
    pub reach: usize,
    /// Distance of columns.
    pub stride: usize,
    /// Distance of columns of the update matrix.
    pub update_stride: usize,
    /// Place of the columns in the factor.
    pub values: Range<usize>,
    /// Place of the update matrix on its stack.
    pub update: Range<usize>,
    /// Which of the four stacks holds the update: parents and children take turns on the first two, beside the fork on the others.
    pub stack: usize,
    /// The matrix's values that belong to own columns.
    pub entries: Range<usize>,
    /// Children, as places in the list of fronts.
    pub children: Vec<u32>,
    /// From boundary rows to the parent's rows.
    pub into_parent: Vec<Run>,
    /// How many of `into_parent` fall into the parent's own rows.
    pub into_own: usize,
    /// From boundary rows to unknowns.
    pub unknowns: Vec<Run>,
}

/// Where the tree parts in two that have nothing to do with each other, both before all fronts from `end` on.
#[derive(Clone, Copy, Debug)]
pub struct Fork {
    /// First front of the second part.
    pub middle: usize,
    /// First front after it.
    pub end: usize,
    /// Multiplications and additions in the smaller part.
    pub work: f64,
}

/// All fronts, children before parents.
#[derive(Debug)]
pub struct Tree {
    /// Fronts in elimination order.
    pub fronts: Vec<Front>,
    /// Place among its front's columns of each of the matrix's values.
    pub places: Vec<u32>,
    /// Values in the factor.
    pub len: usize,
    /// Values on each of the stacks.
    pub stacks: [usize; 4],
    /// Where two cores can share the work.
    pub fork: Option<Fork>,
    /// Rows of the tallest front.
    pub tallest: usize,
}

impl Tree {
    /// The fronts of a pattern's dissection.
    pub fn new(pattern: &Pattern) -> Tree {
        let boundaries = boundaries(pattern);
        let regions = &pattern.regions;
        let mut depths = vec![0usize; regions.len()];
        let mut children = vec![Vec::new(); regions.len()];
        for (k, region) in regions.iter().enumerate().rev() {
            if let Some(parent) = region.parent {
                depths[k] = depths[parent as usize] + 1;
            }
        }
        for (k, region) in regions.iter().enumerate() {
            if let Some(parent) = region.parent {
                children[parent as usize].push(k as u32);
            }
        }
        let mut tree = Tree {
            fronts: Vec::with_capacity(regions.len()),
            places: vec![0; pattern.rows.len()],
            len: 0,
            stacks: [0; 4],
            fork: None,
            tallest: 0,
        };
        let beside = second_part(&children);
        let mut tops = [0; 4];
        for (k, region) in regions.iter().enumerate() {
            let (first, end) = (3 * region.ranks.start as usize, 3 * region.ranks.end as usize);
            let (own, reach) = (end - first, 3 * boundaries[k].len());
            let below = own.next_multiple_of(LANES);
            let update_stride = apart(reach.next_multiple_of(LANES));
            let stride = apart(below + reach.next_multiple_of(LANES));
            let stack = depths[k] % 2 + if beside.contains(&k) { 2 } else { 0 };
            let update = tops[stack]..tops[stack] + update_stride * reach;
            tops[stack] = update.end;
            tree.stacks[stack] = tree.stacks[stack].max(update.end);
            for &child in children[k].iter().rev() {
                let child = &tree.fronts[child as usize];
                tops[child.stack] = child.update.start;
            }
            let front = Front {
                first,
                own,
                below,
                reach,
                stride,
                update_stride,
                values: tree.len..tree.len + stride * own,
                update,
                stack,
                entries: pattern.columns[first] as usize..pattern.columns[end] as usize,
                children: std::mem::take(&mut children[k]),
                into_parent: Vec::new(),
                into_own: 0,
                unknowns: runs(boundaries[k].iter().map(|&b| 3 * b), usize::MAX),
            };
            let row = |unknown: u32| row_of(&front, &boundaries[k], unknown);
            for column in first..end {
                for at in pattern.columns[column] as usize..pattern.columns[column + 1] as usize {
                    let place = (column - first) * stride + row(pattern.rows[at]);
                    tree.places[at] = place as u32;
                }
            }
            for &child in &front.children {
                let to = boundaries[child as usize].iter().map(|&b| row(3 * b) as u32);
                let runs = runs(to, below);
                let below_child = &mut tree.fronts[child as usize];
                below_child.into_own = runs.iter().filter(|run| (run.to as usize) < below).count();
                below_child.into_parent = runs;
            }
            tree.len += stride * own;
            tree.tallest = tree.tallest.max(stride);
            tree.fronts.push(front);
        }
        if !beside.is_empty() {
            let work = |fronts: &[Front]| fronts.iter().map(Front::work).sum::<f64>();
            let parts = [work(&tree.fronts[..beside.start]), work(&tree.fronts[beside.clone()])];
            tree.fork = Some(Fork { middle: beside.start, end: beside.end, work: parts[0].min(parts[1]) });
        }
        tree
    }

    /// Place in the factor of the columns of neighbouring fronts.
    pub fn columns(&self, fronts: &Range<usize>) -> Range<usize> {
        self.span(fronts, |front| &front.values)
    }

    /// The matrix's values that belong to neighbouring fronts.
    pub fn entries(&self, fronts: &Range<usize>) -> Range<usize> {
        self.span(fronts, |front| &front.entries)
    }

    fn span(&self, fronts: &Range<usize>, of: impl Fn(&Front) -> &Range<usize>) -> Range<usize> {
        let fronts = &self.fronts[fronts.clone()];
        fronts.first().zip(fronts.last()).map_or(0..0, |(first, last)| of(first).start..of(last).end)
    }
}

/// Multiplications and additions in the smaller half from which on a second core pays. Its thread takes some tenths of a millisecond
/// to wake, as long as 1e7 to 2e7 of them; a half has 6e7 at 39 × 39.
const WORTH: f64 = 3e7;

impl Fork {
    /// Whether a second core is worth its while.
    pub fn pays(self) -> bool {
        self.work > WORTH
    }
}

impl Front {
    /// Multiplications and additions that eliminate it.
    pub fn work(&self) -> f64 {
        let [own, reach] = [self.own as f64, self.reach as f64];
        own * (own * own / 3.0 + own * reach + reach * reach)
    }
}

/// The fronts of the last child of the last front that has several: they and the fronts before have nothing to do with each other.
fn second_part(children: &[Vec<u32>]) -> Range<usize> {
    let mut node = children.len().saturating_sub(1);
    loop {
        match children.get(node).map_or(&[][..], |c| c) {
            [] => return 0..0,
            [only] => node = *only as usize,
            [.., before, last] => return *before as usize + 1..*last as usize + 1,
        }
    }
}

/// Column distances that are multiples of a page's 512 values would put a row's values into one set of the cache.
fn apart(stride: usize) -> usize {
    if stride.is_multiple_of(8 * LANES) { stride + LANES } else { stride }
}

/// Ranks of later regions that each region's columns reach in the factor, ascending.
fn boundaries(pattern: &Pattern) -> Vec<Vec<u32>> {
    let mut boundaries: Vec<Vec<u32>> = vec![Vec::new(); pattern.regions.len()];
    for (k, region) in pattern.regions.iter().enumerate() {
        let mut reached = std::mem::take(&mut boundaries[k]);
        for rank in region.ranks.clone() {
            let column = 3 * rank as usize;
            let rows = pattern.columns[column] as usize..pattern.columns[column + 1] as usize;
            reached.extend(pattern.rows[rows].iter().map(|row| row / 3));
        }
        reached.retain(|&rank| rank >= region.ranks.end);
        reached.sort_unstable();
        reached.dedup();
        if let Some(parent) = region.parent {
            boundaries[parent as usize].extend(&reached);
        }
        boundaries[k] = reached;
    }
    boundaries
}

fn row_of(front: &Front, boundary: &[u32], unknown: u32) -> usize {
    let own = unknown as usize - front.first;
    if own < front.own {
        return own;
    }
    let place = boundary.binary_search(&(unknown / 3)).expect("a parent's rows hold its children's");
    front.below + 3 * place + unknown as usize % 3
}

/// Runs of boundary rows, given where each of their triples goes; none crosses `split`.
fn runs(to: impl Iterator<Item = u32>, split: usize) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for (place, to) in to.enumerate() {
        match runs.last_mut() {
            Some(run) if run.to + run.len == to && to as usize != split => run.len += 3,
            _ => runs.push(Run { from: 3 * place as u32, to, len: 3 }),
        }
    }
    runs
}
