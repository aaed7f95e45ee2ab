//! A level in planes, smoothed by block Jacobi.

use super::{
    halves::{parts, parts_mut},
    matrix::Node,
    numbers::{Numbers, Three, load, load3, store},
    product::{Finish, Half, Sums},
    transfer::Transfer,
    yarns::{Own, Yarns},
};
use crate::{
    cores::Team,
    math::pack::dispatch,
    potential::{
        pattern::{Lines, PADDING},
        system::System,
    },
};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// Matrix, smoother and vectors of a level.
pub struct Stencil {
    /// The matrix.
    pub numbers: Numbers,
    /// What else smooths, if anything may.
    pub yarns: Option<Yarns>,
    /// What it solves for, before it is smoothed for the last time.
    x: Vec<f32>,
    b: Vec<f32>,
    halves: [Half; 2],
    /// By nodes: what the first smoothing left, then the solution.
    pub nodes: Vec<Node>,
    /// The right-hand side of a level that is not the finest.
    pub rhs: Vec<Node>,
}

impl Stencil {
    /// With room for vectors, whose rows come in halves or not.
    pub fn new(numbers: Numbers, is_parted: bool, yarns: Option<Yarns>) -> Stencil {
        let halves = Half::both(&numbers.lines, is_parted);
        let Lines { particles, plane, .. } = *numbers.lines;
        let (zeros, nodes) = (vec![0.0; 3 * plane], vec![[0.0; 4]; particles]);
        Stencil { numbers, yarns, x: zeros.clone(), b: zeros, halves, rhs: nodes.clone(), nodes }
    }

    /// Takes over a system's matrix; yarns smooth where it is a hard one.
    pub fn set(&mut self, system: &System, is_hard: bool, team: &Team) {
        self.numbers.set(system, team);
        if let Some(yarns) = &mut self.yarns {
            yarns.are_used = is_hard;
            if is_hard {
                yarns.set(&self.numbers, team);
            }
        }
    }

    /// First row of the second half.
    pub fn middle(&self) -> usize {
        self.halves[1].rows.start
    }

    /// out = A x
    pub fn multiply(&mut self, team: &Team, x: &[f32], out: &mut [f32]) {
        let middle = self.middle();
        let Stencil { numbers, halves, .. } = self;
        let [low, high] = parts_mut(out, middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Image { out, from });
        numbers.multiply(team, None, x, halves, &mut finish);
    }

    /// Starts from zero towards the right-hand side and leaves what is left.
    pub fn smooth_first(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, rhs, .. } = self;
        let (numbers, n) = (&*numbers, numbers.lines.particles);
        let ([x, x_high], [b, b_high]) = (parts_mut(x, middle), parts_mut(b, middle));
        let (low, high) = rhs.split_at(middle);
        team.both(
            || dispatch(Begin { numbers, own: None, rhs: ByNodes(low), b, x, rows: 0..middle }),
            || {
                dispatch(Begin {
                    numbers,
                    own: None,
                    rhs: ByNodes(high),
                    b: b_high,
                    x: x_high,
                    rows: middle..n,
                })
            },
        );
        self.leave(team);
    }

    /// The same towards a right-hand side in planes.
    pub fn smooth_towards(&mut self, team: &Team, rhs: &[f64]) {
        let middle = self.middle();
        let Stencil { numbers, yarns, x, b, .. } = self;
        let (numbers, n) = (&*numbers, numbers.lines.particles);
        let ([low, high], [b, b_high]) = (parts_mut(x, middle), parts_mut(b, middle));
        let [rhs, rhs_high] = parts(rhs, middle).map(ByPlanes);
        let [own, own_high] = halves(yarns, middle);
        team.both(
            || dispatch(Begin { numbers, own, rhs, b, x: low, rows: 0..middle }),
            || dispatch(Begin { numbers, own: own_high, rhs: rhs_high, b: b_high, x: high, rows: middle..n }),
        );
        if let Some(yarns) = used(yarns) {
            yarns.correct(team, 1.0, x, middle);
        }
        self.leave(team);
    }

    fn leave(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, halves, nodes, .. } = self;
        let (low, high) = nodes.split_at_mut(middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Left { out, from });
        numbers.multiply(team, Some(b), x, halves, &mut finish);
    }

    /// Adds what a coarser level solved.
    pub fn follow(&mut self, team: &Team, transfer: &Transfer, coarser: impl Fn(usize) -> Node + Sync) {
        let middle = self.middle();
        let Stencil { numbers, x, .. } = self;
        let [low, high] = parts_mut(x, middle);
        let (numbers, coarser, n) = (&*numbers, &coarser, numbers.lines.particles);
        team.both(
            || dispatch(Follow { numbers, transfer, coarser, x: low, rows: 0..middle }),
            || dispatch(Follow { numbers, transfer, coarser, x: high, rows: middle..n }),
        );
    }

    /// Smooths once more, into a solution in planes.
    pub fn smooth_into(&mut self, team: &Team, z: &mut [f32]) {
        let middle = self.middle();
        let Stencil { numbers, yarns, x, b, halves: of, .. } = self;
        let (numbers, x) = (&*numbers, &x[..]);
        let ([low, high], [own, own_high]) = (parts_mut(z, middle), halves(yarns, middle));
        let finish = [(low, own, 0), (high, own_high, middle)];
        let mut finish = finish.map(|(out, own, from)| Smoothed { numbers, own, x, out, from });
        numbers.multiply(team, Some(b), x, of, &mut finish);
        if let Some(yarns) = used(yarns) {
            yarns.correct(team, -1.0, z, middle);
        }
    }

    /// Smooths once more, into a solution by nodes, as finer levels follow it.
    pub fn smooth_last(&mut self, team: &Team) {
        let middle = self.middle();
        let Stencil { numbers, x, b, halves, nodes, .. } = self;
        let (numbers, x) = (&*numbers, &x[..]);
        let (low, high) = nodes.split_at_mut(middle);
        let mut finish = [(low, 0), (high, middle)].map(|(out, from)| Solved { numbers, x, out, from });
        numbers.multiply(team, Some(b), x, halves, &mut finish);
    }
}

/// Yarns, where they smooth.
fn used(yarns: &mut Option<Yarns>) -> Option<&mut Yarns> {
    yarns.as_mut().filter(|yarns| yarns.are_used)
}

/// What they are to know of two halves of the rows.
fn halves(yarns: &mut Option<Yarns>, middle: usize) -> [Option<Own<'_>>; 2] {
    used(yarns).map_or([None, None], |yarns| yarns.halves(middle).map(Some))
}

#[inline(always)]
fn store_each<S: Simd>(simd: S, lists: &mut [&mut [f32]; 3], at: usize, value: Three<S>) {
    (0..3).for_each(|k| store(simd, lists[k], at, value[k]));
}

/// Some rows of a right-hand side, by nodes or in planes.
trait Rows {
    /// Lays them in planes.
    fn lay(&self, b: &mut [&mut [f32]; 3]);
}

struct ByNodes<'a>(&'a [Node]);

impl Rows for ByNodes<'_> {
    #[inline(always)]
    fn lay(&self, [b0, b1, b2]: &mut [&mut [f32]; 3]) {
        for (node, (b0, (b1, b2))) in self.0.iter().zip(b0.iter_mut().zip(b1.iter_mut().zip(b2.iter_mut()))) {
            [*b0, *b1, *b2, _] = *node;
        }
    }
}

struct ByPlanes<'a>([&'a [f64]; 3]);

impl Rows for ByPlanes<'_> {
    #[inline(always)]
    fn lay(&self, b: &mut [&mut [f32]; 3]) {
        for (to, from) in b.iter_mut().zip(self.0) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to = *from as f32);
        }
    }
}

/// Starts smoothing in some rows: takes over the right-hand side, x = S b.
struct Begin<'a, R> {
    numbers: &'a Numbers,
    own: Option<Own<'a>>,
    rhs: R,
    b: [&'a mut [f32]; 3],
    x: [&'a mut [f32]; 3],
    rows: Range<usize>,
}

impl<R: Rows> WithSimd for Begin<'_, R> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Begin { numbers, mut own, rhs, mut b, mut x, rows } = self;
        rhs.lay(&mut b);
        for k in (0..rows.len()).step_by(S::F32_LANES) {
            let value = [load(simd, b[0], k), load(simd, b[1], k), load(simd, b[2], k)];
            store_each(simd, &mut x, k, numbers.smoothed(simd, value, rows.start + k));
            if let Some(own) = &mut own {
                own.take(simd, k, value);
            }
        }
    }
}

/// Adds what a coarser level solved to some rows.
struct Follow<'a, F> {
    numbers: &'a Numbers,
    transfer: &'a Transfer,
    coarser: &'a F,
    x: [&'a mut [f32]; 3],
    rows: Range<usize>,
}

impl<F: Fn(usize) -> Node> WithSimd for Follow<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Follow { numbers, transfer, coarser, mut x, rows } = self;
        let shares = &numbers.shares[rows.clone()];
        if let Some(halved) = &transfer.halved {
            return halved.follow(rows, coarser, shares, &mut x);
        }
        for (k, (row, share)) in rows.zip(shares).enumerate() {
            let node = transfer.followed::<S>(row, coarser);
            (0..3).for_each(|n| x[n][k] += share * node[n]);
        }
    }
}

/// Keeps a product, in planes.
struct Image<'a> {
    out: [&'a mut [f32]; 3],
    from: usize,
}

impl Finish for Image<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, sums: &Sums) {
        for row in rows.step_by(S::F32_LANES) {
            store_each(simd, &mut self.out, row - self.from, sums.load(simd, row));
        }
    }
}

/// Keeps what is left, by nodes.
struct Left<'a> {
    out: &'a mut [Node],
    from: usize,
}

impl Finish for Left<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, _: S, rows: Range<usize>, sums: &Sums) {
        let [a, b, c] = [0, 1, 2].map(|k| sums.rows(k, rows.clone()));
        let out = &mut self.out[rows.start - self.from..][..rows.len()];
        for (k, out) in out.iter_mut().enumerate() {
            *out = [-a[k], -b[k], -c[k], 0.0];
        }
    }
}

/// Smooths x by what is left of it, in planes.
struct Smoothed<'a> {
    numbers: &'a Numbers,
    own: Option<Own<'a>>,
    x: &'a [f32],
    out: [&'a mut [f32]; 3],
    from: usize,
}

impl Finish for Smoothed<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, sums: &Sums) {
        for row in rows.step_by(S::F32_LANES) {
            let excess = sums.load(simd, row);
            store_each(
                simd,
                &mut self.out,
                row - self.from,
                improved(simd, self.numbers, self.x, excess, row),
            );
            if let Some(own) = &mut self.own {
                own.take(simd, row - self.from, excess);
            }
        }
    }
}

/// The same by nodes.
struct Solved<'a> {
    numbers: &'a Numbers,
    x: &'a [f32],
    out: &'a mut [Node],
    from: usize,
}

impl Finish for Solved<'_> {
    #[inline(always)]
    fn finish<S: Simd>(&mut self, simd: S, rows: Range<usize>, sums: &Sums) {
        let out = &mut self.out[rows.start - self.from..][..rows.len()];
        for (row, out) in rows.step_by(S::F32_LANES).zip(out.chunks_mut(S::F32_LANES)) {
            let mut lanes = [[0.0; PADDING]; 3];
            let x = improved(simd, self.numbers, self.x, sums.load(simd, row), row);
            lanes.iter_mut().zip(x).for_each(|(lanes, x)| store(simd, lanes, 0, x));
            for (lane, out) in out.iter_mut().enumerate() {
                *out = [lanes[0][lane], lanes[1][lane], lanes[2][lane], 0.0];
            }
        }
    }
}

/// x − S (A x − b)
#[inline(always)]
fn improved<S: Simd>(simd: S, numbers: &Numbers, x: &[f32], excess: Three<S>, row: usize) -> Three<S> {
    let change = numbers.smoothed(simd, excess, row);
    let x = load3(simd, x, numbers.lines.plane, row);
    [simd.sub_f32s(x[0], change[0]), simd.sub_f32s(x[1], change[1]), simd.sub_f32s(x[2], change[2])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::minimize::multigrid::DAMPING;
    use std::sync::Arc;

    /// What smoothing with yarns and without leaves of particles that have to do with others on their yarns alone, in the direction in which
    /// they are held the least, with second neighbours too or not.
    fn left(second: f32) -> [f32; 2] {
        let [rows, step] = [9, 21];
        let n = rows * step;
        let pairs = |distance: usize| (0..n - distance).map(move |k| (k as u32, (k + distance) as u32));
        let lines = Arc::new(Lines::new(n, pairs(step).chain(pairs(2 * step)).collect()));
        let mut numbers = Numbers::new(lines.clone());
        let soft = [0.6, 0.0, 0.8];
        let block = |stiff: f32, along: f32| -> [f32; 9] {
            std::array::from_fn(|k| {
                let (i, j) = (k / 3, k % 3);
                let own = soft[i] * soft[j];
                stiff * (f32::from(u8::from(i == j)) - own) + along * own
            })
        };
        (0..n).for_each(|k| numbers.set_block(k, block(300.0, 2.0 + 2.0 * second)));
        // What is held has no part in anything.
        numbers.set_block(step + 3, [0.0; 9]);
        for run in &lines.runs {
            let along = if run.second == step { -0.9 } else { second };
            for k in 0..run.len {
                let is_held = [k, run.second + k].contains(&(step + 3));
                numbers.set_block(run.at + k, if is_held { [0.0; 9] } else { block(0.0, along) });
            }
        }
        numbers.invert(Team::nobody());
        let mut yarns = Yarns::of_rows([rows, step], &lines);
        yarns.are_used = true;
        yarns.set(&numbers, Team::nobody());
        let b: Vec<f64> =
            (0..3 * lines.plane).map(|k| if k % lines.plane < n { (k as f64).sin() } else { 0.0 }).collect();
        [Some(yarns), None].map(|yarns| {
            let mut stencil = Stencil::new(numbers.clone(), false, yarns);
            stencil.smooth_towards(Team::nobody(), &b);
            let x: Vec<f32> = stencil.x.iter().map(|x| x / DAMPING).collect();
            let mut image = vec![0.0; x.len()];
            stencil.multiply(Team::nobody(), &x, &mut image);
            let off = |k: usize| if k % lines.plane == step + 3 { 0.0 } else { image[k] - b[k] as f32 };
            (0..x.len()).map(|k| off(k).abs()).fold(0.0, f32::max)
        })
    }

    #[test]
    fn yarns_are_solved_exactly_and_second_neighbours_but_for_what_is_lumped() {
        let [with, without] = left(0.0);
        assert!(with < 1e-4 && without > 0.3, "{with} {without}");
        let [with, without] = left(0.2);
        assert!(with < 0.7 * without, "{with} {without}");
    }
}
