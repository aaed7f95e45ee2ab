//! The few particles that an obstacle ties together: eliminated exactly, the V-cycle answers for the rest.
//!
//! A corner that pokes into the cloth, or an edge, couples the particles of the piece that it meets by thousands of times what cloth does.
//! One of them alone hardly moves then; together they move freely across the push. Smoothing particle by particle does not see that, nor
//! do coarser levels. With A parted into the patch p and the others o, and V the V-cycle, the preconditioner is
//!
//! z_o = V (r_o − A_op A_pp⁻¹ r_p), z_p = A_pp⁻¹ (r_p − A_po z_o),
//!
//! which is symmetric and positive definite where V and A_pp are: the block factorization of A with V for the inverse of its Schur complement.

use crate::potential::system::System;

/// Sum of a diagonal block's diagonal, and size of a block beside it, over the sheet's usual sum, from which on a particle counts.
const STIFFER: f64 = 2.0;
const TIE: f64 = 1.0;
/// Particles at the most: the stiffest.
const MOST: usize = 24;
/// Diagonal blocks that tell the usual stiffness, or up to twice as many.
const SAMPLES: usize = 64;
/// Pivots, over the diagonal, below which a matrix counts as singular.
const LEAST: f64 = 1e-12;
/// Not in the patch.
const NONE: u8 = u8::MAX;

/// The particles, and the factor of their part of the matrix.
pub struct Patch {
    /// Their places in the pattern's order.
    places: Vec<u32>,
    /// Where each place of the pattern lies among them.
    among: Vec<u8>,
    /// The lower factor of A_pp row by row, its diagonal inverted [√(m/N)].
    factor: Vec<f64>,
    /// A_po, and the places that it names.
    ties: Vec<Tie>,
    others: Vec<u32>,
    /// The residual before a V-cycle there, and in the patch [N].
    kept: Vec<f64>,
    own: Vec<f64>,
    /// What is solved for in place.
    y: Vec<f64>,
    samples: Vec<f64>,
    found: Vec<(f64, u32)>,
}

/// What couples a particle of the patch to one outside: the block in the former's row [N/m].
struct Tie {
    inner: usize,
    outer: usize,
    block: [f64; 9],
}

impl Patch {
    /// Memory for a mesh of so many particles with so many neighbours at the most.
    pub fn new(particles: usize, neighbours: usize) -> Patch {
        Patch {
            places: Vec::with_capacity(MOST),
            among: vec![NONE; particles],
            factor: vec![0.0; (3 * MOST).pow(2)],
            ties: Vec::with_capacity(MOST * neighbours),
            others: Vec::with_capacity(MOST * neighbours),
            kept: Vec::with_capacity(3 * MOST * neighbours),
            own: Vec::with_capacity(3 * MOST),
            y: Vec::with_capacity(3 * MOST),
            samples: Vec::with_capacity(2 * SAMPLES),
            found: Vec::with_capacity(particles),
        }
    }

    /// Finds the particles in a closed system, and factors. A part that is not positive definite is left to the V-cycle.
    pub fn set(&mut self, system: &System) {
        self.find(system);
        self.gather(system);
        if !self.factorize() {
            self.places.drain(..).for_each(|place| self.among[place as usize] = NONE);
            self.ties.clear();
            self.others.clear();
        }
    }

    /// One that is stiff alone is solved for as it is smoothed; fixed ones, tied to nothing in a closed system, never count.
    fn find(&mut self, system: &System) {
        let Patch { places, among, samples, found, .. } = self;
        places.drain(..).for_each(|place| among[place as usize] = NONE);
        let (pattern, count) = (&system.pattern, among.len());
        let [a, b, c] = [0, 4, 8].map(|k| &system.blocks[k * pattern.lines.stride..][..count]);
        let stiffness = |place: usize| a[place] + b[place] + c[place];
        samples.clear();
        samples.extend((0..count).step_by((count / SAMPLES).max(1)).map(stiffness));
        let middle = samples.len() / 2;
        let usual = *samples.select_nth_unstable_by(middle, f64::total_cmp).1;
        let is_tied = |place: usize| {
            pattern.neighbours(place).iter().any(|(_, slot)| {
                let entries = slot.entries(pattern.lines.stride);
                entries.iter().map(|&at| system.blocks[at as usize].powi(2)).sum::<f64>()
                    > (TIE * usual).powi(2)
            })
        };
        let stiff = (0..count).filter(|&place| stiffness(place) > STIFFER * usual);
        found.clear();
        found.extend(stiff.filter(|&place| is_tied(place)).map(|place| (stiffness(place), place as u32)));
        if found.len() > MOST {
            found.select_nth_unstable_by(MOST, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            found.truncate(MOST);
        }
        places.extend(found.iter().map(|f| f.1));
        places.sort_unstable();
        places.iter().zip(0..).for_each(|(&place, k)| among[place as usize] = k);
    }

    /// The lower triangle of A_pp, and A_po.
    fn gather(&mut self, system: &System) {
        let (pattern, size) = (&system.pattern, 3 * self.places.len());
        self.factor[..size * size].fill(0.0);
        self.ties.clear();
        self.others.clear();
        for (k, &place) in self.places.iter().enumerate() {
            for (e, at) in pattern.diagonal_entries(place as usize).into_iter().enumerate() {
                self.factor[(3 * k + e / 3) * size + 3 * k + e % 3] = system.blocks[at as usize];
            }
            for &(n, slot) in pattern.neighbours(place as usize) {
                // In the neighbour's row.
                let block = slot.entries(pattern.lines.stride).map(|at| system.blocks[at as usize]);
                let outer = pattern.place[n as usize];
                let other = usize::from(self.among[outer as usize]);
                if other == usize::from(NONE) {
                    let block = std::array::from_fn(|e| block[3 * (e % 3) + e / 3]);
                    self.ties.push(Tie { inner: k, outer: outer as usize, block });
                    self.others.push(outer);
                } else if other > k {
                    for (e, value) in block.into_iter().enumerate() {
                        self.factor[(3 * other + e / 3) * size + 3 * k + e % 3] = value;
                    }
                }
            }
        }
        self.others.sort_unstable();
        self.others.dedup();
    }

    /// Cholesky; false where that fails.
    fn factorize(&mut self) -> bool {
        let size = 3 * self.places.len();
        for row in 0..size {
            let (above, rest) = self.factor.split_at_mut(row * size);
            let line = &mut rest[..size];
            for column in 0..row {
                let other = &above[column * size..][..size];
                let sum: f64 = line[..column].iter().zip(other).map(|(a, b)| a * b).sum();
                line[column] = (line[column] - sum) * other[column];
            }
            let pivot = line[row] - line[..row].iter().map(|a| a * a).sum::<f64>();
            if pivot <= LEAST * line[row] || pivot.is_nan() {
                return false;
            }
            line[row] = 1.0 / pivot.sqrt();
        }
        true
    }

    /// Before a V-cycle: makes a residual `r`, in planes of this length, what the patch's answer to it leaves.
    pub fn enter(&mut self, plane: usize, r: &mut [f64]) {
        let Patch { places, others, kept, own, .. } = self;
        for (places, values) in [(places, own), (others, kept)] {
            values.clear();
            values.extend(numbers(places, plane).map(|at| r[at]));
        }
        self.y.clone_from(&self.own);
        self.solve();
        for Tie { inner, outer, block } in &self.ties {
            for c in 0..3 {
                let pull: f64 = (0..3).map(|e| block[3 * e + c] * self.y[3 * inner + e]).sum();
                r[c * plane + outer] -= pull;
            }
        }
        numbers(&self.places, plane).for_each(|at| r[at] = 0.0);
    }

    /// After it: puts the residual back, and into `z` the patch's answer to what the V-cycle's leaves there.
    pub fn leave(&mut self, plane: usize, r: &mut [f64], z: &mut [f32]) {
        for (places, values) in [(&self.places, &self.own), (&self.others, &self.kept)] {
            numbers(places, plane).zip(values).for_each(|(at, value)| r[at] = *value);
        }
        self.y.clone_from(&self.own);
        for Tie { inner, outer, block } in &self.ties {
            for e in 0..3 {
                let pull: f64 = (0..3).map(|c| block[3 * e + c] * f64::from(z[c * plane + outer])).sum();
                self.y[3 * inner + e] -= pull;
            }
        }
        self.solve();
        numbers(&self.places, plane).zip(&self.y).for_each(|(at, y)| z[at] = *y as f32);
    }

    /// y = A_pp⁻¹ y.
    fn solve(&mut self) {
        let (y, size) = (&mut self.y[..], 3 * self.places.len());
        for row in 0..size {
            let line = &self.factor[row * size..][..size];
            let sum: f64 = line[..row].iter().zip(&*y).map(|(a, y)| a * y).sum();
            y[row] = (y[row] - sum) * line[row];
        }
        for row in (0..size).rev() {
            let line = &self.factor[row * size..][..size];
            y[row] *= line[row];
            let x = y[row];
            y[..row].iter_mut().zip(line).for_each(|(y, a)| *y -= a * x);
        }
    }
}

/// Where the numbers of these places lie in planes of this length.
fn numbers(places: &[u32], plane: usize) -> impl Iterator<Item = usize> {
    places.iter().flat_map(move |&place| (0..3).map(move |c| c * plane + place as usize))
}
