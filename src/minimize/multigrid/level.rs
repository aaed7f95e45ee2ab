//! One level of the hierarchy and its vectors: in planes where most pairs stand in line, as whole registers of neighbours then go at once;
//! else by blocks.

use super::{
    matrix::{Block, Matrix, Node, Wide, inverse},
    stencil::Stencil,
    transfer::Transfer,
};
use crate::{cores::Team, math::pack::dispatch};
use pulp::{Simd, WithSimd};

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
        Sweeps { swept, x: vec![Wide::new(&[0.0; 4]); n], b: vec![[0.0; 4]; n], r: vec![[0.0; 4]; n] }
    }
}

impl Level {
    /// Where vectors in planes of this length are halved.
    pub fn middle(&self, plane: usize) -> usize {
        match self {
            Level::Planes(stencil) => stencil.middle(),
            Level::Blocks(_) => plane / 2,
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
            Level::Blocks(sweeps) => dispatch(Forward(sweeps)),
        }
    }

    /// Adds what a coarser level solved.
    pub fn follow(&mut self, team: &Team, transfer: &Transfer, coarser: impl Fn(usize) -> Node + Sync) {
        match self {
            Level::Planes(stencil) => stencil.follow(team, transfer, coarser),
            Level::Blocks(sweeps) => dispatch(Follow { sweeps, transfer, coarser }),
        }
    }

    /// Smooths once more.
    pub fn smooth_last(&mut self, team: &Team) {
        match self {
            Level::Planes(stencil) => stencil.smooth_last(team),
            Level::Blocks(sweeps) => dispatch(Backward(sweeps)),
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

struct Forward<'a>(&'a mut Sweeps);

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Sweeps { swept: Swept { matrix, inverses }, b, x, r } = self.0;
        matrix.sweep_forward(simd, inverses, b, x, r);
    }
}

struct Backward<'a>(&'a mut Sweeps);

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Sweeps { swept: Swept { matrix, inverses }, b, x, .. } = self.0;
        matrix.sweep_backward(simd, inverses, b, x);
    }
}

struct Follow<'a, F> {
    sweeps: &'a mut Sweeps,
    transfer: &'a Transfer,
    coarser: F,
}

impl<F: Fn(usize) -> Node> WithSimd for Follow<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Follow { sweeps: Sweeps { swept, x, .. }, transfer, coarser } = self;
        for (row, x) in x.iter_mut().enumerate().filter(|(row, _)| !swept.is_fixed(*row)) {
            let (own, follow) = (x.node(), transfer.followed::<S>(row, &coarser));
            *x = Wide::new(&std::array::from_fn(|k| own[k] + follow[k]));
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
