//! Block-sparse matrices of the preconditioner in single precision, as small as can be: reading them is most of what they cost.

use pulp::Simd;
use std::ops::Range;

/// A 3 × 3 block, column by column.
pub type Block = [f32; 9];

/// Three numbers and one that does not count.
pub type Node = [f32; 4];

/// A node's numbers as blocks are multiplied by them, each three times, and zeros.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub struct Wide([f32; 16]);

/// A square matrix of blocks, row by row, every row beginning with its diagonal block. Its pattern is symmetric.
#[derive(Clone, Debug, Default)]
pub struct Matrix {
    /// First block of each row.
    pub starts: Vec<u32>,
    /// Column of each block.
    pub columns: Vec<u32>,
    /// Numbers of the blocks, and as many behind as registers read beyond.
    numbers: Vec<f32>,
    /// Rows in the order of sweeps.
    order: Vec<u32>,
    /// First block of each row whose column comes later in that order, and the first whose column lies in the other half.
    later: Vec<u32>,
    other: Vec<u32>,
    /// First row of the second half, if two threads sweep a half each.
    middle: usize,
    /// Rows that the other half looks at.
    seam: Range<usize>,
}

/// Rows whose order in a sweep may change: those that share no block come next to each other, as none waits for another then.
const NEAR: usize = 32;

/// Numbers that are read of a block and of what lies behind it.
const READ: usize = 16;

/// Some rows of a matrix.
pub struct Rows<'a> {
    /// Place of their first block.
    pub first: u32,
    numbers: &'a mut [f32],
}

impl Rows<'_> {
    /// A block of theirs, by its place in the matrix; none if it is not.
    #[inline(always)]
    pub fn block_mut(&mut self, place: u32) -> Option<&mut Block> {
        let place = place.checked_sub(self.first)? as usize;
        self.numbers.get_mut(9 * place..)?.first_chunk_mut()
    }
}

impl Matrix {
    /// An empty matrix with these columns in each row, a symmetric pattern; the row's own column comes first. It is swept in halves, or as a
    /// whole.
    pub fn new(mut rows: Vec<Vec<u32>>, is_parted: bool) -> Matrix {
        let turns = turns(&rows);
        let mut order: Vec<u32> = (0..rows.len() as u32).collect();
        order.sort_by_key(|&row| turns[row as usize]);
        let middle = if is_parted { rows.len() / 2 / NEAR * NEAR } else { rows.len() };
        let (mut starts, mut later, mut other) = (vec![0], Vec::new(), Vec::new());
        let mut seam: Option<Range<usize>> = None;
        for (row, columns) in rows.iter_mut().enumerate() {
            let is_other = |column: u32| (column as usize >= middle) != (row >= middle);
            columns[1..].sort_unstable_by_key(|&column| (is_other(column), turns[column as usize], column));
            let own = columns.partition_point(|&column| !is_other(column));
            let earlier = columns[1..own].iter().take_while(|&&column| turns[column as usize] < turns[row]);
            let start = starts[row];
            later.push(start + 1 + earlier.count() as u32);
            other.push(start + own as u32);
            starts.push(start + columns.len() as u32);
            for column in columns[own..].iter().map(|&column| column as usize) {
                let Range { start, end } = seam.unwrap_or(column..column);
                seam = Some(start.min(column)..end.max(column + 1));
            }
        }
        let columns = rows.concat();
        let (numbers, seam) = (vec![0.0; 9 * columns.len() + READ], seam.unwrap_or_default());
        Matrix { numbers, starts, columns, order, later, other, middle, seam }
    }

    /// First row of the second half; beyond the last where it is swept as a whole.
    pub fn middle(&self) -> usize {
        self.middle
    }

    /// Rows among which are all that the other half looks at.
    pub fn seam(&self) -> Range<usize> {
        self.seam.clone()
    }

    /// A block, and what lies behind it.
    #[inline(always)]
    pub fn window(&self, place: usize) -> &[f32; READ] {
        self.numbers[9 * place..].first_chunk().expect("room behind the last block")
    }

    /// A block.
    #[inline(always)]
    pub fn block_mut(&mut self, place: usize) -> &mut Block {
        self.numbers[9 * place..].first_chunk_mut().expect("a block")
    }

    /// A block.
    #[inline(always)]
    pub fn block(&self, place: usize) -> &Block {
        self.window(place).first_chunk().expect("a block")
    }

    /// The diagonal block of a row.
    #[inline(always)]
    pub fn diagonal(&self, row: usize) -> &Block {
        self.block(self.starts[row] as usize)
    }

    /// Empties the diagonal block of a row.
    #[inline(always)]
    pub fn forget_diagonal(&mut self, row: usize) {
        *self.block_mut(self.starts[row] as usize) = [0.0; 9];
    }

    /// Its rows before one and from there on, to be filled.
    pub fn rows_mut(&mut self, middle: usize) -> [Rows<'_>; 2] {
        let first = self.starts[middle];
        let (low, high) = self.numbers[..9 * self.columns.len()].split_at_mut(9 * first as usize);
        [Rows { first: 0, numbers: low }, Rows { first, numbers: high }]
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

    /// Place of the block in a row and a column, if there is one.
    pub fn place(&self, row: u32, column: u32) -> Option<u32> {
        let range = self.row(row as usize);
        let found = self.columns[range.clone()].iter().position(|&c| c == column);
        found.map(|place| (range.start + place) as u32)
    }

    /// One forward sweep of Gauss and Seidel from zero in one half of the rows, with the inverses of the diagonal blocks, as if the other half
    /// stayed at zero. What has no inverse does not move. `x` has these rows alone.
    #[inline(always)]
    pub fn sweep_forward<S: Simd>(
        &self,
        simd: S,
        rows: Range<usize>,
        inverses: &[Block],
        b: &[Node],
        x: &mut [Wide],
    ) {
        let from = rows.start;
        // Rows change their order within a half.
        for row in self.order[rows].iter().map(|&row| row as usize) {
            let earlier = self.starts[row] as usize + 1..self.later[row] as usize;
            let left = minus(&b[row], &self.product(simd, earlier, x, from));
            x[row - from] = Wide::new(&times(&inverses[row], &left));
        }
    }

    /// What is left of the right-hand side after such sweeps, in one half of the rows; nothing of what has no inverse.
    #[inline(always)]
    pub fn leave<S: Simd>(
        &self,
        simd: S,
        rows: Range<usize>,
        inverses: &[Block],
        x: &[Wide],
        r: &mut [Node],
    ) {
        for (row, r) in rows.zip(r) {
            // Every row is balanced but for what came later.
            let later = self.later[row] as usize..self.starts[row + 1] as usize;
            let held = inverses[row][0] == 0.0;
            *r = if held { [0.0; 4] } else { minus(&[0.0; 4], &self.product(simd, later, x, 0)) };
        }
    }

    /// One backward sweep in one half of the rows, which `x` has alone; `seam` is what the seam's rows were before.
    #[inline(always)]
    pub fn sweep_backward<S: Simd>(
        &self,
        simd: S,
        rows: Range<usize>,
        inverses: &[Block],
        b: &[Node],
        (x, seam): (&mut [Wide], &[Wide]),
    ) {
        let from = rows.start;
        for row in self.order[rows].iter().rev().map(|&row| row as usize) {
            let others = self.starts[row] as usize + 1..self.other[row] as usize;
            let mut left = minus(&b[row], &self.product(simd, others, x, from));
            let beyond = self.other[row] as usize..self.starts[row + 1] as usize;
            if !beyond.is_empty() {
                left = minus(&left, &self.product(simd, beyond, seam, self.seam.start));
            }
            x[row - from] = Wide::new(&times(&inverses[row], &left));
        }
    }

    /// The sum of blocks times the nodes of their columns, of which the first that `x` has is `from`.
    #[inline(always)]
    pub fn product<S: Simd>(&self, simd: S, range: Range<usize>, x: &[Wide], from: usize) -> Node {
        let columns = &self.columns[range.clone()];
        let numbers = &self.numbers[9 * range.start..9 * range.end + READ];
        // Two sums, so that additions need not wait for each other.
        let (mut even, mut odd) = ([0.0f32; READ], [0.0f32; READ]);
        let (pairs, last) = columns.as_chunks::<2>();
        for (k, columns) in pairs.iter().enumerate() {
            plus_product(simd, &mut even, &numbers[18 * k..], &x[columns[0] as usize - from]);
            plus_product(simd, &mut odd, &numbers[18 * k + 9..], &x[columns[1] as usize - from]);
        }
        if let [column] = last {
            plus_product(simd, &mut even, &numbers[18 * pairs.len()..], &x[*column as usize - from]);
        }
        std::array::from_fn(|k| (even[k] + odd[k]) + (even[k + 3] + odd[k + 3]) + (even[k + 6] + odd[k + 6]))
    }
}

/// When each row has its turn in a sweep: in order, but for near ones that share no block, which have it at once.
fn turns(rows: &[Vec<u32>]) -> Vec<usize> {
    let mut turns = vec![usize::MAX; rows.len()];
    for (row, columns) in rows.iter().enumerate() {
        let first = row / NEAR * NEAR;
        let is_free = |turn: &usize| columns.iter().all(|&column| turns[column as usize] != *turn);
        turns[row] = (first..first + NEAR).find(is_free).expect("a turn for each");
    }
    turns
}

/// sum += block · x
#[inline(always)]
fn plus_product<S: Simd>(simd: S, sum: &mut [f32; READ], numbers: &[f32], x: &Wide) {
    let block: &[f32; READ] = numbers.first_chunk().expect("room behind the last block");
    let factors = S::as_simd_f32s(block).0.iter().zip(S::as_simd_f32s(&x.0).0);
    for (sum, (block, x)) in S::as_mut_simd_f32s(sum).0.iter_mut().zip(factors) {
        *sum = simd.mul_add_e_f32s(*block, *x, *sum);
    }
}

#[inline(always)]
fn minus(a: &Node, b: &Node) -> Node {
    std::array::from_fn(|k| a[k] - b[k])
}

impl Wide {
    /// A node as blocks are multiplied by it.
    #[inline(always)]
    pub fn new(x: &Node) -> Wide {
        Wide(std::array::from_fn(|k| if k < 9 { x[k / 3] } else { 0.0 }))
    }

    /// The node.
    #[inline(always)]
    pub fn node(&self) -> Node {
        [self.0[0], self.0[3], self.0[6], 0.0]
    }
}

/// a b + c, rounded once where the machine can.
#[inline(always)]
pub fn fused<S: Simd>(a: f32, b: f32, c: f32) -> f32 {
    // Without such an instruction `mul_add` is a slow function.
    if S::IS_SCALAR { a * b + c } else { a.mul_add(b, c) }
}

/// Block times node.
#[inline(always)]
fn times(block: &Block, x: &Node) -> Node {
    let row = |k: usize| block[k] * x[0] + block[k + 3] * x[1] + block[k + 6] * x[2];
    [row(0), row(1), row(2), 0.0]
}

/// Transpose of a block.
#[inline(always)]
pub fn transposed(block: &Block) -> Block {
    std::array::from_fn(|k| block[3 * (k % 3) + k / 3])
}

/// The inverse of a symmetric positive definite block; zero where it is none.
#[inline(always)]
pub fn inverse(block: &Block) -> Block {
    let at = |row: usize, column: usize| f64::from(block[3 * column + row]);
    let (a, b, c, d, e, f) = (at(0, 0), at(1, 0), at(2, 0), at(1, 1), at(2, 1), at(2, 2));
    let (p, q, r) = (d * f - e * e, c * e - b * f, b * e - c * d);
    let determinant = a * p + b * q + c * r;
    let scale = if determinant > 0.0 { 1.0 / determinant } else { 0.0 };
    let number = |value: f64| (value * scale) as f32;
    let (p, q, r) = (number(p), number(q), number(r));
    let (s, t, u) = (number(a * f - c * c), number(b * c - a * e), number(a * d - b * b));
    [p, q, r, q, s, t, r, t, u]
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::Scalar;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    /// A strip whose rows share blocks with the next two on either side, more rows than one window of a sweep; symmetric, the first held.
    fn strip(rng: &mut Pcg64Mcg, is_parted: bool) -> Matrix {
        let n = 2 * NEAR as u32 + 9;
        let near = |row: u32| (row.saturating_sub(2)..(row + 3).min(n)).filter(move |&column| column != row);
        let rows = (0..n).map(|row| std::iter::once(row).chain(near(row)).collect());
        let mut matrix = Matrix::new(rows.collect(), is_parted);
        for row in 1..n {
            for column in row..(row + 3).min(n) {
                let mut block: Block = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
                if row == column {
                    block =
                        std::array::from_fn(
                            |k| if k % 4 == 0 { 9.0 } else { block[k] + transposed(&block)[k] },
                        );
                }
                let [place, mirrored] =
                    [(row, column), (column, row)].map(|(a, b)| matrix.place(a, b).unwrap());
                *matrix.block_mut(mirrored as usize) = transposed(&block);
                *matrix.block_mut(place as usize) = block;
            }
        }
        matrix
    }

    /// What a forward sweep solves for and leaves, and what a backward one makes of it.
    fn swept(matrix: &Matrix, b: &[Node]) -> (Vec<Wide>, Vec<Node>, Vec<Wide>) {
        let (simd, n, middle) = (Scalar::new(), matrix.len(), matrix.middle());
        let inverses: Vec<Block> = (0..n).map(|row| inverse(matrix.diagonal(row))).collect();
        let (mut x, mut r) = (vec![Wide::new(&[0.0; 4]); n], vec![[0.0; 4]; n]);
        for rows in [0..middle, middle..n] {
            matrix.sweep_forward(simd, rows.clone(), &inverses, b, &mut x[rows]);
        }
        for rows in [0..middle, middle..n] {
            matrix.leave(simd, rows.clone(), &inverses, &x, &mut r[rows]);
        }
        let first = x.clone();
        let seam = &first[matrix.seam()];
        for rows in [0..middle, middle..n] {
            matrix.sweep_backward(simd, rows.clone(), &inverses, b, (&mut x[rows], seam));
        }
        (first, r, x)
    }

    fn numbers(r: &[Node]) -> Vec<f32> {
        r.iter().flat_map(|r| r[..3].to_vec()).collect()
    }

    fn any(rng: &mut Pcg64Mcg, n: usize) -> Vec<Node> {
        let mut b: Vec<Node> = (0..n)
            .map(|_| std::array::from_fn(|k| if k < 3 { rng.random_range(-1.0..1.0) } else { 0.0 }))
            .collect();
        b[0] = [0.0; 4];
        b
    }

    #[test]
    fn a_sweep_leaves_what_it_says_and_the_next_takes_of_it() {
        let simd = Scalar::new();
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        for is_parted in [false, true] {
            let matrix = strip(&mut rng, is_parted);
            let n = matrix.len();
            assert_eq!(
                (matrix.middle() < n, matrix.seam().len()),
                (is_parted, if is_parted { 4 } else { 0 })
            );
            let b = any(&mut rng, n);
            let left = |x: &[Wide]| -> Vec<Node> {
                (0..n).map(|row| minus(&b[row], &matrix.product(simd, matrix.row(row), x, 0))).collect()
            };
            let size = |r: &[Node]| numbers(r).iter().map(|v| v * v).sum::<f32>().sqrt();
            let (first, r, x) = swept(&matrix, &b);
            let truly = left(&first);
            let off = numbers(&r).iter().zip(numbers(&truly)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off < 1e-5 && size(&r) < 0.5 * size(&b), "{off}, {} of {}", size(&r), size(&b));
            assert_eq!(first[0].node(), [0.0; 4], "what is held does not move");
            assert!(size(&left(&x)) < 0.5 * size(&truly), "{} of {}", size(&left(&x)), size(&truly));
        }
    }

    #[test]
    fn sweeps_in_halves_are_symmetric_and_positive_as_conjugate_gradients_need() {
        let mut rng = Pcg64Mcg::seed_from_u64(2);
        let matrix = strip(&mut rng, true);
        let answer = |b: &[Node]| -> Vec<f32> { swept(&matrix, b).2.iter().flat_map(|x| x.node()).collect() };
        let dot = |a: &[f32], b: &[Node]| a.iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum::<f32>();
        for _ in 0..50 {
            let [a, b] = [(); 2].map(|()| any(&mut rng, matrix.len()));
            let (of_a, of_b) = (answer(&a), answer(&b));
            let [forth, back, own] = [dot(&of_a, &b), dot(&of_b, &a), dot(&of_a, &a)];
            assert!((forth - back).abs() < 1e-4 * own && own > 0.0, "{forth}, {back}, {own}");
        }
    }
}
