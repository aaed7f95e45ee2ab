//! From a whole lattice to every second of its lines and the last, both ways, and back: line by line, so that nothing is looked up.

use super::{coarsen::Masters, matrix::Node};
use std::ops::Range;

/// A lattice whose particles stand line by line, and the coarser one.
#[derive(Clone, Copy, Debug)]
pub struct Halved {
    /// Lines, and places on a line.
    fine: [usize; 2],
    /// The same of the coarser one.
    pub coarse: [usize; 2],
}

/// Kept places that are looked at together.
const AT_ONCE: usize = 16;
/// Share of a line or place that is not kept in what each of its neighbours gets.
const HALF: f32 = 0.5;

impl Halved {
    /// If masters are as they would be.
    pub fn new(fine: [usize; 2], masters: &[Masters]) -> Option<Halved> {
        let halved = Halved { fine, coarse: fine.map(|lines| lines / 2 + 1) };
        // Weights of a row come to one, so none is left out where each is right.
        let is_right = |row: usize, &(master, weight): &(u32, f32)| {
            let told = halved.masters(row).into_iter().filter(|&own| own == master as usize).count();
            weight == 0.25 * told as f32
        };
        let mut rows = masters.iter().enumerate();
        let are_so = rows.all(|(row, masters)| masters.iter().all(|master| is_right(row, master)));
        (masters.len() == fine[0] * fine[1] && are_so).then_some(halved)
    }

    /// Masters of a row; where there are fewer than four some are told more than once, each as often.
    fn masters(&self, row: usize) -> [usize; 4] {
        let [lines, step] = self.fine;
        let ([a, b], [c, d]) = (around(lines, row / step), around(step, row % step));
        [(a, c), (a, d), (b, c), (b, d)].map(|(line, place)| line * self.coarse[1] + place)
    }

    /// What rows weigh on masters, of which this is the first.
    #[inline(always)]
    pub fn restrict(&self, from: &[Node], to: &mut [Node], first: usize) {
        let [step, coarse] = [self.fine[1], self.coarse[1]];
        for (line, places, begin) in lines(coarse, first..first + to.len()) {
            let [own, low, high] =
                weighs(self.fine[0], line).map(|(line, weight)| (&from[line * step..][..step], weight));
            for first in places.clone().step_by(AT_ONCE) {
                let kept = AT_ONCE.min(places.end - first);
                // From the place before the first kept one to that behind the last.
                let mut across = [[0.0; 4]; 2 * AT_ONCE + 2];
                let begins = (2 * first).saturating_sub(1);
                let ends = (2 * (first + kept)).min(step);
                let skipped = begins + 1 - 2 * first;
                let [a, b, c] = [own, low, high].map(|(line, _)| line[begins..ends].as_flattened());
                let sums = across[skipped..][..ends - begins].as_flattened_mut();
                for (sum, (a, (b, c))) in sums.iter_mut().zip(a.iter().zip(b.iter().zip(c))) {
                    *sum = a + low.1 * b + high.1 * c;
                }
                if step.is_multiple_of(2) && ends == step {
                    // The last of an even number is kept, right behind the one before.
                    across[skipped + ends - begins] =
                        std::mem::take(&mut across[skipped + ends - begins - 1]);
                }
                let to = &mut to[begin + first - places.start..][..kept];
                for (to, across) in to.iter_mut().zip(across.windows(3).step_by(2)) {
                    *to = std::array::from_fn(|k| across[1][k] + HALF * (across[0][k] + across[2][k]));
                }
            }
        }
    }

    /// Adds to some rows of a vector in planes what they follow of their masters, times a share of each row.
    #[inline(always)]
    pub fn follow(
        &self,
        rows: Range<usize>,
        from: impl Fn(usize) -> Node,
        shares: &[f32],
        to: &mut [&mut [f32]; 3],
    ) {
        let [step, coarse] = [self.fine[1], self.coarse[1]];
        for (line, places, begin) in lines(step, rows) {
            let [low, high] = around(self.fine[0], line).map(|line| line * coarse);
            // From an even place on, as many as registers hold.
            for first in (places.start / 2 * 2..places.end).step_by(2 * AT_ONCE) {
                let mut across = [[0.0; AT_ONCE + 1]; 3];
                for k in 0..=AT_ONCE {
                    // Beyond the last place all is as there: it is kept even where its number is odd.
                    let place = (first / 2 + k).min(coarse - 1);
                    let node = mean(from(low + place), from(high + place));
                    (0..3).for_each(|n| across[n][k] = node[n]);
                }
                let mut along = [[0.0; 2 * AT_ONCE]; 3];
                for (along, across) in along.iter_mut().zip(&across) {
                    for k in 0..AT_ONCE {
                        along[2 * k] = across[k];
                        along[2 * k + 1] = HALF * (across[k] + across[k + 1]);
                    }
                    // The last of an even number is kept.
                    if step.is_multiple_of(2) && step - first <= 2 * AT_ONCE {
                        along[step - first - 1] = across[(step - first) / 2];
                    }
                }
                let skipped = places.start.saturating_sub(first);
                let taken = skipped..(places.end - first).min(2 * AT_ONCE);
                let at = begin + first + skipped - places.start;
                let shares = &shares[at..at + taken.len()];
                for (to, along) in to.iter_mut().zip(&along) {
                    let to = &mut to[at..at + taken.len()];
                    for ((to, along), share) in to.iter_mut().zip(&along[taken.clone()]).zip(shares) {
                        *to += share * along;
                    }
                }
            }
        }
    }
}

/// The kept lines about one of so many: twice the same where it is kept.
#[inline(always)]
fn around(lines: usize, line: usize) -> [usize; 2] {
    let is_last = line + 1 == lines;
    [line / 2 + usize::from(is_last && line % 2 == 1), line.div_ceil(2)]
}

/// The finer lines, of so many, that weigh on a kept one, and how much: its own first.
#[inline(always)]
fn weighs(lines: usize, kept: usize) -> [(usize, f32); 3] {
    let own = (2 * kept).min(lines - 1);
    // Of the kept lines the last may come right behind the one before.
    let low = if own > 0 && own.is_multiple_of(2) { (own - 1, HALF) } else { (own, 0.0) };
    let high = if own + 2 < lines { (own + 1, HALF) } else { (own, 0.0) };
    [(own, 1.0), low, high]
}

/// Lines of so many places that some rows stand on: which, at which places, and where the rows of each begin among these.
#[inline(always)]
fn lines(step: usize, rows: Range<usize>) -> impl Iterator<Item = (usize, Range<usize>, usize)> {
    let line_of = move |line: usize| {
        let first = rows.start.max(line * step);
        let end = rows.end.min((line + 1) * step);
        (line, first - line * step..end - line * step, first - rows.start)
    };
    let (first, end) = (rows.start / step, rows.end.div_ceil(step));
    (first..end).map(line_of)
}

#[inline(always)]
fn mean(a: Node, b: Node) -> Node {
    std::array::from_fn(|k| HALF * (a[k] + b[k]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::minimize::multigrid::coarsen::coarsen;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn line_by_line_is_as_by_lists_wherever_halves_part() {
        let mut rng = Pcg64Mcg::seed_from_u64(8);
        for counts in [[7, 9], [8, 6], [5, 66], [6, 77], [40, 33], [3, 64]] {
            let sites = (0..counts[0] * counts[1]).map(|n| [n / counts[1], n % counts[1]]).collect();
            let masters = coarsen(sites).swap_remove(0);
            let halved = Halved::new(counts, &masters).expect("a whole lattice");
            let (fine, coarse) = (masters.len(), halved.coarse[0] * halved.coarse[1]);
            let mut node = || -> Node { std::array::from_fn(|_| rng.random_range(-1.0..1.0)) };
            let [up, down]: [Vec<Node>; 2] = [fine, coarse].map(|n| (0..n).map(|_| node()).collect());
            let mut weighed = vec![[0.0; 4]; coarse];
            let mut followed = vec![[0.0; 4]; fine];
            for (row, masters) in masters.iter().enumerate() {
                for &(master, weight) in masters {
                    for k in 0..4 {
                        weighed[master as usize][k] += weight * up[row][k];
                        followed[row][k] += weight * down[master as usize][k];
                    }
                }
            }
            for parts in [1, 2, 5] {
                let mut to = vec![[0.0; 4]; coarse];
                for (part, to) in to.chunks_mut(coarse.div_ceil(parts)).enumerate() {
                    halved.restrict(&up, to, part * coarse.div_ceil(parts));
                }
                let off = |a: &[Node], b: &[Node]| {
                    let pairs = a.as_flattened().iter().zip(b.as_flattened());
                    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
                };
                assert!(off(&to, &weighed) < 1e-6, "{counts:?}");
                let mut planes = [(); 3].map(|_| vec![1.0; fine]);
                let shares: Vec<f32> = (0..fine).map(|row| f32::from(u8::from(row % 7 != 3))).collect();
                for first in (0..fine).step_by(fine.div_ceil(parts)) {
                    let rows = first..fine.min(first + fine.div_ceil(parts));
                    let mut to = planes.each_mut().map(|plane| &mut plane[rows.clone()]);
                    halved.follow(rows.clone(), |n| down[n], &shares[rows], &mut to);
                }
                for (row, share) in shares.iter().enumerate() {
                    for k in 0..3 {
                        let expected = 1.0 + share * followed[row][k];
                        assert!((planes[k][row] - expected).abs() < 1e-6, "{counts:?} {row}");
                    }
                }
            }
        }
        let sites = (0..40 * 40).map(|n| [n / 40, n % 40]).filter(|site| site[0] + site[1] < 70).collect();
        assert!(Halved::new([40, 40], &coarsen(sites)[0]).is_none(), "some are cut away");
    }
}
