//! The I × J particle lattice, i along the warp, j along the weft; particle (i, j) has index i·J + j.

/// A particle's place in the lattice: `[i, j]`.
pub type Site = [usize; 2];

/// The lattice and its mesh.
#[derive(Clone, Debug)]
pub struct Grid {
    /// Particles along warp and weft, `[I, J]`.
    pub counts: [usize; 2],
    /// Rest lengths of the sheet along warp and weft [m].
    pub size: [f64; 2],
    /// Number of the mesh: +1 at every change.
    pub epoch: u32,
}

impl Grid {
    /// A uniform lattice of `counts` particles over `size` [m].
    pub fn uniform(counts: [usize; 2], size: [f64; 2]) -> Grid {
        Grid { counts, size, epoch: 0 }
    }
    /// Index of the particle at `site`.
    pub fn index(&self, site: Site) -> usize {
        site[0] * self.counts[1] + site[1]
    }
    /// Lattice place of particle `index`.
    pub fn site(&self, index: usize) -> Site {
        [index / self.counts[1], index % self.counts[1]]
    }
    /// Particles of the finest lattice.
    pub fn particles(&self) -> usize {
        self.counts[0] * self.counts[1]
    }
    /// Triangles of the surface, as particle indices; counter-clockwise seen from warp × weft.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        let mut triangles = Vec::new();
        for i in 0..self.counts[0] - 1 {
            for j in 0..self.counts[1] - 1 {
                let [a, b] = [self.index([i, j]) as u32, self.index([i + 1, j]) as u32];
                triangles.push([a, b, b + 1]);
                triangles.push([a, b + 1, a + 1]);
            }
        }
        triangles
    }
    /// Level of a particle: 0 on the finest mesh.
    pub fn level(&self, _index: usize) -> u8 {
        0
    }
}
