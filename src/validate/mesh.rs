//! Meshes that checks run on: graded ones made before the start, and those that the cloth chooses itself.

use super::strip;
use crate::{
    adapt::Settings,
    grid::{Cell, Edit, Grid, Site},
    math::Vec3,
    minimize::Method,
    model::Setup,
    world::{Budget, Refused, World},
};
use rand::{Rng, RngExt};

/// Which cells the mesh has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Mesh {
    /// Cells of one size.
    Uniform,
    /// Two halves along the warp, cells of size 1 and 2.
    Straight,
    /// Three bands along the warp, cells of sizes 1, 2 and 4.
    Banded,
    /// Sizes 1, 2 and 4 at random.
    Random,
    /// Sides of 1, 2 and 4 at random, along warp and weft apart.
    Slender,
    /// What the cloth makes of cells of size 1 on its way to rest.
    Adapted,
}

/// Sizes that cells of slender meshes may have, in the order in which they merge.
const SIZES: [[usize; 2]; 8] = [[1, 2], [2, 1], [2, 2], [1, 4], [4, 1], [2, 4], [4, 2], [4, 4]];
/// Steps between looks at the mesh.
const EVERY: usize = 5;

impl Mesh {
    /// All kinds.
    pub const ALL: [Mesh; 6] =
        [Mesh::Uniform, Mesh::Straight, Mesh::Banded, Mesh::Random, Mesh::Slender, Mesh::Adapted];

    /// Size of the largest cells in intervals of the lattice.
    pub fn coarsest(self) -> usize {
        match self {
            Mesh::Uniform => 1,
            Mesh::Straight => 2,
            Mesh::Banded | Mesh::Random | Mesh::Slender | Mesh::Adapted => 4,
        }
    }

    /// A strip with two particles across, as fine as this mesh's finest cells, made `across` of its largest cells wide; these are as long as
    /// those of a uniform strip with `particles`.
    pub fn strip(self, particles: usize, across: usize, make: impl Fn(usize) -> Setup) -> Setup {
        let strip = make((particles - 1) * self.coarsest() + 1);
        if self == Mesh::Uniform { strip } else { strip::widened(strip, across * self.coarsest() + 1) }
    }

    /// How a case is called.
    pub fn case(self) -> &'static str {
        match self {
            Mesh::Uniform => "",
            Mesh::Straight => ", straight",
            Mesh::Banded => ", banded",
            Mesh::Random => ", random",
            Mesh::Slender => ", slender",
            Mesh::Adapted => ", adapted",
        }
    }

    /// The merges that make the mesh from a lattice. Intervals marked as fine stay so, and what borders on pins and the hand: they must be active.
    pub fn edits(self, setup: &Setup, fine: impl Fn(Site) -> bool, random: &mut impl Rng) -> Vec<Edit> {
        let mut grid = Grid::uniform(setup.particles, setup.size);
        let intervals = grid.counts.map(|n| n - 1);
        let blocks = intervals.map(|n| n.div_ceil(4));
        let mut draw = || 1 << random.random_range(0..3);
        let drawn: Vec<[usize; 2]> = (0..blocks[0] * blocks[1])
            .map(|_| match self {
                Mesh::Slender => [draw(), draw()],
                _ => [draw(); 2],
            })
            .collect();
        let held: Vec<Site> = setup.pins.iter().copied().chain(setup.hand).collect();
        let wanted = |site: Site| match self {
            _ if fine(site) => [1; 2],
            Mesh::Uniform | Mesh::Adapted => [1; 2],
            Mesh::Straight => [1 + usize::from(site[0] >= intervals[0] / 8 * 4); 2],
            Mesh::Banded => [1 << (site[0] / (intervals[0] / 12 * 4).max(4)).min(2); 2],
            Mesh::Random | Mesh::Slender => drawn[site[0] / 4 * blocks[1] + site[1] / 4],
        };
        let sizes: Vec<[usize; 2]> = match self {
            Mesh::Slender => SIZES.to_vec(),
            _ => vec![[2; 2], [4; 2]],
        };
        let mut edits = Vec::new();
        for size in sizes {
            for i in (0..intervals[0]).step_by(size[0]) {
                for j in (0..intervals[1]).step_by(size[1]) {
                    let cell = Cell { corner: [i, j], size };
                    let allowed = (0..cell.intervals()).all(|k| {
                        let wanted = wanted([i + k / size[1], j + k % size[1]]);
                        (0..2).all(|k| wanted[k] >= size[k])
                    });
                    // What does not fit yet (balance, border) stays finer.
                    if allowed {
                        let mut trial = grid.clone();
                        if trial.edit(&[Edit::Coarsen(cell)]).is_ok()
                            && held.iter().all(|site| trial.is_active(trial.index(*site)))
                        {
                            grid = trial;
                            edits.push(Edit::Coarsen(cell));
                        }
                    }
                }
            }
        }
        edits
    }

    /// A world on this mesh, at its start.
    pub fn world(
        self,
        setup: Setup,
        fine: impl Fn(Site) -> bool,
        random: &mut impl Rng,
    ) -> Result<World, Refused> {
        let edits = self.edits(&setup, fine, random);
        let mut world = World::with_mesh(setup, Method::default(), &edits)?;
        world.set_adaptive((self == Mesh::Adapted).then(Settings::default));
        Ok(world)
    }
}

/// The cells to merge, in order, that make a mesh from its lattice: the smallest first.
pub fn merges_of(grid: &Grid) -> Vec<Cell> {
    let mut merged: Vec<Cell> = grid.cells().iter().filter(|c| c.is_coarse()).flat_map(within).collect();
    merged.sort_by_key(Cell::intervals);
    merged
}

/// A cell and those of which it is merged step by step: larger and larger squares, then longer and longer ones.
fn within(cell: &Cell) -> Vec<Cell> {
    let levels = 1..=cell.size[0].max(cell.size[1]).trailing_zeros();
    let sizes = levels.map(|level| cell.size.map(|size| size.min(1 << level)));
    let places = sizes.flat_map(|size| {
        let steps = move |k: usize| (cell.corner[k]..cell.end()[k]).step_by(size[k]);
        steps(0).flat_map(move |i| steps(1).map(move |j| Cell { corner: [i, j], size }))
    });
    places.collect()
}

/// Steps of `dt` [s] until the cloth rests, on a mesh that adapts where the world lets it: for a tenth of the steps at the most.
pub fn settle(world: &mut World, dt: f64, most: usize) -> Result<(), Refused> {
    for step in 1..most / 10 {
        if world.probe().is_none() {
            break;
        }
        world.step(&[], dt, Budget::solves(strip::SOLVES));
        if step % EVERY == 0 {
            world.adapt();
        }
    }
    world.set_adaptive(None);
    strip::settle(world, dt, most)
}

/// Positions [m] of the particles that elements name, beside their indices.
pub fn particles(world: &World) -> impl Iterator<Item = (usize, Vec3)> + '_ {
    let named = |n: &usize| world.grid().status(*n) != crate::grid::Status::Absent;
    (0..world.grid().particles()).filter(named).map(|n| (n, world.positions()[n]))
}
