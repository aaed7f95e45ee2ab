//! The elements that cells own: edges, bending triples, shear cells, areas; and the ghosts they name.
//!
//! Every leaf gives its four sides as edges with half its size as tributary width, one shear element, and a quarter of its area to
//! each corner, less in proportion where a cut takes part of it; what falls to a hanging particle goes to its two masters. Triples follow the lines:
//!
//! - an active particle has one in each direction in which two sides meet; each arm is the larger of the two sides there;
//! - a hanging particle has one across the larger cell's side and none along it; its arm into that cell ends in the middle of the
//!   opposite side;
//! - its area is half of both arms times, summed over both transverse sides, half of the smaller cell on that side; where a cell is
//!   half as long as the arm, what follows it counts from its end on. So triples cover the sheet once, but for half cells at its border.
//!
//! Elements measure from a `rest` of their own: 0, unless they stand for finer ones that a change of the mesh merged (`adapt::Transfer`).

use super::{Direction, Ghost, Grid, Levels, Site, Status, ghost::onward};
use crate::math::Vec3;
use std::collections::BTreeMap;

/// A stretch element between two neighbours on a warp or weft line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Node indices, in rising i or j.
    pub nodes: [u32; 2],
    /// Line it lies on.
    pub direction: Direction,
    /// Rest length [m].
    pub length: f64,
    /// Tributary width [m].
    pub width: f64,
    /// Strain that counts as none [1].
    pub rest: f64,
}

/// A bending element: three neighbours on one line and the transverse neighbours that span the sheet at the centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triple {
    /// Node indices: previous, centre, next, transverse previous, transverse next (the centre where the sheet ends).
    pub nodes: [u32; 5],
    /// Place of its centre in the lattice.
    pub site: u32,
    /// Line it lies on.
    pub direction: Direction,
    /// Rest lengths of its arms before and after the centre [m].
    pub lengths: [f64; 2],
    /// Rest length [m] between the transverse neighbours.
    pub span: f64,
    /// Length that bends [m]: half of both rest lengths, a clamped one counting nothing.
    pub reach: f64,
    /// Tributary area [m²].
    pub area: f64,
    /// Curvature that counts as none [1/m].
    pub rest: f64,
}

/// A shear and twist element: the corners (0,0), (1,0), (0,1), (1,1) of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shear {
    /// Node indices.
    pub nodes: [u32; 4],
    /// The same as bending sees them: cubic ghosts instead of linear ones.
    pub bent: [u32; 4],
    /// Rest lengths of its sides along warp and weft [m].
    pub lengths: [f64; 2],
    /// Tributary area [m²].
    pub area: f64,
    /// Angle that counts as none [rad].
    pub rest: f64,
}

/// All elements of a mesh, in a fixed order: those that name active particles alone come first.
#[derive(Clone, Debug, Default)]
pub struct Elements {
    /// Stretch elements.
    pub edges: Vec<Edge>,
    /// Bending elements.
    pub triples: Vec<Triple>,
    /// Shear elements.
    pub shears: Vec<Shear>,
    /// How many edges, triples and shears name no ghost.
    pub regular: [usize; 3],
    /// Tributary area of each node [m²]; ghosts and absent particles have none, and the sum is the sheet's area.
    pub areas: Vec<f64>,
    /// Slaves: hanging particles, then the cubic ghosts of bending, whose nodes lie beyond the lattice.
    pub ghosts: Vec<Ghost>,
    /// Nodes that elements name: particles in the order of the lattice, then ghosts.
    pub named: Vec<u32>,
    /// Each node's place among those; of others whatever.
    numbers: Vec<u32>,
    /// For each node, one more than its place among the ghosts; 0 for other nodes.
    ghost_of: Vec<u32>,
}

impl Elements {
    /// Nodes that elements may name: the lattice's particles and the ghosts beyond.
    pub fn nodes(&self) -> usize {
        self.areas.len()
    }

    /// The ghost that a node is, if it is one.
    pub fn ghost(&self, node: u32) -> Option<&Ghost> {
        self.ghosts.get((self.ghost_of[node as usize] as usize).wrapping_sub(1))
    }

    /// A node's place among those that elements name.
    pub fn number(&self, node: u32) -> u32 {
        self.numbers[node as usize]
    }

    /// The nodes that elements name; nothing is asked of others, nor told of them.
    pub fn present(&self) -> impl Iterator<Item = usize> {
        self.named.iter().map(|&n| n as usize)
    }

    /// Copies what belongs to them: on a coarse mesh they are a fraction of the lattice.
    pub fn copy(&self, from: &[Vec3], to: &mut [Vec3]) {
        if self.named.len() == to.len() {
            to.copy_from_slice(from);
        } else {
            self.present().for_each(|n| to[n] = from[n]);
        }
    }

    /// Gives every ghost its masters' value. Positions, velocities and steps go over the nodes.
    pub fn fill(&self, x: &mut [Vec3]) {
        for ghost in &self.ghosts {
            x[ghost.node as usize] = ghost.value(x);
        }
    }

    /// Visits the active particles that a node stands for, with their weights: a ghost's masters, or the node itself.
    pub fn each_master(&self, node: u32, mut visit: impl FnMut(u32, f64)) {
        match self.ghost(node) {
            Some(ghost) => ghost.masters.iter().for_each(|&(master, weight)| visit(master, weight)),
            None => visit(node, 1.0),
        }
    }

    /// Passes what ghosts carry on to their masters, as the transpose of `fill`: forces.
    pub fn gather(&self, forces: &mut [Vec3]) {
        for ghost in &self.ghosts {
            let force = std::mem::take(&mut forces[ghost.node as usize]);
            ghost.masters.iter().for_each(|&(n, w)| forces[n as usize] += force * w);
        }
    }

    /// Puts the elements that name no ghost first, line by line, and counts them.
    fn sort(&mut self) {
        let ghost_of = &self.ghost_of;
        let named = |nodes: &[u32]| nodes.iter().any(|&n| ghost_of[n as usize] > 0);
        self.edges.sort_by_key(|e| named(&e.nodes));
        self.triples.sort_by_key(|t| (named(&t.nodes), t.direction));
        self.shears.sort_by_key(|s| named(&s.nodes));
        self.regular = [
            self.edges.partition_point(|e| !named(&e.nodes)),
            self.triples.partition_point(|t| !named(&t.nodes)),
            self.shears.partition_point(|s| !named(&s.nodes)),
        ];
    }

    /// Numbers the nodes that elements name.
    fn number_nodes(&mut self) {
        let mut is_named = vec![false; self.nodes()];
        let mut mark = |nodes: &[u32]| nodes.iter().for_each(|&n| is_named[n as usize] = true);
        self.edges.iter().for_each(|e| mark(&e.nodes));
        self.triples.iter().for_each(|t| mark(&t.nodes));
        self.shears.iter().for_each(|s| [s.nodes, s.bent].iter().for_each(|nodes| mark(nodes)));
        self.named = (0..self.nodes() as u32).filter(|&n| is_named[n as usize]).collect();
        self.named.sort_by_key(|&n| self.ghost_of[n as usize] > 0);
        self.numbers = vec![0; self.nodes()];
        self.named.iter().zip(0..).for_each(|(&n, k)| self.numbers[n as usize] = k);
    }
}

impl Grid {
    /// Makes the elements from the cells. `clamped` marks particles that a clamp holds: an edge between two of them cannot
    /// bend, so a triple at the clamp's border turns over half its length only (a full one is first-order wrong).
    pub fn elements(&self, clamped: impl Fn(usize) -> bool) -> Elements {
        let mut elements = Elements { areas: vec![0.0; self.particles()], ..Elements::default() };
        self.add_cells(&mut elements);
        for n in 0..self.particles() {
            if let Status::Hanging(along) = self.status(n) {
                elements.ghosts.push(self.linear(n, along));
            }
        }
        let clamped = |n: u32| (n as usize) < self.particles() && clamped(n as usize);
        let mut bending = Bending { grid: self, areas: &elements.areas, clamped, cubic: BTreeMap::new() };
        let triples = bending.triples();
        let bent: Vec<[u32; 4]> =
            elements.shears.iter().map(|s| s.nodes.map(|n| bending.corner(n))).collect();
        let mut cubic: Vec<_> = bending.cubic.into_iter().collect();
        elements.triples = triples;
        elements.shears.iter_mut().zip(bent).for_each(|(s, bent)| s.bent = bent);
        cubic.sort_unstable_by_key(|&(_, node)| node);
        for ((site, along), node) in cubic {
            elements.ghosts.push(Ghost { node, masters: self.cubic(self.site(site), along) });
        }
        let nodes = elements.ghosts.last().map_or(0, |g| g.node as usize + 1).max(self.particles());
        elements.areas.resize(nodes, 0.0);
        elements.ghost_of = vec![0; nodes];
        for (ghost, place) in elements.ghosts.iter().zip(1..) {
            elements.ghost_of[ghost.node as usize] = place;
            let share = std::mem::take(&mut elements.areas[ghost.node as usize]);
            ghost.masters.iter().for_each(|&(n, w)| elements.areas[n as usize] += share * w);
        }
        elements.sort();
        elements.number_nodes();
        elements
    }

    fn add_cells(&self, elements: &mut Elements) {
        let mut sides = Vec::with_capacity(4 * self.cells.len());
        for cell in &self.cells {
            let nodes = self.corners(cell);
            let lengths = [0, 1].map(|k| self.spacing(k) * cell.size[k] as f64);
            let shares = self.shares(cell);
            for (direction, from, to) in [(0, 0, 1), (0, 2, 3), (1, 0, 2), (1, 1, 3)] {
                sides.push(Edge {
                    nodes: [nodes[from], nodes[to]],
                    direction,
                    length: lengths[direction],
                    width: (shares[from] + shares[to]) / lengths[direction],
                    rest: 0.0,
                });
            }
            for (corner, share) in nodes.into_iter().zip(shares) {
                elements.areas[corner as usize] += share;
            }
            elements.shears.push(Shear { nodes, bent: nodes, lengths, area: shares.iter().sum(), rest: 0.0 });
        }
        sides.sort_by_key(|e| (e.direction, e.nodes));
        sides.dedup_by(|again, first| {
            let same = again.nodes == first.nodes;
            if same {
                first.width += again.width;
            }
            same
        });
        elements.edges = sides;
    }

    /// What half of a triple's arm covers more, or less, beyond a leaf beside it that is half as long [m²]: there its width is that of
    /// what follows, where another triple may end or begin.
    fn beyond(&self, site: Site, direction: Direction, forward: bool) -> f64 {
        let across = 1 - direction;
        let Some(end) = self.next(site, direction, forward) else { return 0.0 };
        let [ahead, behind] = [forward, !forward].map(|forward| self.ahead(site, direction, forward));
        let width = |levels: Levels| self.spacing(across) * f64::from(1_u32 << levels[across]);
        let side = |side: usize| {
            let leaf = ahead[side]?;
            let length = 1 << leaf[direction];
            let there = onward(site, direction, forward, length).filter(|there| *there != end)?;
            let next = self.ahead(there, direction, forward)[side]?;
            let near = behind[side].map_or(f64::INFINITY, width).min(width(leaf));
            let far = width(next).min(width(leaf));
            Some(0.25 * self.spacing(direction) * length as f64 * (far - near))
        };
        side(0).unwrap_or(0.0) + side(1).unwrap_or(0.0)
    }
}

/// Makes triples, and the cubic ghosts that they ask for, by lattice index and direction of the line.
struct Bending<'a, F> {
    grid: &'a Grid,
    /// Areas that cells give to particles [m²], before ghosts pass theirs on.
    areas: &'a [f64],
    clamped: F,
    cubic: BTreeMap<(usize, Direction), u32>,
}

impl<F: Fn(u32) -> bool> Bending<'_, F> {
    fn triples(&mut self) -> Vec<Triple> {
        let mut triples = Vec::new();
        for n in 0..self.grid.particles() {
            let directions: &[Direction] = match self.grid.status(n) {
                Status::Active => &[0, 1],
                Status::Hanging(0) => &[1],
                Status::Hanging(_) => &[0],
                Status::Absent => &[],
            };
            triples
                .extend(directions.iter().filter_map(|&direction| self.triple(self.grid.site(n), direction)));
        }
        triples
    }

    /// The node at a site of a line along `along`: the particle where it is active, else a cubic ghost.
    fn node(&mut self, site: Site, along: Direction) -> u32 {
        let index = self.grid.index(site);
        if self.grid.is_active(index) {
            return index as u32;
        }
        let next = (self.grid.particles() + self.cubic.len()) as u32;
        *self.cubic.entry((index, along)).or_insert(next)
    }

    /// The node that a cell's corner is in bending.
    fn corner(&mut self, node: u32) -> u32 {
        match self.grid.status(node as usize) {
            Status::Hanging(along) => self.node(self.grid.site(node as usize), along),
            _ => node,
        }
    }

    fn triple(&mut self, site: Site, direction: Direction) -> Option<Triple> {
        let (grid, across) = (self.grid, 1 - direction);
        let [before, after] = [grid.next(site, direction, false)?, grid.next(site, direction, true)?];
        let distance = |from: Site, to: Site, k: Direction| grid.spacing(k) * from[k].abs_diff(to[k]) as f64;
        let lengths = [before, after].map(|to| distance(site, to, direction));
        let transverse = if grid.is_active(grid.index(site)) {
            [grid.next(site, across, false), grid.next(site, across, true)]
        } else {
            grid.linear(grid.index(site), across)
                .masters
                .iter()
                .map(|m| Some(grid.site(m.0 as usize)))
                .collect::<Vec<_>>()
                .try_into()
                .expect("a side has two ends")
        };
        let centre = self.node(site, across);
        let [previous, next] = [before, after].map(|to| self.node(to, across));
        let sides = transverse.map(|to| to.map_or(centre, |to| self.node(to, direction)));
        let bends =
            |length: f64, end: u32| if (self.clamped)(centre) && (self.clamped)(end) { 0.0 } else { length };
        let arms = [bends(lengths[0], previous), bends(lengths[1], next)];
        let bending = 0.5 * (arms[0] + arms[1]);
        let beyond =
            (0..2).filter(|&k| arms[k] > 0.0).map(|k| grid.beyond(site, direction, k == 1)).sum::<f64>();
        let levels = [false, true].map(|forward| grid.ahead(site, direction, forward));
        let half = |side: usize| {
            let smaller = levels.iter().filter_map(|ahead| Some(ahead[side]?[across])).min();
            smaller.map_or(0.0, |level| 0.5 * grid.spacing(across) * f64::from(1u32 << level))
        };
        // Among the finest cells the area says the same and knows of cuts.
        let finest = levels.iter().flatten().flatten().all(|levels| *levels == [0; 2]);
        let width = if finest {
            self.areas[grid.index(site)] / (0.5 * (lengths[0] + lengths[1]))
        } else {
            half(0) + half(1)
        };
        Some(Triple {
            nodes: [previous, centre, next, sides[0], sides[1]],
            site: grid.index(site) as u32,
            direction,
            lengths,
            span: transverse.iter().flatten().map(|&to| distance(site, to, across)).sum(),
            reach: if bending > 0.0 { bending } else { 0.5 * (lengths[0] + lengths[1]) },
            area: bending * width + beyond,
            rest: 0.0,
        })
    }
}
