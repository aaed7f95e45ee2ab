//! One level of the hierarchy and its vectors: in planes where most pairs stand in line, as whole registers of neighbours then go at once;
//! else by blocks.

use super::{
    halves::parts_mut,
    matrix::{Block, Matrix, Node, Wide, inverse},
    node,
    stencil::Stencil,
    transfer::Transfer,
};
use crate::{cores::Team, math::pack::dispatch};
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// A level but the coarsest.
pub enum Level {
    /// In planes, smoothed by damped block Jacobi.
    Planes(Box<Stencil>),
    /// By blocks, smoothed by Gauss and Seidel.
    Blocks(Box<Sweeps>),
}

/// A matrix, and the inverses of its diagonal blocks.
#[derive(Clone)]
pub struct Swept {
    /// The matrix.
    pub matrix: Matrix,
    /// The inverses. Particles that cannot move have none; neither do they follow their masters.
    pub inverses: Vec<Block>,
}

/// A level by blocks.
pub struct Sweeps {
    /// Its matrix.
    pub swept: Swept,
    /// What it solves for.
    pub x: Vec<Wide>,
    /// Right-hand side.
    pub b: Vec<Node>,
    /// What is left.
    pub r: Vec<Node>,
    /// What the rows beside the middle were before the last sweep.
    seam: Vec<Wide>,
}

impl Swept {
    /// Of a matrix.
    pub fn new(matrix: Matrix) -> Swept {
        Swept { inverses: vec![[0.0; 9]; matrix.len()], matrix }
    }

    /// Makes the inverses.
    pub fn invert(&mut self) {
        dispatch(Invert(self));
    }

    /// Whether a row does not move.
    #[inline(always)]
    fn is_fixed(&self, row: usize) -> bool {
        self.inverses[row][0] == 0.0
    }
}

struct Invert<'a>(&'a mut Swept);

impl WithSimd for Invert<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Swept { matrix, inverses } = self.0;
        inverses.iter_mut().enumerate().for_each(|(row, to)| *to = inverse(matrix.diagonal(row)));
    }
}

impl Sweeps {
    /// With room for vectors.
    pub fn new(swept: Swept) -> Sweeps {
        let n = swept.matrix.len();
        let (nodes, wide) = (vec![[0.0; 4]; n], |len| vec![Wide::new(&[0.0; 4]); len]);
        Sweeps { seam: wide(swept.matrix.seam().len()), swept, x: wide(n), b: nodes.clone(), r: nodes }
    }
}

impl Level {
    /// Where vectors in planes of this length are halved.
    pub fn middle(&self, plane: usize) -> usize {
        match self {
            Level::Planes(stencil) => stencil.middle(),
            Level::Blocks(sweeps) => sweeps.swept.matrix.middle().min(plane / 2),
        }
    }

    /// The right-hand side.
    pub fn rhs(&mut self) -> &mut [Node] {
        match self {
            Level::Planes(stencil) => &mut stencil.rhs,
            Level::Blocks(sweeps) => &mut sweeps.b,
        }
    }

    /// What the first smoothing left.
    pub fn left(&self) -> &[Node] {
        match self {
            Level::Planes(stencil) => &stencil.nodes,
            Level::Blocks(sweeps) => &sweeps.r,
        }
    }

    /// Starts from zero towards the right-hand side and leaves what is left.
    pub fn smooth_first(&mut self, team: &Team) {
        match self {
            Level::Planes(stencil) => stencil.smooth_first(team),
            Level::Blocks(sweeps) => sweeps.smooth_first(team),
        }
    }

    /// Adds what a coarser level solved.
    pub fn follow(&mut self, team: &Team, transfer: &Transfer, coarser: impl Fn(usize) -> Node + Sync) {
        match self {
            Level::Planes(stencil) => stencil.follow(team, transfer, coarser),
            Level::Blocks(sweeps) => sweeps.follow(team, transfer, coarser),
        }
    }

    /// Smooths once more.
    pub fn smooth_last(&mut self, team: &Team) {
        match self {
            Level::Planes(stencil) => stencil.smooth_last(team),
            Level::Blocks(sweeps) => sweeps.smooth_last(team),
        }
    }
}

/// What rows weigh on their masters, half of these by half.
pub fn restrict(team: &Team, transfer: &Transfer, from: &[Node], to: &mut [Node]) {
    let middle = to.len() / 2;
    let (low, high) = to.split_at_mut(middle);
    team.both(
        || dispatch(Restrict { transfer, from, to: low, masters: 0 }),
        || dispatch(Restrict { transfer, from, to: high, masters: middle }),
    );
}

impl Sweeps {
    /// Who does the halves: a second one that is empty is nobody's.
    fn team<'a>(&self, team: &'a Team) -> &'a Team {
        if self.swept.matrix.middle() < self.swept.matrix.len() { team } else { Team::nobody() }
    }

    fn smooth_first(&mut self, team: &Team) {
        let team = self.team(team);
        let Sweeps { swept, b, x, r, .. } = self;
        let (swept, b, middle, n) = (&*swept, &b[..], swept.matrix.middle(), b.len());
        let (low, high) = x.split_at_mut(middle);
        team.both(
            || dispatch(Smooth { swept, rows: 0..middle, way: Way::Forward(b, low) }),
            || dispatch(Smooth { swept, rows: middle..n, way: Way::Forward(b, high) }),
        );
        let (x, (low, high)) = (&x[..], r.split_at_mut(middle));
        team.both(
            || dispatch(Smooth { swept, rows: 0..middle, way: Way::Leave(x, low) }),
            || dispatch(Smooth { swept, rows: middle..n, way: Way::Leave(x, high) }),
        );
    }

    fn follow(&mut self, team: &Team, transfer: &Transfer, coarser: impl Fn(usize) -> Node + Sync) {
        let team = self.team(team);
        let Sweeps { swept, x, .. } = self;
        let (swept, coarser, middle) = (&*swept, &coarser, swept.matrix.middle());
        let (low, high) = x.split_at_mut(middle);
        team.both(
            || dispatch(Follow { swept, transfer, coarser, x: low, from: 0 }),
            || dispatch(Follow { swept, transfer, coarser, x: high, from: middle }),
        );
    }

    fn smooth_last(&mut self, team: &Team) {
        let team = self.team(team);
        let Sweeps { swept, b, x, seam, .. } = self;
        let (swept, b, middle, n) = (&*swept, &b[..], swept.matrix.middle(), b.len());
        seam.copy_from_slice(&x[swept.matrix.seam()]);
        let (seam, (low, high)) = (&seam[..], x.split_at_mut(middle));
        team.both(
            || dispatch(Smooth { swept, rows: 0..middle, way: Way::Backward(b, (low, seam)) }),
            || dispatch(Smooth { swept, rows: middle..n, way: Way::Backward(b, (high, seam)) }),
        );
    }

    /// The matrix times a vector, both in planes of this length.
    pub fn multiply(&mut self, team: &Team, plane: usize, x: &[f32], out: &mut [f32]) {
        let team = self.team(team);
        let Sweeps { swept: Swept { matrix, .. }, x: wide, .. } = self;
        let (matrix, middle, n) = (&*matrix, matrix.middle(), wide.len());
        let (low, high) = wide.split_at_mut(middle);
        let widen = |from: usize, wide: &mut [Wide]| {
            (from..).zip(wide).for_each(|(row, wide)| *wide = Wide::new(&node(x, plane, row)));
        };
        team.both(|| widen(0, low), || widen(middle, high));
        let (x, [low, high]) = (&wide[..], parts_mut(out, middle));
        team.both(
            || dispatch(Product { matrix, x, out: low, rows: 0..middle }),
            || dispatch(Product { matrix, x, out: high, rows: middle..n }),
        );
    }
}

/// What becomes of some rows.
struct Smooth<'a> {
    swept: &'a Swept,
    rows: Range<usize>,
    way: Way<'a>,
}

/// The first sweep, what it leaves, or the last one.
enum Way<'a> {
    Forward(&'a [Node], &'a mut [Wide]),
    Leave(&'a [Wide], &'a mut [Node]),
    Backward(&'a [Node], (&'a mut [Wide], &'a [Wide])),
}

impl WithSimd for Smooth<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Smooth { swept: Swept { matrix, inverses }, rows, way } = self;
        match way {
            Way::Forward(b, x) => matrix.sweep_forward(simd, rows, inverses, b, x),
            Way::Leave(x, r) => matrix.leave(simd, rows, inverses, x, r),
            Way::Backward(b, x) => matrix.sweep_backward(simd, rows, inverses, b, x),
        }
    }
}

struct Follow<'a, F> {
    swept: &'a Swept,
    transfer: &'a Transfer,
    coarser: &'a F,
    x: &'a mut [Wide],
    from: usize,
}

impl<F: Fn(usize) -> Node> WithSimd for Follow<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Follow { swept, transfer, coarser, x, from } = self;
        for (row, x) in (from..).zip(x).filter(|(row, _)| !swept.is_fixed(*row)) {
            let (own, follow) = (x.node(), transfer.followed::<S>(row, coarser));
            *x = Wide::new(&std::array::from_fn(|k| own[k] + follow[k]));
        }
    }
}

struct Product<'a> {
    matrix: &'a Matrix,
    x: &'a [Wide],
    out: [&'a mut [f32]; 3],
    rows: Range<usize>,
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Product { matrix, x, out: [a, b, c], rows } = self;
        for (row, to) in rows.zip(a.iter_mut().zip(b).zip(c)) {
            let ((a, b), c) = to;
            [*a, *b, *c, _] = matrix.product(simd, matrix.row(row), x, 0);
        }
    }
}

struct Restrict<'a> {
    transfer: &'a Transfer,
    from: &'a [Node],
    to: &'a mut [Node],
    masters: usize,
}

impl WithSimd for Restrict<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        self.transfer.restrict::<S>(self.from, self.to, self.masters);
    }
}
