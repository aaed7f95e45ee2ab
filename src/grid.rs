//! The I × J particle lattice, i along the warp, j along the weft, and the elements its leaf cells own.
//!
//! Particle (i, j) has index i·J + j. A leaf cell covers `size` × `size` lattice intervals; every cell gives its four
//! sides as edges with half its width, one shear element, and a quarter of its area to each corner, so a uniform mesh
//! comes out as usual. Today every cell has size 1; ghosts and level jumps come with adaptive coarsening.

use crate::cut::Cut;
use std::collections::BTreeMap;

/// A particle's place in the lattice: `[i, j]`.
pub type Site = [usize; 2];

/// Warp (along i) or weft (along j): indexes per-direction laws.
pub type Direction = usize;

/// A square leaf of the mesh: its corner nearest (0, 0) and its size in lattice intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cell {
    /// Corner nearest to (0, 0).
    pub corner: Site,
    /// Side in lattice intervals.
    pub size: usize,
}

/// A stretch element between two neighbours on a warp or weft line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Particle indices, in rising i or j.
    pub nodes: [u32; 2],
    /// Line it lies on.
    pub direction: Direction,
    /// Rest length [m].
    pub length: f64,
    /// Tributary width [m].
    pub width: f64,
}

/// A bending element: three neighbours on one line and the transverse neighbours that span the sheet at the centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triple {
    /// Particle indices: previous, centre, next, transverse previous, transverse next (the centre where the sheet ends).
    pub nodes: [u32; 5],
    /// Line it lies on.
    pub direction: Direction,
    /// The edges before and after the centre.
    pub edges: [u32; 2],
    /// Their rest lengths [m].
    pub lengths: [f64; 2],
    /// Rest length [m] between the transverse neighbours.
    pub span: f64,
    /// Length that bends [m]: half of both rest lengths, a clamped one counting nothing.
    pub reach: f64,
    /// Tributary area [m²].
    pub area: f64,
}

/// A shear element: the corners (0,0), (1,0), (0,1), (1,1) of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shear {
    /// Particle indices.
    pub nodes: [u32; 4],
    /// Rest lengths of its sides along warp and weft [m].
    pub lengths: [f64; 2],
    /// Tributary area [m²].
    pub area: f64,
}

/// All elements of a mesh, in a fixed order.
#[derive(Clone, Debug, Default)]
pub struct Elements {
    /// Stretch elements.
    pub edges: Vec<Edge>,
    /// Bending elements.
    pub triples: Vec<Triple>,
    /// Shear elements.
    pub shears: Vec<Shear>,
    /// Tributary area of each particle [m²]; the sum is the sheet's area. A particle without area is absent: cut away.
    pub areas: Vec<f64>,
}

/// The lattice and its mesh.
#[derive(Clone, Debug)]
pub struct Grid {
    /// Particles along warp and weft, `[I, J]`.
    pub counts: [usize; 2],
    /// Rest lengths of the sheet along warp and weft [m].
    pub size: [f64; 2],
    /// Leaves of the mesh; they tile the lattice.
    pub cells: Vec<Cell>,
    /// What is cut from the sheet; all of it without.
    pub cut: Option<Cut>,
    /// Number of the mesh: +1 at every change.
    pub epoch: u32,
}

impl Grid {
    /// A uniform lattice of `counts` particles (each at least 2) over `size` [m].
    pub fn uniform(counts: [usize; 2], size: [f64; 2]) -> Grid {
        let cells = (0..counts[0] - 1)
            .flat_map(|i| (0..counts[1] - 1).map(move |j| Cell { corner: [i, j], size: 1 }))
            .collect();
        Grid { counts, size, cells, cut: None, epoch: 0 }
    }

    /// Index of the particle at `site`.
    pub fn index(&self, site: Site) -> usize {
        site[0] * self.counts[1] + site[1]
    }

    /// Lattice place of particle `index`.
    pub fn site(&self, index: usize) -> Site {
        [index / self.counts[1], index % self.counts[1]]
    }

    /// True when `site` lies in the lattice.
    pub fn contains(&self, site: Site) -> bool {
        site[0] < self.counts[0] && site[1] < self.counts[1]
    }

    /// Particles of the finest lattice.
    pub fn particles(&self) -> usize {
        self.counts[0] * self.counts[1]
    }

    /// Rest distance of lattice neighbours along `direction` [m].
    pub fn spacing(&self, direction: Direction) -> f64 {
        self.size[direction] / (self.counts[direction] - 1) as f64
    }

    /// Level of a particle: 0 on the finest mesh.
    pub fn level(&self, _index: usize) -> u8 {
        0
    }

    /// Triangles of the surface as particle indices, counter-clockwise seen from warp × weft.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        let present = self.cells.iter().filter(|c| self.shares(c)[0] > 0.0);
        present.map(|c| self.corners(c)).flat_map(|[a, b, c, d]| [[a, b, d], [a, d, c]]).collect()
    }

    /// The corners (0,0), (1,0), (0,1), (1,1) of a cell as particle indices.
    fn corners(&self, cell: &Cell) -> [u32; 4] {
        let [i, j] = cell.corner;
        let at = |di, dj| self.index([i + di * cell.size, j + dj * cell.size]) as u32;
        [at(0, 0), at(1, 0), at(0, 1), at(1, 1)]
    }

    /// Area [m²] of a cell that each of its corners bears: a quarter of it, or of what a cut leaves.
    fn shares(&self, cell: &Cell) -> [f64; 4] {
        let size = [0, 1].map(|k| self.spacing(k) * cell.size as f64);
        let Some(cut) = &self.cut else { return [0.25 * size[0] * size[1]; 4] };
        let low = [0, 1].map(|k| self.spacing(k) * cell.corner[k] as f64);
        cut.shares(low, [low[0] + size[0], low[1] + size[1]])
    }

    /// Makes the elements from the cells. `clamped` marks particles that a clamp holds: an edge between two of them cannot
    /// bend, so a triple at the clamp's border turns over half its length only (a full one is first-order wrong).
    pub fn elements(&self, clamped: impl Fn(usize) -> bool) -> Elements {
        let mut widths: BTreeMap<(Direction, u32, u32), f64> = BTreeMap::new();
        let mut elements = Elements { areas: vec![0.0; self.particles()], ..Elements::default() };
        for cell in &self.cells {
            let nodes = self.corners(cell);
            let lengths = [0, 1].map(|k| self.spacing(k) * cell.size as f64);
            let shares = self.shares(cell);
            let area: f64 = shares.iter().sum();
            if area == 0.0 {
                continue;
            }
            for (direction, from, to) in [(0, 0, 1), (0, 2, 3), (1, 0, 2), (1, 1, 3)] {
                let side = (direction, nodes[from], nodes[to]);
                *widths.entry(side).or_default() += (shares[from] + shares[to]) / lengths[direction];
            }
            for (corner, share) in nodes.into_iter().zip(shares) {
                elements.areas[corner as usize] += share;
            }
            elements.shears.push(Shear { nodes, lengths, area });
        }
        for (&(direction, from, to), &width) in &widths {
            let steps = self.site(to as usize)[direction] - self.site(from as usize)[direction];
            let length = self.spacing(direction) * steps as f64;
            elements.edges.push(Edge { nodes: [from, to], direction, length, width });
        }
        elements.triples = self.triples(&elements.edges, &elements.areas, clamped);
        elements
    }

    /// One triple per particle and direction in which an edge arrives and another leaves.
    fn triples(&self, edges: &[Edge], areas: &[f64], clamped: impl Fn(usize) -> bool) -> Vec<Triple> {
        let mut arriving = vec![[None; 2]; self.particles()];
        let mut leaving = vec![[None; 2]; self.particles()];
        for (k, edge) in edges.iter().enumerate() {
            leaving[edge.nodes[0] as usize][edge.direction] = Some((k, edge));
            arriving[edge.nodes[1] as usize][edge.direction] = Some((k, edge));
        }
        let mut triples = Vec::new();
        for centre in 0..self.particles() {
            for direction in 0..2 {
                let (Some((first, before)), Some((second, after))) =
                    (arriving[centre][direction], leaving[centre][direction])
                else {
                    continue;
                };
                let transverse = [arriving[centre][1 - direction], leaving[centre][1 - direction]];
                let bends =
                    |e: &Edge| if e.nodes.iter().all(|&n| clamped(n as usize)) { 0.0 } else { e.length };
                let bending = 0.5 * (bends(before) + bends(after));
                triples.push(Triple {
                    nodes: [
                        before.nodes[0],
                        centre as u32,
                        after.nodes[1],
                        transverse[0].map_or(centre as u32, |(_, e)| e.nodes[0]),
                        transverse[1].map_or(centre as u32, |(_, e)| e.nodes[1]),
                    ],
                    edges: [first as u32, second as u32],
                    direction,
                    lengths: [before.length, after.length],
                    span: transverse.iter().flatten().map(|(_, e)| e.length).sum(),
                    reach: if bending > 0.0 { bending } else { 0.5 * (before.length + after.length) },
                    // What bends of the centre's area: all of it, less where a clamp holds an edge.
                    area: areas[centre] * bending / (0.5 * (before.length + after.length)),
                });
            }
        }
        triples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_sum_to_the_sheet() {
        for counts in [[2, 2], [5, 9], [77, 77], [31, 4]] {
            let grid = Grid::uniform(counts, [0.3, 0.21]);
            let area: f64 = grid.elements(|_| false).areas.iter().sum();
            assert!((area / 0.063 - 1.0).abs() < 1e-12, "{counts:?}: {area}");
        }
    }

    #[test]
    fn counts_are_those_of_a_lattice() {
        let elements = Grid::uniform([5, 9], [1.0, 2.0]).elements(|_| false);
        assert_eq!(elements.edges.len(), 4 * 9 + 5 * 8);
        assert_eq!(elements.triples.len(), 3 * 9 + 5 * 7);
        assert_eq!(elements.shears.len(), 4 * 8);
    }

    #[test]
    fn widths_halve_at_the_border_and_clamps_halve_the_triple() {
        let grid = Grid::uniform([4, 3], [3.0, 2.0]);
        let elements = grid.elements(|n| grid.site(n)[0] < 2);
        let width = |a: Site| {
            elements
                .edges
                .iter()
                .find(|e| e.nodes[0] == grid.index(a) as u32 && e.direction == 0)
                .unwrap()
                .width
        };
        assert_eq!((width([0, 0]), width([0, 1]), width([0, 2])), (0.5, 1.0, 0.5));
        let area = |c: Site| {
            elements
                .triples
                .iter()
                .find(|t| t.nodes[1] == grid.index(c) as u32 && t.direction == 0)
                .unwrap()
                .area
        };
        assert_eq!((area([1, 1]), area([2, 1])), (0.5, 1.0));
    }
}
