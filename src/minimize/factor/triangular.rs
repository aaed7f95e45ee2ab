//! Triangular solves with one front, for N right-hand sides at once: each value of the factor is read once in each direction.

#![expect(clippy::needless_range_loop, reason = "rows and columns of panels read best by their numbers")]

use super::{
    dense::{WIDTH, lanes, lanes_mut},
    fronts::{Front, LANES},
    lanes::Lanes,
};

/// Solves with a front's own columns; `rows` takes N columns of the front's rows, of which those of the boundary become what to
/// add to the right-hand sides there.
#[inline(always)]
pub fn forward<V: Lanes, const N: usize>(
    front: &Front,
    columns: &[f64],
    rows: &mut [f64],
    rhs: &mut [f64],
    size: usize,
) {
    let stride = front.stride;
    for k in 0..N {
        let rows = &mut rows[k * stride..(k + 1) * stride];
        let own = k * size + front.first;
        rows[..front.own].copy_from_slice(&rhs[own..own + front.own]);
        rows[front.own..].fill(0.0);
    }
    let mut at = 0;
    while at < front.own {
        let panel = &columns[at * stride..];
        if at + WIDTH <= front.own {
            forward_panel::<V, N, WIDTH>(front, panel, at, rows, rhs, size);
            at += WIDTH;
        } else {
            forward_panel::<V, N, 3>(front, panel, at, rows, rhs, size);
            at += 3;
        }
    }
    for run in &front.unknowns {
        let (from, to, len) = (front.below + run.from as usize, run.to as usize, run.len as usize);
        for k in 0..N {
            V::add(&mut rhs[k * size + to..][..len], &rows[k * stride + from..][..len]);
        }
    }
}

#[inline(always)]
fn forward_panel<V: Lanes, const N: usize, const W: usize>(
    front: &Front,
    panel: &[f64],
    at: usize,
    rows: &mut [f64],
    rhs: &mut [f64],
    size: usize,
) {
    let stride = front.stride;
    let mut x = [[0.0; W]; N];
    for k in 0..N {
        x[k].copy_from_slice(&rows[k * stride + at..][..W]);
    }
    for c in 0..W {
        let column = &panel[c * stride + at..][..W];
        for x in &mut x {
            x[c] *= column[c];
            for r in c + 1..W {
                x[r] -= column[r] * x[c];
            }
        }
    }
    for k in 0..N {
        rhs[k * size + front.first + at..][..W].copy_from_slice(&x[k]);
    }
    let mut wide = [[V::splat(0.0); W]; N];
    for k in 0..N {
        for c in 0..W {
            wide[k][c] = V::splat(x[k][c]);
        }
    }
    // The rows of this panel and the zeros above are touched too; they have been read.
    let mut row = (at + W) / LANES * LANES;
    while row < stride {
        let mut sums = [V::splat(0.0); N];
        for k in 0..N {
            sums[k] = V::load(lanes(rows, k * stride + row));
        }
        for c in 0..W {
            let column = V::load(lanes(panel, c * stride + row));
            for k in 0..N {
                sums[k] = sums[k].minus(column, wide[k][c]);
            }
        }
        for k in 0..N {
            sums[k].store(lanes_mut(rows, k * stride + row));
        }
        row += LANES;
    }
}

/// Solves with the transpose of a front's own columns, from the boundary's solution.
#[inline(always)]
pub fn backward<V: Lanes, const N: usize>(
    front: &Front,
    columns: &[f64],
    rows: &mut [f64],
    rhs: &mut [f64],
    size: usize,
) {
    let stride = front.stride;
    for k in 0..N {
        rows[k * stride..(k + 1) * stride].fill(0.0);
    }
    for run in &front.unknowns {
        let (from, to, len) = (front.below + run.from as usize, run.to as usize, run.len as usize);
        for k in 0..N {
            rows[k * stride + from..][..len].copy_from_slice(&rhs[k * size + to..][..len]);
        }
    }
    let mut at = front.own;
    while at > 0 {
        if at.is_multiple_of(WIDTH) {
            at -= WIDTH;
            backward_panel::<V, N, WIDTH>(front, &columns[at * stride..], at, rows, rhs, size);
        } else {
            at -= 3;
            backward_panel::<V, N, 3>(front, &columns[at * stride..], at, rows, rhs, size);
        }
    }
}

#[inline(always)]
fn backward_panel<V: Lanes, const N: usize, const W: usize>(
    front: &Front,
    panel: &[f64],
    at: usize,
    rows: &mut [f64],
    rhs: &mut [f64],
    size: usize,
) {
    let stride = front.stride;
    let mut sums = [[V::splat(0.0); N]; W];
    // Rows of this panel are still zero.
    let mut row = (at + W) / LANES * LANES;
    while row < stride {
        let mut x = [V::splat(0.0); N];
        for k in 0..N {
            x[k] = V::load(lanes(rows, k * stride + row));
        }
        for c in 0..W {
            let column = V::load(lanes(panel, c * stride + row));
            for k in 0..N {
                sums[c][k] = sums[c][k].minus(column, x[k]);
            }
        }
        row += LANES;
    }
    let mut x = [[0.0; W]; N];
    for k in 0..N {
        x[k].copy_from_slice(&rhs[k * size + front.first + at..][..W]);
        for c in 0..W {
            x[k][c] += sums[c][k].sum();
        }
    }
    for c in (0..W).rev() {
        let column = &panel[c * stride + at..][..W];
        for x in &mut x {
            for r in c + 1..W {
                x[c] -= column[r] * x[r];
            }
            x[c] *= column[c];
        }
    }
    for k in 0..N {
        rhs[k * size + front.first + at..][..W].copy_from_slice(&x[k]);
        rows[k * stride + at..][..W].copy_from_slice(&x[k]);
    }
}
