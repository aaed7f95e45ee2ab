//! The same factor by faer's sparse Cholesky: the reference that our own is measured and tested against.

use super::{COLUMNS, Indefinite};
use crate::potential::pattern::Pattern;
use faer::{
    Conj, MatMut, Par, Side, Spec,
    dyn_stack::{MemBuffer, MemStack, StackReq},
    linalg::cholesky::llt::factor::LltRegularization,
    sparse::{
        SparseColMatRef, SymbolicSparseColMatRef,
        linalg::{
            SupernodalThreshold, SymbolicSupernodalParams,
            cholesky::{
                CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering,
                factorize_symbolic_cholesky,
            },
        },
    },
};

/// When neighbouring supernodes merge: (columns, share of zeros). A little looser than faer's own, as the blocks come in threes:
/// 7 % faster at 39 × 39 and 77 × 77; twice as loose is slower again.
const RELAX: &[(usize, f64)] = &[(12, 1.0), (48, 0.5), (96, 0.15), (usize::MAX, 0.08)];

/// A factor by faer and its scratch memory.
pub struct Reference {
    symbolic: SymbolicCholesky<u32>,
    values: Vec<f64>,
    memory: MemBuffer,
    size: usize,
}

impl Reference {
    /// Symbolic factorization of a pattern, in the pattern's own order.
    pub fn new(pattern: &Pattern) -> Reference {
        let size = pattern.columns.len() - 1;
        // The analysis reads the upper triangle where no reordering is asked for; the numeric part reads the lower one.
        let (columns, rows) = transposed(pattern, size);
        let matrix = SymbolicSparseColMatRef::new_checked(size, size, &columns, None, &rows);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            supernodal_params: SymbolicSupernodalParams { relax: Some(RELAX) },
            ..Default::default()
        };
        let symbolic = factorize_symbolic_cholesky(matrix, Side::Upper, SymmetricOrdering::Identity, params)
            .expect("memory for the symbolic factor");
        let need = StackReq::any_of(&[
            symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Spec::default()),
            symbolic.solve_in_place_scratch::<f64>(COLUMNS, Par::Seq),
        ]);
        Reference { values: vec![0.0; symbolic.len_val()], memory: MemBuffer::new(need), symbolic, size }
    }

    /// Numeric factorization of the lower triangle `values`.
    pub fn factorize(&mut self, pattern: &Pattern, values: &[f64]) -> Result<(), Indefinite> {
        let matrix = SparseColMatRef::new(symbolic(pattern, self.size), values);
        self.symbolic
            .factorize_numeric_llt(
                &mut self.values,
                matrix,
                Side::Lower,
                LltRegularization::default(),
                Par::Seq,
                MemStack::new(&mut self.memory),
                Spec::default(),
            )
            .map(|_| ())
            .map_err(|_| Indefinite)
    }

    /// Solves for `columns` right-hand sides in place, column by column in `rhs`.
    pub fn solve(&mut self, rhs: &mut [f64], columns: usize) {
        let rhs = MatMut::from_column_major_slice_mut(rhs, self.size, columns);
        LltRef::<u32, f64>::new(&self.symbolic, &self.values).solve_in_place_with_conj(
            Conj::No,
            rhs,
            Par::Seq,
            MemStack::new(&mut self.memory),
        );
    }
}

fn symbolic(pattern: &Pattern, size: usize) -> SymbolicSparseColMatRef<'_, u32> {
    SymbolicSparseColMatRef::new_checked(size, size, &pattern.columns, None, &pattern.rows)
}

/// Columns and rows of the upper triangle.
fn transposed(pattern: &Pattern, size: usize) -> (Vec<u32>, Vec<u32>) {
    let mut columns = vec![0; size + 1];
    for &row in &pattern.rows {
        columns[row as usize + 1] += 1;
    }
    for c in 0..size {
        columns[c + 1] += columns[c];
    }
    let (mut next, mut rows) = (columns.clone(), vec![0; pattern.rows.len()]);
    for column in 0..size {
        for at in pattern.columns[column]..pattern.columns[column + 1] {
            let row = pattern.rows[at as usize] as usize;
            rows[next[row] as usize] = column as u32;
            next[row] += 1;
        }
    }
    (columns, rows)
}
