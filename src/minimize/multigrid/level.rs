//! One level of the hierarchy and its vectors: in planes where most pairs stand in line, as whole registers of neighbours then go at once;
//! else by blocks.

use super::{
    matrix::{Block, Matrix, Node, Wide, inverse},
    stencil::Stencil,
    transfer::Transfer,
};
use pulp::Simd;

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
    #[inline(always)]
    pub fn invert(&mut self) {
        for row in 0..self.matrix.len() {
            self.inverses[row] = inverse(self.matrix.diagonal(row));
        }
    }
}

impl Sweeps {
    /// With room for vectors.
    pub fn new(swept: Swept) -> Sweeps {
        let n = swept.matrix.len();
        Sweeps { swept, x: vec![Wide::new(&[0.0; 4]); n], b: vec![[0.0; 4]; n], r: vec![[0.0; 4]; n] }
    }

    /// Whether a row does not move.
    #[inline(always)]
    fn is_fixed(&self, row: usize) -> bool {
        self.swept.inverses[row][0] == 0.0
    }
}

impl Level {
    /// Room for the right-hand side.
    #[inline(always)]
    pub fn rhs(&mut self) -> &mut [Node] {
        match self {
            Level::Planes(stencil) => &mut stencil.nodes,
            Level::Blocks(sweeps) => &mut sweeps.b,
        }
    }

    /// What the first smoothing left.
    #[inline(always)]
    pub fn left(&self) -> &[Node] {
        match self {
            Level::Planes(stencil) => &stencil.nodes,
            Level::Blocks(sweeps) => &sweeps.r,
        }
    }

    /// Starts from zero towards the right-hand side and leaves what is left.
    #[inline(always)]
    pub fn smooth_first<S: Simd>(&mut self, simd: S) {
        match self {
            Level::Planes(stencil) => stencil.smooth_first(simd),
            Level::Blocks(sweeps) => {
                let Sweeps { swept: Swept { matrix, inverses }, b, x, r } = &mut **sweeps;
                matrix.sweep_forward(simd, inverses, b, x, r);
            }
        }
    }

    /// Adds what a coarser level solved.
    #[inline(always)]
    pub fn follow<S: Simd>(&mut self, transfer: &Transfer, coarser: impl Fn(usize) -> Node) {
        match self {
            Level::Planes(stencil) => {
                for row in 0..stencil.nodes.len() {
                    if !stencil.is_fixed(row) {
                        stencil.add(row, &transfer.followed::<S>(row, &coarser));
                    }
                }
            }
            Level::Blocks(sweeps) => {
                for row in 0..sweeps.x.len() {
                    if !sweeps.is_fixed(row) {
                        let (own, follow) = (sweeps.x[row].node(), transfer.followed::<S>(row, &coarser));
                        sweeps.x[row] = Wide::new(&std::array::from_fn(|k| own[k] + follow[k]));
                    }
                }
            }
        }
    }

    /// Smooths once more.
    #[inline(always)]
    pub fn smooth_last<S: Simd>(&mut self, simd: S) {
        match self {
            Level::Planes(stencil) => stencil.smooth_last(simd),
            Level::Blocks(sweeps) => {
                let Sweeps { swept: Swept { matrix, inverses }, b, x, .. } = &mut **sweeps;
                matrix.sweep_backward(simd, inverses, b, x);
            }
        }
    }
}
