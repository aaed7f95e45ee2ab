//! The order in which unknowns are eliminated: nested dissection of the mesh, as a tree of regions.
//!
//! A whole uniform lattice is cut geometrically, any other mesh through its graph: a separator is what of one side touches the other.

use super::pattern::Region;
use crate::grid::{Grid, Site};

/// Active particles in elimination order, and the tree of regions. `coupled` are the particles of each element.
pub fn dissection(grid: &Grid, coupled: &[&[u32]]) -> (Vec<u32>, Vec<Region>) {
    if grid.tally()[0] == grid.particles() { lattice(grid) } else { graph(grid, coupled) }
}

/// Lines of a lattice that bending stencils couple across.
const REACH: usize = 2;

/// Halves first, then the lines between them, as many as stencils reach far.
fn lattice(grid: &Grid) -> (Vec<u32>, Vec<Region>) {
    let order = Vec::with_capacity(grid.particles());
    let mut cuts = Cuts { lines: grid.counts[1], order, regions: Vec::new() };
    cuts.cut([0, 0], grid.counts);
    (cuts.order, cuts.regions)
}

/// Particles of a rectangle that is not cut again. From 9 to 20 the factor takes as long (no side below 5 is cut); 25 costs 10 %
/// more at 39 × 39 and at 77 × 77, 50 a half more at 39 × 39.
const LEAF: usize = 14;

struct Cuts {
    lines: usize,
    order: Vec<u32>,
    regions: Vec<Region>,
}

impl Cuts {
    /// Orders the particles of a rectangle; the number of its last region.
    fn cut(&mut self, from: Site, to: Site) -> u32 {
        let extent = [to[0] - from[0], to[1] - from[1]];
        let long = if extent[0] >= extent[1] { 0 } else { 1 };
        if extent[0] * extent[1] <= LEAF || extent[long] < 5 {
            return self.visit(from, to, &[]);
        }
        let middle = from[long] + (extent[long] - REACH) / 2;
        let (mut end, mut start) = (to, from);
        end[long] = middle;
        start[long] = middle + REACH;
        let halves = [self.cut(from, end), self.cut(start, to)];
        let (mut first, mut last) = (from, to);
        first[long] = middle;
        last[long] = middle + REACH;
        self.visit(first, last, &halves)
    }

    /// Makes a rectangle a region. Its short side runs fastest, so that a stretch of a separator is a stretch of ranks.
    fn visit(&mut self, from: Site, to: Site, children: &[u32]) -> u32 {
        let region = self.regions.len() as u32;
        let start = self.order.len() as u32;
        let short = if to[0] - from[0] < to[1] - from[1] { 0 } else { 1 };
        for a in from[1 - short]..to[1 - short] {
            for b in from[short]..to[short] {
                let [i, j] = if short == 1 { [a, b] } else { [b, a] };
                self.order.push((i * self.lines + j) as u32);
            }
        }
        for &child in children {
            self.regions[child as usize].parent = Some(region);
        }
        self.regions.push(Region { ranks: start..self.order.len() as u32, parent: None });
        region
    }
}

/// Cuts the graph of a mesh: at each cut the particles on the low side of a line are one half, those on its high side that touch
/// the low side the separator.
fn graph(grid: &Grid, coupled: &[&[u32]]) -> (Vec<u32>, Vec<Region>) {
    let sites = (0..grid.particles()).map(|n| grid.site(n)).collect();
    let mut cuts = GraphCuts {
        sites,
        neighbours: Neighbours::new(grid.particles(), coupled),
        side: vec![Side::Outside; grid.particles()],
        order: Vec::new(),
        regions: Vec::new(),
    };
    cuts.cut(grid.active().map(|n| n as u32).collect());
    (cuts.order, cuts.regions)
}

/// Neighbours in a graph, compressed by rows; repeated ones are left in.
struct Neighbours {
    starts: Vec<u32>,
    of: Vec<u32>,
}

impl Neighbours {
    fn new(particles: usize, coupled: &[&[u32]]) -> Neighbours {
        let mut starts = vec![0; particles + 1];
        for nodes in coupled {
            nodes.iter().for_each(|&n| starts[n as usize + 1] += nodes.len() as u32);
        }
        for n in 0..particles {
            starts[n + 1] += starts[n];
        }
        let (mut next, mut of) = (starts.clone(), vec![0; starts[particles] as usize]);
        for nodes in coupled {
            for &n in *nodes {
                let at = next[n as usize] as usize;
                of[at..at + nodes.len()].copy_from_slice(nodes);
                next[n as usize] += nodes.len() as u32;
            }
        }
        Neighbours { starts, of }
    }

    fn of(&self, n: u32) -> &[u32] {
        &self.of[self.starts[n as usize] as usize..self.starts[n as usize + 1] as usize]
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Side {
    Outside,
    Low,
    High,
}

struct GraphCuts {
    sites: Vec<Site>,
    neighbours: Neighbours,
    side: Vec<Side>,
    order: Vec<u32>,
    regions: Vec<Region>,
}

impl GraphCuts {
    /// Orders particles; the number of their last region.
    fn cut(&mut self, particles: Vec<u32>) -> u32 {
        let extent = |k: usize| {
            let along = particles.iter().map(|&n| self.sites[n as usize][k]);
            along.clone().max().unwrap_or(0) - along.min().unwrap_or(0)
        };
        let long = usize::from(extent(1) > extent(0));
        if particles.len() <= LEAF {
            return self.visit(particles, long, &[]);
        }
        let Some((low, separator, high)) = self.best_cut(&particles, long) else {
            return self.visit(particles, long, &[]);
        };
        let halves = [self.cut(low), self.cut(high)];
        self.visit(separator, long, &halves)
    }

    /// Of the lines near the middle the one with the smallest separator, as (low side, separator, high side).
    fn best_cut(&mut self, particles: &[u32], long: usize) -> Option<(Vec<u32>, Vec<u32>, Vec<u32>)> {
        let mut places: Vec<usize> = particles.iter().map(|&n| self.sites[n as usize][long]).collect();
        places.sort_unstable();
        let near = |share: f64| places[(places.len() as f64 * share) as usize];
        let mut lines: Vec<usize> = [0.35, 0.4, 0.45, 0.5, 0.55].map(near).to_vec();
        lines.dedup();
        let cuts = lines.into_iter().map(|line| self.cut_at(particles, long, line));
        let sound = cuts.filter(|(low, _, high)| !low.is_empty() && !high.is_empty());
        sound.min_by_key(|(low, separator, high)| 4 * separator.len() + low.len().abs_diff(high.len()) / 4)
    }

    fn cut_at(&mut self, particles: &[u32], long: usize, line: usize) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
        for &n in particles {
            self.side[n as usize] = if self.sites[n as usize][long] < line { Side::Low } else { Side::High };
        }
        let is_low = |n: &u32| self.side[*n as usize] == Side::Low;
        let (low, rest): (Vec<u32>, Vec<u32>) = particles.iter().partition(|n| is_low(n));
        let (separator, high) = rest.into_iter().partition(|&n| self.neighbours.of(n).iter().any(is_low));
        particles.iter().for_each(|&n| self.side[n as usize] = Side::Outside);
        (low, separator, high)
    }

    /// Makes particles a region, along its long side.
    fn visit(&mut self, mut particles: Vec<u32>, long: usize, children: &[u32]) -> u32 {
        let region = self.regions.len() as u32;
        let start = self.order.len() as u32;
        let separates = !children.is_empty();
        // A separator is long across the cut.
        let fast = if separates { long } else { 1 - long };
        particles.sort_unstable_by_key(|&n| (self.sites[n as usize][1 - fast], self.sites[n as usize][fast]));
        self.order.append(&mut particles);
        for &child in children {
            self.regions[child as usize].parent = Some(region);
        }
        self.regions.push(Region { ranks: start..self.order.len() as u32, parent: None });
        region
    }
}
