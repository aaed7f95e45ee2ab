//! The hierarchy's matrices from a system, all at once or in turns.

use super::{
    Finest, Level, Top,
    dense::Dense,
    matrix::{Matrix, transposed},
};
use crate::potential::{pattern::Pattern, system::System};
use pulp::{Simd, WithSimd};

/// How much of the coarser levels is built anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// All.
    All,
    /// One of `TURNS` that together make all, of about the same length.
    Turn(u32),
}

/// Turns in which coarser levels are built: the finest blocks are copied; half of the next matrix; the other half; all beyond.
pub const TURNS: u32 = 4;

impl Part {
    /// Whether it holds this turn.
    pub fn has(self, turn: u32) -> bool {
        self == Part::All || self == Part::Turn(turn)
    }
}

/// Builds the finest level, and as much of the coarser ones as asked for.
pub struct Build<'a> {
    pub top: &'a mut Top,
    pub levels: &'a mut [Level],
    pub coarsest: &'a mut Dense,
    pub entries: &'a [[u32; 3]],
    pub system: &'a System,
    pub part: Part,
}

impl WithSimd for Build<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Build { top, levels, coarsest, entries, system, part } = self;
        match top {
            Top::Planes(stencil, finest) => {
                let Finest { matrix, transfer, .. } = &mut **finest;
                stencil.set(simd, system);
                if part.has(0) {
                    fill(matrix, entries, system);
                }
                let to = levels.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
                transfer.coarser(simd, matrix, to, part);
            }
            Top::Blocks => match levels.split_first_mut() {
                Some((finest, coarse)) => {
                    fill(&mut finest.matrix, entries, system);
                    finest.invert();
                    let to = coarse.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
                    finest.transfer.coarser(simd, &finest.matrix, to, part);
                }
                None => {
                    fill(&mut coarsest.matrix, entries, system);
                    return coarsest.factorize();
                }
            },
        }
        let first = usize::from(matches!(top, Top::Blocks));
        // What a sweep leaves is right only where inverses are those of the blocks, new or not.
        levels[first..].iter_mut().take(1).for_each(Level::invert);
        if !part.has(TURNS - 1) {
            return;
        }
        for l in first..levels.len() {
            let (fine, coarse) = levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            if l > first {
                fine.invert();
            }
            let to = coarse.first_mut().map_or(&mut coarsest.matrix, |level| &mut level.matrix);
            fine.transfer.coarser(simd, &fine.matrix, to, Part::All);
        }
        coarsest.factorize();
    }
}

/// Places of each pair's block in the planes and, straight and transposed, in the finest matrix: the diagonals, then the pairs.
pub fn entries(pattern: &Pattern, matrix: &Matrix) -> Vec<[u32; 3]> {
    let mut entries: Vec<[u32; 3]> = matrix
        .starts
        .iter()
        .zip(0..pattern.order.len())
        .map(|(&start, n)| [n as u32, start, start])
        .collect();
    for run in &pattern.runs {
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

/// Blocks from planes. Fixed particles have no part in the matrix.
#[inline(always)]
fn fill(matrix: &mut Matrix, entries: &[[u32; 3]], system: &System) {
    let (order, stride) = (&system.pattern.order, system.pattern.stride);
    let plane = |k: usize| &system.blocks[k * stride..][..stride];
    let [p0, p1, p2, p3, p4, p5, p6, p7, p8] =
        [plane(0), plane(1), plane(2), plane(3), plane(4), plane(5), plane(6), plane(7), plane(8)];
    let (own, pairs) = entries.split_at(order.len());
    for (&[at, place, _], &particle) in own.iter().zip(order) {
        let k = at as usize;
        // Of the diagonals only what lies on and below theirs counts.
        let [a, b, c, d, e, f] = [p0[k], p3[k], p6[k], p4[k], p7[k], p8[k]].map(|value| value as f32);
        *matrix.block_mut(place as usize) =
            if system.fixed[particle as usize] { [0.0; 9] } else { [a, b, c, b, d, e, c, e, f] };
    }
    for &[at, straight, turned] in pairs {
        let k = at as usize;
        let b = [p0[k], p1[k], p2[k], p3[k], p4[k], p5[k], p6[k], p7[k], p8[k]].map(|value| value as f32);
        // Blocks go column by column.
        *matrix.block_mut(straight as usize) = transposed(&b);
        *matrix.block_mut(turned as usize) = b;
    }
}
