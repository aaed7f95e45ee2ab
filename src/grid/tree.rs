//! The quadtree: which leaf covers what, and edits that merge four leaves or split one.

use super::{Cell, Cover, Grid, Site, Status};

/// A change of the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Edit {
    /// Splits this leaf into four.
    Refine(Cell),
    /// Merges the four leaves of half its size into this cell.
    Coarsen(Cell),
}

/// Why an edit does not fit the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// The cell to split is no leaf, or is of the finest size; or the four to merge are no whole leaves of the sheet.
    #[error("no such leaves")]
    Leaves,
    /// A neighbour would differ by more than a factor of two.
    #[error("a neighbour would differ by more than a factor of two")]
    Balance,
}

impl Grid {
    /// Makes edits, in order, all or none of them; the epoch rises if there are any.
    pub fn edit(&mut self, edits: &[Edit]) -> Result<(), Unfit> {
        if edits.is_empty() {
            return Ok(());
        }
        let before = self.levels.clone();
        for &edit in edits {
            if let Err(unfit) = self.mark(edit) {
                self.levels = before;
                return Err(unfit);
            }
        }
        self.finish(edits);
        Ok(())
    }

    /// Whether an edit fits the mesh.
    pub fn fits(&self, edit: Edit) -> Result<(), Unfit> {
        let (cell, leaf, allowed) = match edit {
            Edit::Refine(cell) => (cell, cell.size, 0..=cell.size.trailing_zeros() as u8),
            Edit::Coarsen(cell) => (cell, cell.size / 2, cell.size.trailing_zeros() as u8 - 1..=u8::MAX),
        };
        let [i, j] = cell.corner;
        let inside = i + cell.size < self.counts[0] && j + cell.size < self.counts[1];
        let aligned = cell.size.is_power_of_two() && i % cell.size == 0 && j % cell.size == 0;
        if cell.size < 2 || !inside || !aligned {
            return Err(Unfit::Leaves);
        }
        if !self.is_tiled(&cell, leaf) {
            return Err(Unfit::Leaves);
        }
        if self.ring(&cell).any(|n| !allowed.contains(&self.levels[n])) {
            return Err(Unfit::Balance);
        }
        Ok(())
    }

    /// The edits that split a leaf, after splitting the larger neighbours that stand in the way.
    pub fn refinement(&self, cell: Cell) -> Vec<Edit> {
        let mut trial = self.clone();
        let mut edits = Vec::new();
        trial.split(cell, &mut edits);
        edits
    }

    /// Makes those of the edits that fit, in order; returns them. The epoch rises if there are any.
    pub fn edit_what_fits(&mut self, edits: impl IntoIterator<Item = Edit>) -> Vec<Edit> {
        let done: Vec<Edit> = edits.into_iter().filter(|edit| self.mark(*edit).is_ok()).collect();
        self.finish(&done);
        done
    }

    /// Splits leaves, and before them the larger neighbours that stand in the way; returns all edits.
    pub fn refine(&mut self, cells: impl IntoIterator<Item = Cell>) -> Vec<Edit> {
        let mut edits = Vec::new();
        cells.into_iter().for_each(|cell| self.split(cell, &mut edits));
        self.finish(&edits);
        edits
    }

    fn finish(&mut self, edits: &[Edit]) {
        if !edits.is_empty() {
            self.rebuild();
            self.epoch += 1;
        }
    }

    fn split(&mut self, cell: Cell, edits: &mut Vec<Edit>) {
        if cell.size < 2 {
            return;
        }
        let level = cell.size.trailing_zeros() as u8;
        loop {
            let larger = self.ring(&cell).find(|&n| self.levels[n] > level);
            let Some(n) = larger else { break };
            self.split(self.leaf_of(n), edits);
        }
        if self.mark(Edit::Refine(cell)).is_ok() {
            edits.push(Edit::Refine(cell));
        }
    }

    /// The leaf that covers the interval whose corner nearest (0, 0) is `corner`.
    pub fn leaf(&self, corner: Site) -> Cell {
        self.leaf_of(self.interval(corner))
    }

    /// The mesh with four leaves merged wherever that fits, the finest first, and its epoch unchanged: the next coarser level of
    /// a multigrid. `None` where nothing can be merged.
    pub fn coarsened(&self) -> Option<Grid> {
        let mut coarse = self.clone();
        let mut sizes: Vec<usize> = self.cells.iter().map(|c| c.size).collect();
        sizes.sort_unstable();
        sizes.dedup();
        let mut merged = false;
        // From the finest: what merges makes room for its larger neighbours. Only leaves of this mesh merge, each once.
        for &size in &sizes {
            for cell in self.cells.iter().filter(|c| c.size == size) {
                let parent = Cell { corner: cell.corner.map(|k| k - k % (2 * size)), size: 2 * size };
                let first = parent.corner == cell.corner;
                merged |= first && self.has_children(&parent) && coarse.mark(Edit::Coarsen(parent)).is_ok();
            }
        }
        merged.then(|| {
            coarse.rebuild();
            coarse
        })
    }

    fn has_children(&self, cell: &Cell) -> bool {
        let inside = (0..2).all(|k| cell.corner[k] + cell.size < self.counts[k]);
        inside && self.is_tiled(cell, cell.size / 2)
    }

    /// Whether leaves of size `leaf` tile a cell of the lattice.
    fn is_tiled(&self, cell: &Cell, leaf: usize) -> bool {
        // One interval of each leaf tells the leaf's size.
        let [i, j] = [0, 1].map(|k| (cell.corner[k]..cell.corner[k] + cell.size).step_by(leaf));
        let mut corners = i.flat_map(|a| j.clone().map(move |b| self.interval([a, b])));
        let level = leaf.trailing_zeros() as u8;
        corners.all(|n| self.levels[n] == level && self.cover[n] == Cover::Whole)
    }

    fn mark(&mut self, edit: Edit) -> Result<(), Unfit> {
        self.fits(edit)?;
        let (cell, level) = match edit {
            Edit::Refine(cell) => (cell, cell.size.trailing_zeros() as u8 - 1),
            Edit::Coarsen(cell) => (cell, cell.size.trailing_zeros() as u8),
        };
        for i in 0..cell.size {
            let first = self.interval([cell.corner[0] + i, cell.corner[1]]);
            self.levels[first..first + cell.size].fill(level);
        }
        Ok(())
    }

    fn interval(&self, corner: Site) -> usize {
        corner[0] * (self.counts[1] - 1) + corner[1]
    }

    pub(super) fn leaf_of(&self, interval: usize) -> Cell {
        let size = 1 << self.levels[interval];
        let across = self.counts[1] - 1;
        Cell { corner: [interval / across, interval % across].map(|k| k - k % size), size }
    }

    /// The intervals all around a cell, corners included.
    fn ring(&self, cell: &Cell) -> impl Iterator<Item = usize> {
        let [i, j] = cell.corner.map(|k| k as isize);
        let size = cell.size as isize;
        let side = (-1..size).flat_map(move |k| {
            [[i + k, j - 1], [i + size, j + k], [i + k + 1, j + size], [i - 1, j + k + 1]]
        });
        let [across, along] = self.counts.map(|n| n as isize - 1);
        side.filter(move |&[a, b]| a >= 0 && b >= 0 && a < across && b < along)
            .map(move |[a, b]| (a * along + b) as usize)
    }

    /// Levels of the leaves around a site: `[low or high side in i][in j]`, `None` outside the sheet.
    pub(super) fn around(&self, site: Site) -> [[Option<u8>; 2]; 2] {
        let at = |di: usize, dj: usize| {
            let (i, j) = ((site[0] + di).checked_sub(1)?, (site[1] + dj).checked_sub(1)?);
            let inside = i + 1 < self.counts[0] && j + 1 < self.counts[1];
            let n = inside.then(|| self.interval([i, j]))?;
            (self.cover[n] != Cover::Nothing).then_some(self.levels[n])
        };
        [[at(0, 0), at(0, 1)], [at(1, 0), at(1, 1)]]
    }

    /// Makes cells and the particles' status from the levels.
    pub(super) fn rebuild(&mut self) {
        self.cells.clear();
        for i in 0..self.counts[0] - 1 {
            for j in 0..self.counts[1] - 1 {
                let n = self.interval([i, j]);
                let size = 1 << self.levels[n];
                if i % size == 0 && j % size == 0 && self.cover[n] != Cover::Nothing {
                    self.cells.push(Cell { corner: [i, j], size });
                }
            }
        }
        self.status = (0..self.particles()).map(|n| self.find_status(self.site(n))).collect();
        self.active = (0..self.particles() as u32).filter(|&n| self.is_active(n as usize)).collect();
    }

    fn find_status(&self, site: Site) -> Status {
        let on_lines = |level: u8| site.map(|k| k % (1 << level) == 0);
        let mut around = self.around(site).into_iter().flatten().flatten().map(on_lines).collect::<Vec<_>>();
        if around.is_empty() {
            return Status::Absent;
        }
        around.sort_unstable();
        match (around[0], around[around.len() - 1]) {
            ([true, true], _) => Status::Active,
            (_, last) if last != [true, true] => Status::Absent,
            ([false, true], _) => Status::Hanging(0),
            ([true, false], _) => Status::Hanging(1),
            _ => Status::Absent,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn random_edits_keep_the_mesh_valid() {
        for counts in [[33, 33], [17, 41], [30, 46]] {
            let mut random = rand_pcg::Pcg64::seed_from_u64(7);
            let mut grid = Grid::uniform(counts, [0.3, 0.21]);
            let mut done = [0; 2];
            for _ in 0..1500 {
                let corner = [0, 1].map(|k| random.random_range(0..counts[k] - 1));
                let leaf = grid.leaf(corner);
                let edits = if random.random_bool(0.6) {
                    let size = 2 * leaf.size;
                    vec![Edit::Coarsen(Cell { corner: leaf.corner.map(|k| k - k % size), size })]
                } else {
                    grid.refinement(leaf)
                };
                let epoch = grid.epoch;
                if grid.edit(&edits).is_ok() && grid.epoch > epoch {
                    done[usize::from(matches!(edits[0], Edit::Refine(_)))] += 1;
                }
                grid.validate(&grid.elements(|_| false)).unwrap();
            }
            assert!(done[0] > 100 && done[1] > 100, "{done:?}");
        }
    }

    #[test]
    fn an_edit_that_does_not_fit_changes_nothing() {
        let mut grid = Grid::uniform([9, 9], [1.0, 1.0]);
        let cell = |corner, size| Cell { corner, size };
        assert_eq!(grid.edit(&[Edit::Refine(cell([0, 0], 1))]), Err(Unfit::Leaves));
        assert_eq!(grid.edit(&[Edit::Coarsen(cell([1, 0], 2))]), Err(Unfit::Leaves));
        assert_eq!(grid.edit(&[Edit::Coarsen(cell([8, 0], 2))]), Err(Unfit::Leaves));
        let four = [[0, 0], [0, 2], [2, 0], [2, 2]].map(|c| Edit::Coarsen(cell(c, 2)));
        let too_far = [&four[..], &[Edit::Coarsen(cell([0, 0], 4))]].concat();
        assert_eq!(grid.edit(&too_far), Err(Unfit::Balance));
        assert_eq!((grid.epoch, grid.cells().len()), (0, 64));
        grid.edit(&four).unwrap();
        assert_eq!((grid.epoch, grid.cells().len()), (1, 52));
    }

    #[test]
    fn refinement_splits_the_larger_neighbours_first() {
        let mut grid = Grid::uniform([17, 17], [1.0, 1.0]);
        while let Some(coarse) = grid.coarsened() {
            grid = coarse;
        }
        assert_eq!(grid.cells().len(), 1);
        for _ in 0..4 {
            let edits = grid.refinement(grid.leaf([0, 0]));
            grid.edit(&edits).unwrap();
            grid.validate(&grid.elements(|_| false)).unwrap();
        }
        assert_eq!(grid.leaf([0, 0]).size, 1);
        assert_eq!(grid.leaf([15, 15]).size, 8, "16 was split for balance");
    }
}
