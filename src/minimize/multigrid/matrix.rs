//! Block-sparse matrices of the preconditioner in single precision: a 3 × 3 block fills a register, padded column by column.

use pulp::Simd;

/// A 3 × 3 block, column by column, each padded to four numbers, and a fourth column of zeros.
pub type Block = [f32; 16];

/// Three numbers and a zero.
pub type Node = [f32; 4];

/// A square matrix of blocks, row by row, every row beginning with its diagonal block.
#[derive(Clone, Debug, Default)]
pub struct Matrix {
    /// First block of each row.
    pub starts: Vec<u32>,
    /// Column of each block.
    pub columns: Vec<u32>,
    /// Blocks.
    pub blocks: Vec<Block>,
}

impl Matrix {
    /// An empty matrix with these columns in each row; the row's own column comes first.
    pub fn new(rows: &[Vec<u32>]) -> Matrix {
        let mut starts = vec![0];
        rows.iter().for_each(|row| starts.push(starts[starts.len() - 1] + row.len() as u32));
        let columns = rows.concat();
        Matrix { blocks: vec![[0.0; 16]; columns.len()], starts, columns }
    }

    /// Rows.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Blocks of a row, as a range.
    #[inline(always)]
    pub fn row(&self, row: usize) -> std::ops::Range<usize> {
        self.starts[row] as usize..self.starts[row + 1] as usize
    }

    /// Place of the block in a row and a column.
    pub fn place(&self, row: u32, column: u32) -> u32 {
        let range = self.row(row as usize);
        let found = self.columns[range.clone()].iter().position(|&c| c == column);
        (range.start + found.expect("a block of the pattern")) as u32
    }

    /// out = b − A x
    #[inline(always)]
    pub fn residual<S: Simd>(&self, x: &[Node], b: &[Node], out: &mut [Node]) {
        for (row, out) in out.iter_mut().enumerate() {
            let range = self.row(row);
            let product = product::<S>(&self.blocks[range.clone()], &self.columns[range], x);
            for k in 0..4 {
                out[k] = b[row][k] - product[k];
            }
        }
    }
}

/// a b + c, rounded once where the machine can.
#[inline(always)]
pub fn fused<S: Simd>(a: f32, b: f32, c: f32) -> f32 {
    // Without such an instruction `mul_add` is a slow function.
    if S::IS_SCALAR { a * b + c } else { a.mul_add(b, c) }
}

/// The sum of blocks times the nodes of their columns.
#[inline(always)]
fn product<S: Simd>(blocks: &[Block], columns: &[u32], x: &[Node]) -> Node {
    // Two sums, so that additions need not wait for each other.
    let (mut even, mut odd) = ([0.0f32; 16], [0.0f32; 16]);
    let ((pairs, rest), (columns, last)) = (blocks.as_chunks::<2>(), columns.as_chunks::<2>());
    for (pair, columns) in pairs.iter().zip(columns) {
        even = plus_product::<S>(even, &pair[0], &x[columns[0] as usize]);
        odd = plus_product::<S>(odd, &pair[1], &x[columns[1] as usize]);
    }
    for (block, column) in rest.iter().zip(last) {
        even = plus_product::<S>(even, block, &x[*column as usize]);
    }
    let mut out = [0.0; 4];
    for k in 0..4 {
        out[k] = (even[k] + odd[k]) + (even[k + 4] + odd[k + 4]) + (even[k + 8] + odd[k + 8]);
    }
    out
}

#[inline(always)]
fn plus_product<S: Simd>(sum: Block, block: &Block, x: &Node) -> Block {
    let wide =
        [x[0], x[0], x[0], x[0], x[1], x[1], x[1], x[1], x[2], x[2], x[2], x[2], x[3], x[3], x[3], x[3]];
    let mut out = [0.0; 16];
    for k in 0..16 {
        out[k] = fused::<S>(block[k], wide[k], sum[k]);
    }
    out
}

/// Block times node.
#[inline(always)]
pub fn times(block: &Block, x: &Node) -> Node {
    let mut out = [0.0; 4];
    for k in 0..4 {
        out[k] = block[k] * x[0] + block[k + 4] * x[1] + block[k + 8] * x[2];
    }
    out
}

/// Transpose of a block.
#[inline(always)]
pub fn transposed(block: &Block) -> Block {
    let mut out = [0.0; 16];
    for row in 0..3 {
        for column in 0..3 {
            out[4 * row + column] = block[4 * column + row];
        }
    }
    out
}

/// `factor` times the inverse of a symmetric positive definite block; zero where it is none.
#[inline(always)]
pub fn inverse(block: &Block, factor: f32) -> Block {
    let at = |row: usize, column: usize| f64::from(block[4 * column + row]);
    let (a, b, c, d, e, f) = (at(0, 0), at(1, 0), at(2, 0), at(1, 1), at(2, 1), at(2, 2));
    let (p, q, r) = (d * f - e * e, c * e - b * f, b * e - c * d);
    let determinant = a * p + b * q + c * r;
    let scale = if determinant > 0.0 { f64::from(factor) / determinant } else { 0.0 };
    let number = |value: f64| (value * scale) as f32;
    let (p, q, r) = (number(p), number(q), number(r));
    let (s, t, u) = (number(a * f - c * c), number(b * c - a * e), number(a * d - b * b));
    [p, q, r, 0.0, q, s, t, 0.0, r, t, u, 0.0, 0.0, 0.0, 0.0, 0.0]
}
