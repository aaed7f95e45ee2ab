//! From a level to the next coarser one and back.

use super::{
    coarsen::Masters,
    halved::Halved,
    matrix::{Matrix, Node, fused},
};
use pulp::Simd;

/// How a level hangs together with the next coarser one.
pub struct Transfer {
    /// Masters of each row, and the rows that follow each master.
    masters: Lists,
    followers: Lists,
    /// The same of a whole lattice, where nothing need be looked up.
    pub halved: Option<Halved>,
}

impl Transfer {
    /// From a matrix and masters of its rows, line by line if they are a whole lattice with so many lines; and the next coarser matrix, empty,
    /// in halves from so many rows on.
    pub fn new(
        matrix: &Matrix,
        masters: Vec<Masters>,
        lattice: Option<[usize; 2]>,
        fewest: usize,
    ) -> (Transfer, Matrix) {
        let coarse = masters.iter().flatten().map(|m| m.0 as usize + 1).max().unwrap_or(0);
        let mut columns: Vec<Vec<u32>> = (0..coarse as u32).map(|c| vec![c]).collect();
        for row in 0..matrix.len() {
            for &column in &matrix.columns[matrix.row(row)] {
                for &(a, _) in &masters[row] {
                    for &(b, _) in &masters[column as usize] {
                        if !columns[a as usize].contains(&b) {
                            columns[a as usize].push(b);
                        }
                    }
                }
            }
        }
        let mut followers = vec![Vec::new(); coarse];
        for (masters, row) in masters.iter().zip(0..) {
            masters.iter().for_each(|&(master, weight)| followers[master as usize].push((row, weight)));
        }
        let halved = lattice.and_then(|lattice| Halved::new(lattice, &masters));
        let transfer = Transfer { masters: Lists::new(&masters), followers: Lists::new(&followers), halved };
        let is_parted = columns.len() >= fewest;
        (transfer, Matrix::new(columns, is_parted))
    }

    /// A row's masters and their weights.
    pub fn masters(&self, row: usize) -> &[(u32, f32)] {
        self.masters.list(row)
    }

    /// What rows weigh on masters, of which this is the first.
    #[inline(always)]
    pub fn restrict<S: Simd>(&self, from: &[Node], to: &mut [Node], first: usize) {
        if let Some(halved) = &self.halved {
            return halved.restrict(from, to, first);
        }
        for (n, to) in to.iter_mut().enumerate() {
            *to = self.followers.sum::<S>(
                first + n,
                #[inline(always)]
                |row| from[row],
            );
        }
    }

    /// What a row follows of its masters.
    #[inline(always)]
    pub fn followed<S: Simd>(&self, row: usize, from: impl Fn(usize) -> Node) -> Node {
        self.masters.sum::<S>(row, from)
    }
}

/// A list of numbers with weights for each of many.
struct Lists {
    starts: Vec<u32>,
    entries: Vec<(u32, f32)>,
}

impl Lists {
    fn new(lists: &[Vec<(u32, f32)>]) -> Lists {
        let ends = lists.iter().scan(0, |end, list| {
            *end += list.len() as u32;
            Some(*end)
        });
        Lists { starts: std::iter::once(0).chain(ends).collect(), entries: lists.concat() }
    }

    #[inline(always)]
    fn list(&self, list: usize) -> &[(u32, f32)] {
        &self.entries[self.starts[list] as usize..self.starts[list + 1] as usize]
    }

    /// Weighted sum over a list.
    #[inline(always)]
    fn sum<S: Simd>(&self, list: usize, of: impl Fn(usize) -> Node) -> Node {
        let mut sum = [0.0; 4];
        for &(n, weight) in self.list(list) {
            let node = of(n as usize);
            for k in 0..4 {
                sum[k] = fused::<S>(node[k], weight, sum[k]);
            }
        }
        sum
    }
}
