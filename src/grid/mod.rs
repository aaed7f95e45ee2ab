//! The I × J particle lattice, i along the warp, j along the weft, and its mesh: leaf cells, halved along either or both.
//!
//! Particle (i, j) has index i·J + j. A leaf covers s × t lattice intervals, powers of two, at multiples of s and t; along either,
//! neighbours, corners included, differ by a factor of two at the most. A particle at the corners of all cells that touch it is *active*: it carries
//! degrees of freedom. One in the middle of a larger cell's side *hangs*: it is a ghost, slaved to active ones. All others are
//! absent: no element names them. So are those that a cut leaves nothing of; cells that its rim crosses stay at the finest size.
//! Cells own the elements (`elements`).

mod check;
mod elements;
mod ghost;
mod tree;

pub use elements::{Edge, Elements, Shear, Triple};
pub use ghost::{Ghost, Interpolation};
pub use tree::{Edit, Unfit};

use crate::cut::Cut;

/// A particle's place in the lattice: `[i, j]`.
pub type Site = [usize; 2];

/// Warp (along i) or weft (along j): indexes per-direction laws.
pub type Direction = usize;

/// A leaf of the mesh: its corner nearest (0, 0) and its sides in lattice intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Cell {
    /// Corner nearest to (0, 0).
    pub corner: Site,
    /// Sides along warp and weft, in lattice intervals.
    pub size: [usize; 2],
}

impl Cell {
    /// A square one.
    pub fn square(corner: Site, size: usize) -> Cell {
        Cell { corner, size: [size; 2] }
    }

    /// The one of this size that a place of the lattice lies in.
    pub fn around(site: Site, size: [usize; 2]) -> Cell {
        Cell { corner: [0, 1].map(|k| site[k] - site[k] % size[k]), size }
    }

    /// Whether it is larger than an interval of the lattice.
    pub fn is_coarse(&self) -> bool {
        self.size != [1, 1]
    }

    /// Lattice intervals that it covers.
    pub fn intervals(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// The corner farthest from (0, 0).
    pub fn end(&self) -> Site {
        [0, 1].map(|k| self.corner[k] + self.size[k])
    }

    /// Whether some of what it covers another one covers too.
    pub fn overlaps(&self, other: &Cell) -> bool {
        (0..2).all(|k| self.corner[k] < other.end()[k] && other.corner[k] < self.end()[k])
    }

    fn levels(&self) -> Levels {
        self.size.map(|size| size.trailing_zeros() as u8)
    }
}

/// log2 of a leaf's sides.
type Levels = [u8; 2];

/// What a particle of the lattice is in the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// It carries degrees of freedom.
    Active,
    /// A ghost in the middle of a larger cell's side, which runs along this direction.
    Hanging(Direction),
    /// No element names it.
    Absent,
}

/// The lattice and its mesh.
#[derive(Clone, Debug)]
pub struct Grid {
    /// Particles along warp and weft, `[I, J]`.
    pub counts: [usize; 2],
    /// Rest lengths of the sheet along warp and weft [m].
    pub size: [f64; 2],
    /// Number of the mesh: +1 at every change.
    pub epoch: u32,
    /// What is cut from the sheet; all of it without.
    cut: Option<Cut>,
    /// How much of each lattice interval the cut leaves.
    cover: Vec<Cover>,
    /// Leaves that the cut leaves something of, by their corners; they tile the sheet.
    cells: Vec<Cell>,
    /// Leaf that covers each lattice interval.
    levels: Vec<Levels>,
    status: Vec<Status>,
    /// Active particles, ascending.
    active: Vec<u32>,
}

/// Share of all cells.
const NEARLY_ALL: f64 = 0.75;

/// How much of something a cut leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cover {
    Nothing,
    Part,
    Whole,
}

impl Grid {
    /// A uniform lattice of `counts` particles (each at least 2) over `size` [m].
    pub fn uniform(counts: [usize; 2], size: [f64; 2]) -> Grid {
        Grid::new(counts, size, None)
    }

    /// The same with only a disc of it left.
    pub fn new(counts: [usize; 2], size: [f64; 2], cut: Option<Cut>) -> Grid {
        let intervals = (counts[0] - 1) * (counts[1] - 1);
        let mut grid = Grid {
            counts,
            size,
            epoch: 0,
            cut,
            cover: Vec::new(),
            cells: Vec::new(),
            levels: vec![[0; 2]; intervals],
            status: Vec::new(),
            active: Vec::new(),
        };
        let cells = (0..intervals).map(|n| grid.leaf_of(n));
        grid.cover = cells.map(|cell| grid.find_cover(&cell)).collect();
        grid.rebuild();
        grid
    }

    fn find_cover(&self, cell: &Cell) -> Cover {
        let whole = 0.25 * (0..2).map(|k| self.spacing(k) * cell.size[k] as f64).product::<f64>();
        match self.shares(cell) {
            [0.0, ..] => Cover::Nothing,
            shares if shares.iter().all(|s| (s / whole - 1.0).abs() < 1e-12) => Cover::Whole,
            _ => Cover::Part,
        }
    }

    /// Area [m²] of a cell that each of its corners bears: a quarter of it, or of what a cut leaves.
    fn shares(&self, cell: &Cell) -> [f64; 4] {
        let size = [0, 1].map(|k| self.spacing(k) * cell.size[k] as f64);
        let Some(cut) = &self.cut else { return [0.25 * size[0] * size[1]; 4] };
        let low = [0, 1].map(|k| self.spacing(k) * cell.corner[k] as f64);
        cut.shares(low, [low[0] + size[0], low[1] + size[1]])
    }

    /// True for a particle that the cut leaves nothing of.
    pub fn is_cut_away(&self, index: usize) -> bool {
        self.around(self.site(index)).iter().flatten().all(Option::is_none)
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

    /// Leaves of the mesh, in the order of their corners.
    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    /// What particle `index` is in the mesh.
    pub fn status(&self, index: usize) -> Status {
        self.status[index]
    }

    /// True when particle `index` carries degrees of freedom.
    pub fn is_active(&self, index: usize) -> bool {
        self.status[index] == Status::Active
    }

    /// Particles that carry degrees of freedom, ascending.
    pub fn active(&self) -> impl Iterator<Item = usize> {
        self.active.iter().map(|&n| n as usize)
    }

    /// The size of nearly all cells, where none is larger: such a mesh is a lattice, but for a few particles between its lines.
    pub fn main_size(&self) -> Option<[usize; 2]> {
        let largest = self.cells.iter().map(|c| c.size).reduce(|a, b| [0, 1].map(|k| a[k].max(b[k])))?;
        let count = self.cells.iter().filter(|c| c.size == largest).count();
        (count as f64 >= NEARLY_ALL * self.cells.len() as f64).then_some(largest)
    }

    /// Whether a particle stands on the lines of a lattice of cells of this size.
    pub fn is_on_lines(&self, index: usize, size: [usize; 2]) -> bool {
        let site = self.site(index);
        (0..2).all(|k| site[k].is_multiple_of(size[k]))
    }

    /// Numbers of active and of hanging particles.
    pub fn tally(&self) -> [usize; 2] {
        let hanging = self.status.iter().filter(|s| matches!(s, Status::Hanging(_)));
        [self.active.len(), hanging.count()]
    }

    /// Level of a particle: log2 of the shortest side of a cell that touches it; 0 on the finest mesh.
    pub fn level(&self, index: usize) -> u8 {
        self.around(self.site(index)).into_iter().flatten().flatten().flatten().min().unwrap_or(0)
    }

    /// The corners (0,0), (1,0), (0,1), (1,1) of a cell as particle indices.
    pub fn corners(&self, cell: &Cell) -> [u32; 4] {
        let ([i, j], [end_i, end_j]) = (cell.corner, cell.end());
        [[i, j], [end_i, j], [i, end_j], [end_i, end_j]].map(|site| self.index(site) as u32)
    }

    /// Triangles of the surface as particle indices, counter-clockwise seen from warp × weft. A cell with hanging particles on
    /// its sides is a fan around one of its corners that bends at them, so the surface has no cracks.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(2 * self.cells.len());
        for cell in &self.cells {
            let outline = self.outline(cell);
            if let &[a, b, d, c] = outline.as_slice() {
                triangles.extend([[a, b, d], [a, d, c]]);
                continue;
            }
            // From a corner whose two sides are whole no triangle is flat; else from one hanging particle.
            let n = outline.len();
            let hangs = |k: usize| !self.is_corner(cell, outline[k % n]);
            let whole = (0..n).find(|&k| !hangs(k) && !hangs(k + 1) && !hangs(k + n - 1));
            let first = whole.or_else(|| (0..n).find(|&k| hangs(k))).unwrap_or(0);
            for k in 1..n - 1 {
                triangles.push([outline[first], outline[(first + k) % n], outline[(first + k + 1) % n]]);
            }
        }
        triangles
    }

    fn is_corner(&self, cell: &Cell, index: u32) -> bool {
        self.corners(cell).contains(&index)
    }

    /// Corners of a cell and the hanging particles between them, around from its corner.
    fn outline(&self, cell: &Cell) -> Vec<u32> {
        let [a, b, c, d] = self.corners(cell);
        let mut outline = Vec::with_capacity(8);
        for (from, to, along) in [(a, b, 0), (b, d, 1), (d, c, 0), (c, a, 1)] {
            outline.push(from);
            let middle = (from + to) / 2;
            if cell.size[along] > 1 && self.status[middle as usize] != Status::Absent {
                outline.push(middle);
            }
        }
        outline
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangles_cover_the_sheet_once_and_match_at_hanging_particles() {
        let mut grid = Grid::uniform([9, 13], [8.0, 12.0]);
        for corner in [[0, 0], [0, 2], [2, 0], [2, 2], [0, 4], [2, 4], [4, 0], [4, 2], [4, 4], [4, 8], [6, 6]]
        {
            grid.edit(&[Edit::Coarsen(Cell::square(corner, 2))]).unwrap();
        }
        grid.edit(&[Edit::Coarsen(Cell::square([0, 0], 4))]).unwrap();
        let at = |n: u32| grid.site(n as usize).map(|k| k as f64);
        let mut sides = std::collections::BTreeMap::new();
        let mut area = 0.0;
        for t in grid.triangles() {
            let [[a, b], [c, d], [e, f]] = t.map(at);
            let twice = (c - a) * (f - b) - (d - b) * (e - a);
            assert!(twice > 0.0, "{t:?} is flat or turned over");
            area += 0.5 * twice;
            for k in 0..3 {
                *sides.entry((t[k], t[(k + 1) % 3])).or_insert(0) += 1;
            }
        }
        assert_eq!(area, 96.0);
        for (&(a, b), &count) in &sides {
            let [p, q] = [a, b].map(at);
            let border = (0..2).any(|k| p[k] == q[k] && (p[k] == 0.0 || p[k] == [8.0, 12.0][k]));
            assert!(count == 1 && (border || sides.contains_key(&(b, a))), "crack between {p:?} and {q:?}");
        }
    }
}
