//! Ghosts: particles without degrees of freedom, slaved to active ones.
//!
//! What hangs in the middle of a larger cell's side has two of them. Membrane, shear, mass and contact see the *linear* one,
//! ½ (a + b) of the side's ends: constant strain is then exact across any jump of levels. Bending sees the *cubic* one, through
//! the active particles on the side's line, (−1 9 9 −1)/16 where they are even and (3 6 −1)/8 beside the border: linear ghosts
//! would turn half of a curvature into a spurious one across, cubic ones in the membrane would break constant strain. The outer
//! particles lie as far beyond the side as it is long, over a nearer one where cells are finer there: that one would have a weight of
//! −1/5, and a force out of balance by as much of Bκ where it ends a side of two cells that bend.

use super::{Cell, Direction, Grid, Levels, Site, Status};
use crate::math::Vec3;

/// A node slaved to active particles: x = Σ w·x_master, Σ w = 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Ghost {
    /// Its index: of the lattice for a linear ghost, beyond the lattice for a cubic one.
    pub node: u32,
    /// Active particles and their weights.
    pub masters: Vec<(u32, f64)>,
}

impl Ghost {
    /// Its value where its masters have these.
    pub fn value(&self, x: &[Vec3]) -> Vec3 {
        self.masters.iter().map(|&(n, w)| x[n as usize] * w).sum()
    }
}

impl Grid {
    /// The linear ghost of a hanging particle.
    pub(super) fn linear(&self, index: usize, along: Direction) -> Ghost {
        let size = self.side(self.site(index), along);
        let [a, b] = self.ends(self.site(index), along, size).map(|end| self.index(end) as u32);
        Ghost { node: index as u32, masters: vec![(a, 0.5), (b, 0.5)] }
    }

    /// Size of the largest leaf with a side along `along` through a site.
    fn side(&self, site: Site, along: Direction) -> usize {
        let sides = self.around(site).into_iter().flatten().flatten();
        let beside = sides.filter(|levels| site[1 - along].is_multiple_of(1 << levels[1 - along]));
        1 << beside.map(|levels| levels[along]).max().unwrap_or(0)
    }

    fn ends(&self, site: Site, along: Direction, size: usize) -> [Site; 2] {
        let low = site[along] - site[along] % size;
        [low, low + size].map(|k| moved_to(site, along, k))
    }

    /// Where the line through `site`, an active particle, goes next: the far end of the larger of the two sides there. `None` at
    /// the border of the sheet.
    pub(super) fn next(&self, site: Site, along: Direction, forward: bool) -> Option<Site> {
        let sides = self.ahead(site, along, forward).into_iter().flatten();
        onward(site, along, forward, 1 << sides.map(|levels| levels[along]).max()?)
    }

    /// Levels of the two leaves beside the line through `site`, ahead of it.
    pub(super) fn ahead(&self, site: Site, along: Direction, forward: bool) -> [Option<Levels>; 2] {
        let (around, side) = (self.around(site), usize::from(forward));
        if along == 0 { around[side] } else { [around[0][side], around[1][side]] }
    }

    /// The cubic through the particles on the line `along` at a site of that line, in terms of active particles: up to two on
    /// each side. Ends that hang themselves are replaced by their own masters.
    pub(super) fn cubic(&self, site: Site, along: Direction) -> Vec<(u32, f64)> {
        self.line(site, along, true)
    }

    /// The same; where nothing active stands beyond either end, what follows there from lines across, if that `may` be.
    fn line(&self, site: Site, along: Direction, may: bool) -> Vec<(u32, f64)> {
        let size = self.side(site, along);
        let [low, high] = self.ends(site, along, size);
        let mut nodes = vec![low, high];
        let ends = || [(low, false), (high, true)].into_iter();
        nodes.extend(ends().filter_map(|(end, forward)| self.outer(end, along, forward, size)));
        if nodes.len() == 2 && may {
            // A straight line would turn half of a curvature along it into one across.
            nodes.extend(ends().filter_map(|(end, forward)| self.across(end, along, forward, size)));
        }
        let mut masters = Sum::default();
        for node in &nodes {
            let others = nodes.iter().filter(|other| *other != node);
            // Lagrange: rational numbers of small integers, so that weights of even lines are exact.
            let (mut over, mut under) = (1, 1);
            for other in others {
                over *= site[along] as i64 - other[along] as i64;
                under *= node[along] as i64 - other[along] as i64;
            }
            let weight = over as f64 / under as f64;
            let line = match self.status(self.index(*node)) {
                Status::Active => {
                    masters.add(self.index(*node) as u32, weight);
                    continue;
                }
                Status::Hanging(line) => line,
                Status::Absent => 1 - along,
            };
            let is_end = [low, high].contains(node);
            self.line(*node, line, may && is_end).into_iter().for_each(|(n, w)| masters.add(n, w * weight));
        }
        masters.0
    }

    /// The place on a line beyond the end of a side of this size, as far away as the side is long, where it lies on a line across.
    fn across(&self, end: Site, along: Direction, forward: bool, size: usize) -> Option<Site> {
        let site = onward(end, along, forward, size).filter(|&site| self.contains(site))?;
        let mut around = self.around(site).into_iter().flatten().flatten();
        let is_on_line = around.any(|levels| site[along].is_multiple_of(1 << levels[along]));
        (is_on_line && self.status(self.index(site)) != Status::Hanging(along)).then_some(site)
    }

    /// The active particle on a line beyond the end of a side of this size: as far away as the side is long, else the next one.
    fn outer(&self, end: Site, along: Direction, forward: bool, size: usize) -> Option<Site> {
        let active = |site: &Site| self.contains(*site) && self.is_active(self.index(*site));
        let even = onward(end, along, forward, size).filter(active);
        let next = || self.next(end, along, forward).filter(active);
        if active(&end) { even.or_else(next) } else { None }
    }

    /// Any particle of the sheet as a weighted sum of active ones; the weights sum to one.
    pub fn masters(&self, index: usize, kind: Interpolation) -> Vec<(u32, f64)> {
        let mut sum = Sum::default();
        match (self.status(index), kind) {
            (Status::Active, _) => sum.add(index as u32, 1.0),
            (Status::Hanging(along), Interpolation::Linear) => return self.linear(index, along).masters,
            (Status::Hanging(along), Interpolation::Cubic) => return self.cubic(self.site(index), along),
            (Status::Absent, _) if self.is_cut_away(index) => {}
            (Status::Absent, _) => self.patch(self.site(index), kind, &mut sum),
        }
        sum.0
    }

    /// The Coons patch of a cell over its sides: what joins them at a particle inside.
    fn patch(&self, site: Site, kind: Interpolation, sum: &mut Sum) {
        let cell = self.leaf_at(site);
        let part = |k: usize| (site[k] - cell.corner[k]) as f64 / cell.size[k] as f64;
        let (u, v) = (part(0), part(1));
        let sides = [1.0 - u, u, 1.0 - v, v];
        let ends = [0, 1].map(|k| [cell.corner[k], cell.end()[k]]);
        if kind == Interpolation::Cubic {
            for (n, &weight) in sides.iter().enumerate().filter(|(_, w)| **w != 0.0) {
                // The point beside `site` on a side; the side across i runs along j.
                let across = n / 2;
                let beside = moved_to(site, across, ends[across][n % 2]);
                let on_side = if self.is_active(self.index(beside)) {
                    vec![(self.index(beside) as u32, 1.0)]
                } else {
                    self.cubic(beside, 1 - across)
                };
                on_side.into_iter().for_each(|(n, w)| sum.add(n, w * weight));
            }
        }
        let sign = if kind == Interpolation::Cubic { -1.0 } else { 1.0 };
        for (a, wa) in [1.0 - u, u].into_iter().enumerate() {
            for (b, wb) in [1.0 - v, v].into_iter().enumerate().filter(|(_, wb)| wa * wb != 0.0) {
                let corner = self.index([ends[0][a], ends[1][b]]);
                self.masters(corner, kind).into_iter().for_each(|(n, w)| sum.add(n, sign * wa * wb * w));
            }
        }
    }

    /// The leaf that a particle lies in or on.
    fn leaf_at(&self, site: Site) -> Cell {
        let last = [0, 1].map(|k| site[k].min(self.counts[k] - 2));
        self.leaf(last)
    }

    /// Interpolates positions, velocities or the like from the active particles to all others.
    pub fn interpolate(&self, x: &mut [Vec3], kind: Interpolation) {
        for n in 0..self.particles() {
            if !self.is_active(n) && !self.is_cut_away(n) {
                let masters = self.masters(n, kind);
                x[n] = masters.into_iter().map(|(n, w)| x[n as usize] * w).sum();
            }
        }
    }
}

/// How particles that are not active follow from those that are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Linear on the sides of cells, bilinear between them: what mass and membrane see, so it keeps momentum.
    Linear,
    /// Cubic on the lines, Coons' patch between them: what bending sees, so it keeps curvature.
    Cubic,
}

/// A weighted sum of particles.
#[derive(Default)]
struct Sum(Vec<(u32, f64)>);

impl Sum {
    fn add(&mut self, node: u32, weight: f64) {
        match self.0.iter_mut().find(|m| m.0 == node) {
            Some(master) => master.1 += weight,
            None => self.0.push((node, weight)),
        }
    }
}

/// The place so many intervals further along a line, if not before its start.
pub(super) fn onward(site: Site, along: Direction, forward: bool, intervals: usize) -> Option<Site> {
    let to = if forward { site[along] + intervals } else { site[along].checked_sub(intervals)? };
    Some(moved_to(site, along, to))
}

fn moved_to(site: Site, along: Direction, to: usize) -> Site {
    let mut site = site;
    site[along] = to;
    site
}
