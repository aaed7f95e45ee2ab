//! Dense work on one front: partial Cholesky, and adding a child's update to its parent.
//!
//! Fronts of a cloth are small (some 20 to 500 columns), so nothing is packed: a tile of up to 32 rows by 6 columns stays in registers
//! while it runs over the finished columns. Six columns are two particles; separators are two particles wide.

#![expect(clippy::needless_range_loop, reason = "rows and columns of tiles read best by their numbers")]
#![expect(
    clippy::too_many_arguments,
    reason = "slices of one front, split for the borrow checker, and where in them"
)]

use super::{
    Indefinite,
    fronts::{Front, LANES},
    lanes::Lanes,
};
use std::ops::Range;

/// Columns of a tile.
pub const WIDTH: usize = 6;
/// Finished columns that a tile runs over at once, a multiple of `WIDTH`: their rows stay in the second-level cache. 48 and 192 are
/// a few percent slower.
const DEPTH: usize = 96;

type Tile<V, const R: usize, const W: usize> = [[V; R]; W];

/// The numbers from `at` on.
#[inline(always)]
pub fn lanes(values: &[f64], at: usize) -> &[f64; LANES] {
    values[at..at + LANES].as_array().expect("a slice of that length")
}

/// The numbers from `at` on.
#[inline(always)]
pub fn lanes_mut(values: &mut [f64], at: usize) -> &mut [f64; LANES] {
    values[at..at + LANES].as_mut_array().expect("a slice of that length")
}

/// Subtracts from a tile the product of its rows and its columns' rows over all columns in `finished`.
#[inline(always)]
fn subtract<V: Lanes, const R: usize, const W: usize>(
    tile: &mut Tile<V, R, W>,
    finished: &[f64],
    stride: usize,
    row: usize,
    column_row: usize,
) {
    for column in finished.chunks_exact(stride) {
        let (rows, _) = column[row..row + LANES * R].as_chunks::<LANES>();
        let across = &column[column_row..column_row + W];
        // Loops rather than closures throughout: a closure that is not inlined loses the processor's features.
        let mut a = [V::splat(0.0); R];
        for r in 0..R {
            a[r] = V::load(&rows[r]);
        }
        for c in 0..W {
            let b = V::splat(across[c]);
            for r in 0..R {
                tile[c][r] = tile[c][r].minus(a[r], b);
            }
        }
    }
}

#[inline(always)]
fn load<V: Lanes, const R: usize, const W: usize>(panel: &[f64], stride: usize, row: usize) -> Tile<V, R, W> {
    let mut tile = [[V::splat(0.0); R]; W];
    for c in 0..W {
        for r in 0..R {
            tile[c][r] = V::load(lanes(panel, c * stride + row + LANES * r));
        }
    }
    tile
}

#[inline(always)]
fn store<V: Lanes, const R: usize, const W: usize>(
    tile: &Tile<V, R, W>,
    panel: &mut [f64],
    stride: usize,
    row: usize,
) {
    for c in 0..W {
        for r in 0..R {
            tile[c][r].store(lanes_mut(panel, c * stride + row + LANES * r));
        }
    }
}

/// Calls `$body` with a constant tile height until `$rows` are done.
macro_rules! for_tiles {
    ($v:ty, $rows:expr, |$row:ident, $r:ident| $body:block) => {{
        let Range { start, end } = $rows;
        let mut $row = start;
        while $row < end {
            let left = ((end - $row) / LANES).min(<$v>::HEIGHT);
            match left {
                1 => {
                    const $r: usize = 1;
                    $body
                }
                2 => {
                    const $r: usize = 2;
                    $body
                }
                3 => {
                    const $r: usize = 3;
                    $body
                }
                _ => {
                    const $r: usize = 4;
                    $body
                }
            }
            $row += LANES * left;
        }
    }};
}

/// Subtracts from a panel's rows what the columns in `finished` contribute. `at` is the panel's first row (its rows from there
/// on change), `offset` what to add to a panel's row to get the finished columns' row. `fresh` panels start from zero.
#[inline(always)]
fn update<V: Lanes, const W: usize>(
    panel: &mut [f64],
    panel_stride: usize,
    finished: &[f64],
    stride: usize,
    at: usize,
    offset: usize,
    rows: Range<usize>,
    fresh: bool,
) {
    for_tiles!(V, rows, |row, R| {
        let mut tile: Tile<V, R, W> =
            if fresh { [[V::splat(0.0); R]; W] } else { load(panel, panel_stride, row) };
        subtract(&mut tile, finished, stride, row + offset, at + offset);
        store(&tile, panel, panel_stride, row);
    });
}

/// Cholesky of the W × W block at row `at`; its diagonal becomes reciprocals. Columns of the lower triangle.
#[inline(always)]
fn pivot<const W: usize>(panel: &[f64], stride: usize, at: usize) -> Result<[[f64; W]; W], Indefinite> {
    let mut block = [[0.0; W]; W];
    for c in 0..W {
        for r in c..W {
            block[c][r] = panel[c * stride + at + r];
        }
    }
    for c in 0..W {
        // Also refuses what is not a number.
        if !(block[c][c] > 0.0 && block[c][c] < f64::INFINITY) {
            return Err(Indefinite);
        }
        let inverse = 1.0 / block[c][c].sqrt();
        block[c][c] = inverse;
        for r in c + 1..W {
            block[c][r] *= inverse;
        }
        for d in c + 1..W {
            for r in d..W {
                block[d][r] -= block[c][d] * block[c][r];
            }
        }
    }
    Ok(block)
}

/// Finishes a panel of W columns whose diagonal block is at row `at`.
#[inline(always)]
fn finish<V: Lanes, const W: usize>(
    panel: &mut [f64],
    finished: &[f64],
    stride: usize,
    at: usize,
) -> Result<(), Indefinite> {
    let start = at / LANES * LANES;
    let middle = (at + W).next_multiple_of(LANES);
    update::<V, W>(panel, stride, finished, stride, at, 0, start..middle, false);
    let block = pivot::<W>(panel, stride, at)?;
    let updated = if finished.is_empty() { stride } else { middle };
    for_tiles!(V, start..updated, |row, R| {
        let mut tile: Tile<V, R, W> = load(panel, stride, row);
        under(&mut tile, &block);
        store(&tile, panel, stride, row);
    });
    for_tiles!(V, updated..stride, |row, R| {
        let mut tile: Tile<V, R, W> = load(panel, stride, row);
        subtract(&mut tile, finished, stride, row, at);
        under(&mut tile, &block);
        store(&tile, panel, stride, row);
    });
    for c in 0..W {
        panel[c * stride + start..c * stride + at + c].fill(0.0);
        panel[c * stride + at + c] = block[c][c];
    }
    Ok(())
}

/// Divides a tile's rows by the transposed diagonal block.
#[inline(always)]
fn under<V: Lanes, const R: usize, const W: usize>(tile: &mut Tile<V, R, W>, block: &[[f64; W]; W]) {
    for c in 0..W {
        let inverse = V::splat(block[c][c]);
        for r in 0..R {
            tile[c][r] = tile[c][r].times(inverse);
        }
        for d in c + 1..W {
            let b = V::splat(block[c][d]);
            for r in 0..R {
                tile[d][r] = tile[d][r].minus(tile[c][r], b);
            }
        }
    }
}

/// Partial Cholesky of an assembled front: its own columns in place, and minus their product with themselves in `update_matrix`.
#[inline(always)]
pub fn eliminate<V: Lanes>(
    front: &Front,
    columns: &mut [f64],
    update_matrix: &mut [f64],
) -> Result<(), Indefinite> {
    let stride = front.stride;
    if front.own == 0 {
        // A separator of parts that do not touch: it only passes its children's updates on.
        update_matrix.fill(0.0);
    }
    let mut first = 0;
    while first < front.own {
        let end = (first + DEPTH).min(front.own);
        let mut at = first;
        while at < end {
            let (finished, panel) = columns.split_at_mut(at * stride);
            let finished = &finished[first * stride..];
            if at + WIDTH <= end {
                finish::<V, WIDTH>(panel, finished, stride, at)?;
                at += WIDTH;
            } else {
                finish::<V, 3>(panel, finished, stride, at)?;
                at += 3;
            }
        }
        let (finished, later) = columns.split_at_mut(end * stride);
        let finished = &finished[first * stride..];
        trail::<V>(later, stride, finished, stride, end..front.own, 0, stride, false);
        let (below, rows) = (front.below, front.reach.next_multiple_of(LANES));
        let target = front.update_stride;
        trail::<V>(update_matrix, target, finished, stride, 0..front.reach, below, rows, first == 0);
        first = end;
    }
    Ok(())
}

/// Updates the lower triangle of the columns `range`, panel by panel.
#[inline(always)]
fn trail<V: Lanes>(
    later: &mut [f64],
    later_stride: usize,
    finished: &[f64],
    stride: usize,
    range: Range<usize>,
    offset: usize,
    end: usize,
    fresh: bool,
) {
    let mut at = range.start;
    while at < range.end {
        let panel = &mut later[(at - range.start) * later_stride..];
        let rows = at / LANES * LANES..end;
        if at + WIDTH <= range.end {
            update::<V, WIDTH>(panel, later_stride, finished, stride, at, offset, rows, fresh);
            at += WIDTH;
        } else {
            update::<V, 3>(panel, later_stride, finished, stride, at, offset, rows, fresh);
            at += 3;
        }
    }
}

/// Adds a child's update in the columns of `runs`; rows and columns in `columns` are numbered `offset` below the parent's rows.
#[inline(always)]
pub fn extend<V: Lanes>(
    child: &Front,
    update: &[f64],
    runs: Range<usize>,
    columns: &mut [f64],
    stride: usize,
    offset: usize,
) {
    let all = &child.into_parent;
    for k in runs {
        let run = all[k];
        for o in 0..run.len as usize {
            let (from, to) = (run.from as usize + o, run.to as usize - offset + o);
            let source = &update[from * child.update_stride..][..child.update_stride];
            let target = &mut columns[to * stride..][..stride];
            let rest = run.len as usize - o;
            V::add(&mut target[to..to + rest], &source[from..from + rest]);
            for later in &all[k + 1..] {
                let (from, to, len) = (later.from as usize, later.to as usize - offset, later.len as usize);
                V::add(&mut target[to..to + len], &source[from..from + len]);
            }
        }
    }
}
