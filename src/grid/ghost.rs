//! Ghosts: particles without degrees of freedom, slaved to active ones.
//!
//! What hangs in the middle of a larger cell's side has two of them. Membrane, shear, mass and contact see the *linear* one,
//! ½ (a + b) of the side's ends: constant strain is then exact across any jump of levels. Bending sees the *cubic* one, through
//! the active particles on the side's line, (−1 9 9 −1)/16 where they are even and (3 6 −1)/8 beside the border: linear ghosts
//! would turn half of a curvature into a spurious one across, cubic ones in the membrane would break constant strain.

use super::{Direction, Grid, Site, Status};
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
        1 << sides.filter(|level| site[1 - along].is_multiple_of(1 << level)).max().unwrap_or(0)
    }

    fn ends(&self, site: Site, along: Direction, size: usize) -> [Site; 2] {
        let low = site[along] - site[along] % size;
        [low, low + size].map(|k| moved_to(site, along, k))
    }

    /// Where the line through `site`, an active particle, goes next: the far end of the larger of the two sides there. `None` at
    /// the border of the sheet.
    pub(super) fn next(&self, site: Site, along: Direction, forward: bool) -> Option<Site> {
        let size = 1 << self.ahead(site, along, forward).into_iter().flatten().max()?;
        let to = if forward { site[along] + size } else { site[along] - size };
        Some(moved_to(site, along, to))
    }

    /// Levels of the two leaves beside the line through `site`, ahead of it.
    pub(super) fn ahead(&self, site: Site, along: Direction, forward: bool) -> [Option<u8>; 2] {
        let (around, side) = (self.around(site), usize::from(forward));
        if along == 0 { around[side] } else { [around[0][side], around[1][side]] }
    }

    /// The cubic through the particles on the line `along` at a site of that line, in terms of active particles: up to two on
    /// each side. Ends that hang themselves are replaced by their own masters.
    pub(super) fn cubic(&self, site: Site, along: Direction) -> Vec<(u32, f64)> {
        let size = self.side(site, along);
        let [low, high] = self.ends(site, along, size);
        let mut nodes = vec![low, high];
        for (end, forward) in [(low, false), (high, true)] {
            let beyond = if self.is_active(self.index(end)) { self.next(end, along, forward) } else { None };
            nodes.extend(beyond.filter(|&s| self.is_active(self.index(s))));
        }
        let mut masters: Vec<(u32, f64)> = Vec::with_capacity(4);
        let mut add = |node: usize, weight: f64| match masters.iter_mut().find(|m| m.0 == node as u32) {
            Some(master) => master.1 += weight,
            None => masters.push((node as u32, weight)),
        };
        for node in &nodes {
            let others = nodes.iter().filter(|other| *other != node);
            // Lagrange: rational numbers of small integers, so that weights of even lines are exact.
            let (mut over, mut under) = (1, 1);
            for other in others {
                over *= site[along] as i64 - other[along] as i64;
                under *= node[along] as i64 - other[along] as i64;
            }
            let weight = over as f64 / under as f64;
            match self.status(self.index(*node)) {
                Status::Hanging(line) => {
                    self.cubic(*node, line).into_iter().for_each(|(n, w)| add(n as usize, w * weight));
                }
                _ => add(self.index(*node), weight),
            }
        }
        masters
    }

    /// Interpolates positions, velocities or the like to the particles that are not active: cubic on the sides of cells,
    /// bilinear in between.
    pub fn interpolate(&self, x: &mut [Vec3]) {
        for n in 0..self.particles() {
            if let Status::Hanging(along) = self.status(n) {
                x[n] = self.linear(n, along).value(x);
            }
        }
        for cell in self.cells().iter().filter(|c| c.size > 1) {
            self.fill_cell(cell, x);
        }
    }

    /// Fills the absent particles of a cell: the lines between its corners, broken where particles hang, and bilinear inside.
    fn fill_cell(&self, cell: &super::Cell, x: &mut [Vec3]) {
        let corners = self.corners(cell).map(|n| x[n as usize]);
        let ([i, j], size) = (cell.corner, cell.size);
        for a in 0..=size {
            for b in 0..=size {
                let n = self.index([i + a, j + b]);
                if self.status(n) == Status::Absent {
                    let [u, v] = [a, b].map(|k| k as f64 / size as f64);
                    let [c00, c10, c01, c11] = corners;
                    x[n] = (c00 * (1.0 - u) + c10 * u) * (1.0 - v) + (c01 * (1.0 - u) + c11 * u) * v;
                }
            }
        }
    }
}

fn moved_to(site: Site, along: Direction, to: usize) -> Site {
    let mut site = site;
    site[along] = to;
    site
}
