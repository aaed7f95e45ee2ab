//! The sparse factor against the matrix it factors, on lattices of every shape.

use kesi::{
    grid::{Cell, Edit, Grid},
    minimize::{
        Method,
        factor::{COLUMNS, Cholesky, Factor, Indefinite},
    },
    potential::{pattern::Pattern, system::System},
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::sync::Arc;

const SHAPES: [[usize; 2]; 11] =
    [[2, 2], [2, 9], [9, 2], [3, 40], [5, 5], [7, 8], [13, 11], [16, 40], [31, 46], [46, 31], [77, 77]];

/// Random values on a mesh's pattern, diagonally dominant.
fn random_system(counts: [usize; 2]) -> System {
    system_on(&Grid::uniform(counts, [0.1, 0.1]))
}

fn system_on(grid: &Grid) -> System {
    let counts = grid.counts;
    let pattern = Arc::new(Pattern::new(grid, &grid.elements(|_| false)));
    let mut random = Pcg64::seed_from_u64(1 + counts[0] as u64);
    let mut system = System::new(pattern.clone());
    let mut sums = vec![1.0; pattern.columns.len() - 1];
    for column in 0..sums.len() {
        for at in pattern.columns[column] as usize + 1..pattern.columns[column + 1] as usize {
            let value: f64 = random.random_range(-1.0..1.0);
            system.values[at] = value;
            sums[column] += value.abs();
            sums[pattern.rows[at] as usize] += value.abs();
        }
    }
    for (column, sum) in sums.iter().enumerate() {
        system.values[pattern.columns[column] as usize] = *sum;
    }
    system
}

fn right_hand_sides(size: usize) -> Vec<f64> {
    (0..size * COLUMNS).map(|k| (k as f64 * 0.37).sin()).collect()
}

#[test]
fn factor_solves_lattices_of_every_shape() {
    for counts in SHAPES {
        let system = random_system(counts);
        let size = 3 * counts[0] * counts[1];
        let mut factor = Factor::new(&system.pattern);
        factor.factorize(&system.pattern, &system.values).unwrap();
        let b = right_hand_sides(size);
        for columns in 1..=COLUMNS {
            let mut x = b[..size * columns].to_vec();
            factor.solve(&mut x, columns);
            let mut product = vec![0.0; size];
            for (x, b) in x.chunks(size).zip(b.chunks(size)) {
                system.multiply(x, &mut product);
                let off: f64 = product.iter().zip(b).map(|(p, b)| (p - b).powi(2)).sum();
                let norm: f64 = b.iter().map(|b| b * b).sum();
                assert!(
                    (off / norm).sqrt() < 1e-12,
                    "{counts:?}, {columns} columns: {}",
                    (off / norm).sqrt()
                );
            }
        }
    }
}

/// How far a factor's solution is from solving, over the right-hand side.
fn error_of(system: &System) -> f64 {
    let size = 3 * system.pattern.particles.len();
    let mut factor = Factor::new(&system.pattern);
    let b = &right_hand_sides(size)[..size];
    let mut off: f64 = 0.0;
    // Twice: a factor must not depend on what its memory held before.
    for _ in 0..2 {
        factor.factorize(&system.pattern, &system.values).unwrap();
        let (mut x, mut product) = (b.to_vec(), vec![0.0; size]);
        factor.solve(&mut x, 1);
        system.multiply(&x, &mut product);
        off = off.max(product.iter().zip(b).map(|(p, b)| (p - b).abs()).fold(0.0, f64::max));
    }
    off
}

#[test]
fn factor_solves_graded_meshes_whose_parts_may_not_touch() {
    let mut random = Pcg64::seed_from_u64(3);
    let mut apart = 0;
    for _ in 0..60 {
        let mut grid = Grid::uniform([49, 45], [0.12, 0.11]);
        let sizes: Vec<usize> = (0..12 * 11).map(|_| 1 << random.random_range(0..3)).collect();
        for size in [2, 4] {
            let cells = (0..48).step_by(size).flat_map(|i| (0..44).step_by(size).map(move |j| [i, j]));
            let wanted = cells.filter(|[i, j]| sizes[i / 4 * 11 + j / 4] >= size);
            grid.edit_what_fits(wanted.map(|corner| Edit::Coarsen(Cell::square(corner, size))));
        }
        let system = system_on(&grid);
        let empty = system.pattern.regions.iter().filter(|r| r.ranks.is_empty()).count();
        if empty > 0 || apart == 0 {
            let error = error_of(&system);
            assert!(error < 1e-12, "{error}, {empty} empty separators");
        }
        apart += empty;
    }
    assert!(apart > 0, "no separator was empty");
}

#[test]
fn indefinite_and_undefined_matrices_are_refused() {
    for counts in [[2, 2], [3, 40], [31, 46]] {
        let system = random_system(counts);
        let pattern = &system.pattern;
        let mut factor = Factor::new(pattern);
        let size = 3 * counts[0] * counts[1];
        for column in [0, 1, size / 2, size - 1] {
            let diagonal = pattern.columns[column] as usize;
            for wrong in [-1.0, 0.0, f64::NAN, f64::INFINITY] {
                let mut values = system.values.clone();
                values[diagonal] = wrong;
                assert_eq!(
                    factor.factorize(pattern, &values),
                    Err(Indefinite),
                    "{counts:?} {column} {wrong}"
                );
            }
        }
        for column in [0, size / 3, size - 2] {
            let mut values = system.values.clone();
            values[pattern.columns[column] as usize + 1] = f64::NAN;
            assert_eq!(factor.factorize(pattern, &values), Err(Indefinite), "{counts:?} {column} below");
        }
        assert_eq!(factor.factorize(pattern, &system.values), Ok(()), "a refusal leaves no trace");
    }
}

#[test]
fn same_matrix_gives_the_same_bits_whatever_was_factored_before() {
    let counts = [31, 46];
    let system = random_system(counts);
    let solution = |factor: &mut Factor| {
        factor.factorize(&system.pattern, &system.values).unwrap();
        let mut x = right_hand_sides(3 * counts[0] * counts[1]);
        factor.solve(&mut x, COLUMNS);
        x.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    let first = solution(&mut Factor::new(&system.pattern));
    let mut used = Factor::new(&system.pattern);
    let undefined = vec![f64::NAN; system.values.len()];
    assert_eq!(used.factorize(&system.pattern, &undefined), Err(Indefinite));
    assert_eq!(solution(&mut used), first);
    assert_eq!(solution(&mut used), first);
}

/// Two codes, one answer.
#[test]
fn our_factor_solves_like_faers() {
    for shape in [[13, 9], [31, 46]] {
        let system = random_system(shape);
        let rhs = right_hand_sides(system.rhs.len() * 3);
        let [ours, faers] = [Method::Fronts, Method::Faer].map(|method| {
            let mut factor = Cholesky::new(&system.pattern, method);
            factor.factorize(&system.pattern, &system.values).unwrap();
            let mut x = rhs.clone();
            factor.solve(&mut x, COLUMNS);
            x
        });
        let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        let difference: Vec<f64> = ours.iter().zip(&faers).map(|(a, b)| a - b).collect();
        assert!(norm(&difference) < 1e-12 * norm(&ours), "{shape:?}");
    }
}
