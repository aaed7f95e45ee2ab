//! From a level to the next coarser one and back, and the coarser matrix Pᵀ A P.

use super::{
    coarsen::Masters,
    matrix::{Block, Matrix, Node, Rows, fused, transposed},
};
use crate::{cores::Team, math::pack::dispatch};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// How a level hangs together with the next coarser one.
pub struct Transfer {
    /// Masters of each row, and the rows that follow each master.
    masters: Lists,
    followers: Lists,
    /// Per coarse block of the upper triangle: where it and its transpose lie, and the end of its list of products.
    targets: Vec<[u32; 3]>,
    /// Finer block and weight of each product.
    products: Vec<(u32, f32)>,
    /// The coarse row where the second half begins, and its first target.
    middle: [usize; 2],
    /// Blocks of the first half whose transposes lie in the second: where both do.
    across: Vec<[u32; 2]>,
}

impl Transfer {
    /// From a matrix and masters of its rows; and the next coarser matrix, empty.
    pub fn new(matrix: &Matrix, masters: Vec<Masters>) -> (Transfer, Matrix) {
        let coarse = masters.iter().flatten().map(|m| m.0 as usize + 1).max().unwrap_or(0);
        let mut columns: Vec<Vec<u32>> = (0..coarse as u32).map(|c| vec![c]).collect();
        let mut products: Vec<(u32, u32, u32, f32)> = Vec::new();
        for row in 0..matrix.len() {
            for place in matrix.row(row) {
                let column = matrix.columns[place] as usize;
                for &(a, u) in &masters[row] {
                    for &(b, v) in &masters[column] {
                        if a <= b {
                            products.push((a, b, place as u32, u * v));
                        }
                        if !columns[a as usize].contains(&b) {
                            columns[a as usize].push(b);
                        }
                    }
                }
            }
        }
        products.sort_by_key(|&(a, b, place, _)| (a, b, place));
        let coarser = Matrix::new(columns);
        let mut targets: Vec<[u32; 3]> = Vec::new();
        let mut last = None;
        for (end, &(a, b, ..)) in products.iter().enumerate() {
            if last != Some((a, b)) {
                let place = |a, b| coarser.place(a, b).expect("a block of the pattern");
                targets.push([place(a, b), place(b, a), 0]);
                last = Some((a, b));
            }
            targets.last_mut().expect("just pushed")[2] = end as u32 + 1;
        }
        // Halves of the products, up to a row.
        let middle = products.get(products.len() / 2).map_or(0, |product| product.0);
        let first = products.partition_point(|product| product.0 < middle) as u32;
        let second = targets.partition_point(|target| target[2] <= first);
        let beyond = coarser.starts[middle as usize];
        let across = targets[..second].iter().filter(|target| target[1] >= beyond);
        let across = across.map(|target| [target[0], target[1]]).collect();
        let mut followers = vec![Vec::new(); coarse];
        for (masters, row) in masters.iter().zip(0..) {
            masters.iter().for_each(|&(master, weight)| followers[master as usize].push((row, weight)));
        }
        let transfer = Transfer {
            masters: Lists::new(&masters),
            followers: Lists::new(&followers),
            targets,
            products: products.iter().map(|p| (p.2, p.3)).collect(),
            middle: [middle as usize, second],
            across,
        };
        (transfer, coarser)
    }

    /// Computes the next matrix, half of its rows by half.
    pub fn coarser(&self, team: &Team, from: &Matrix, to: &mut Matrix) {
        let [low, high] = to.rows_mut(self.middle[0]);
        team.both(|| self.first_half(from, low), || self.second_half(from, high));
        self.finish(to);
    }

    /// Computes one of the halves.
    pub fn coarser_half(&self, half: usize, from: &Matrix, to: &mut Matrix) {
        let [low, high] = to.rows_mut(self.middle[0]);
        if half == 0 {
            self.first_half(from, low);
        } else {
            self.second_half(from, high);
            self.finish(to);
        }
    }

    fn first_half(&self, from: &Matrix, to: Rows) {
        dispatch(Products { transfer: self, from, to, targets: 0..self.middle[1] });
    }

    fn second_half(&self, from: &Matrix, to: Rows) {
        dispatch(Products { transfer: self, from, to, targets: self.middle[1]..self.targets.len() });
    }

    /// What is known of the second half when the first is.
    fn finish(&self, to: &mut Matrix) {
        for &[place, mirrored] in &self.across {
            *to.block_mut(mirrored as usize) = transposed(to.block(place as usize));
        }
    }

    /// What rows weigh on masters, of which this is the first.
    #[inline(always)]
    pub fn restrict<S: Simd>(&self, from: &[Node], to: &mut [Node], first: usize) {
        for (n, to) in to.iter_mut().enumerate() {
            *to = self.followers.sum::<S>(
                first + n,
                #[inline(always)]
                |row| from[row],
            );
        }
    }

    /// What a row follows of its masters.
    #[inline(always)]
    pub fn followed<S: Simd>(&self, row: usize, from: impl Fn(usize) -> Node) -> Node {
        self.masters.sum::<S>(row, from)
    }
}

/// Computes the blocks of the next matrix that lie in a range of the targets.
struct Products<'a> {
    transfer: &'a Transfer,
    from: &'a Matrix,
    to: Rows<'a>,
    targets: Range<usize>,
}

impl WithSimd for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Products { transfer: Transfer { targets, products, .. }, from, mut to, targets: range } = self;
        let mut start = range.start.checked_sub(1).map_or(0, |last| targets[last][2] as usize);
        for &[place, mirrored, end] in &targets[range] {
            // Two sums, so that additions need not wait for each other.
            let (mut sum, mut other) = ([0.0; 16], [0.0; 16]);
            let (pairs, rest) = products[start..end as usize].as_chunks::<2>();
            for &[(a, u), (b, v)] in pairs {
                plus(simd, &mut sum, from.window(a as usize), u);
                plus(simd, &mut other, from.window(b as usize), v);
            }
            for &(block, weight) in rest {
                plus(simd, &mut sum, from.window(block as usize), weight);
            }
            plus(simd, &mut sum, &other, 1.0);
            start = end as usize;
            let block: Block = std::array::from_fn(|k| sum[k]);
            *to.block_mut(place).expect("a block of these rows") = block;
            if mirrored != place
                && let Some(to) = to.block_mut(mirrored)
            {
                *to = transposed(&block);
            }
        }
    }
}

/// A list of numbers with weights for each of many.
struct Lists {
    starts: Vec<u32>,
    entries: Vec<(u32, f32)>,
}

impl Lists {
    fn new(lists: &[Vec<(u32, f32)>]) -> Lists {
        let ends = lists.iter().scan(0, |end, list| {
            *end += list.len() as u32;
            Some(*end)
        });
        Lists { starts: std::iter::once(0).chain(ends).collect(), entries: lists.concat() }
    }

    /// Weighted sum over a list.
    #[inline(always)]
    fn sum<S: Simd>(&self, list: usize, of: impl Fn(usize) -> Node) -> Node {
        let mut sum = [0.0; 4];
        for &(n, weight) in &self.entries[self.starts[list] as usize..self.starts[list + 1] as usize] {
            let node = of(n as usize);
            for k in 0..4 {
                sum[k] = fused::<S>(node[k], weight, sum[k]);
            }
        }
        sum
    }
}

/// sum += block · weight, and so for what lies behind the block.
#[inline(always)]
fn plus<S: Simd>(simd: S, sum: &mut [f32; 16], block: &[f32; 16], weight: f32) {
    let weight = simd.splat_f32s(weight);
    for (sum, block) in S::as_mut_simd_f32s(sum).0.iter_mut().zip(S::as_simd_f32s(block).0) {
        *sum = simd.mul_add_e_f32s(*block, weight, *sum);
    }
}
