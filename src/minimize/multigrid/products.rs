//! Pᵀ A P of any mesh, block by block.

use super::{
    matrix::{Block, Matrix, Rows, transposed},
    transfer::Transfer,
};
use crate::{cores::Team, math::pack::dispatch};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// What blocks of the next coarser matrix are made of.
pub struct Products {
    /// Per coarse block of the upper triangle: where it and its transpose lie, and the end of its list of products.
    targets: Vec<[u32; 3]>,
    /// Finer block and weight of each product.
    products: Vec<(u32, f32)>,
    /// The coarse row where the second half begins, and its first target.
    middle: [usize; 2],
    /// Blocks of the first half whose transposes lie in the second: where both do.
    across: Vec<[u32; 2]>,
}

impl Products {
    /// From a matrix to the next coarser one.
    pub fn new(matrix: &Matrix, transfer: &Transfer, coarser: &Matrix) -> Products {
        let mut products: Vec<(u32, u32, u32, f32)> = Vec::new();
        for row in 0..matrix.len() {
            for place in matrix.row(row) {
                let column = matrix.columns[place] as usize;
                for &(a, u) in transfer.masters(row) {
                    for &(b, v) in transfer.masters(column).iter().filter(|&&(b, _)| a <= b) {
                        products.push((a, b, place as u32, u * v));
                    }
                }
            }
        }
        products.sort_by_key(|&(a, b, place, _)| (a, b, place));
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
        let products = products.iter().map(|p| (p.2, p.3)).collect();
        Products { targets, products, middle: [middle as usize, second], across }
    }

    /// Makes the next matrix, in halves of its rows.
    pub fn merge(&self, team: &Team, from: &Matrix, to: &mut Matrix) {
        let [row, second] = self.middle;
        let [low, high] = to.rows_mut(row);
        team.both(
            || dispatch(Part { of: self, from, to: low, targets: 0..second }),
            || dispatch(Part { of: self, from, to: high, targets: second..self.targets.len() }),
        );
        for &[place, mirrored] in &self.across {
            *to.block_mut(mirrored as usize) = transposed(to.block(place as usize));
        }
    }
}

/// Computes the blocks of the next matrix that lie in a range of the targets.
struct Part<'a> {
    of: &'a Products,
    from: &'a Matrix,
    to: Rows<'a>,
    targets: Range<usize>,
}

impl WithSimd for Part<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Part { of: Products { targets, products, .. }, from, mut to, targets: range } = self;
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

/// sum += block · weight, and so for what lies behind the block.
#[inline(always)]
fn plus<S: Simd>(simd: S, sum: &mut [f32; 16], block: &[f32; 16], weight: f32) {
    let weight = simd.splat_f32s(weight);
    for (sum, block) in S::as_mut_simd_f32s(sum).0.iter_mut().zip(S::as_simd_f32s(block).0) {
        *sum = simd.mul_add_e_f32s(*block, weight, *sum);
    }
}
