//! Which leaf covers what, and edits that merge leaves or split one.

use super::{Cell, Cover, Direction, Grid, Levels, Site, Status};

/// A change of the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Edit {
    /// Splits this leaf in half along warp and weft: into four, or two where it is of the finest size one way.
    Refine(Cell),
    /// Splits this leaf in half along one direction.
    Halve(Cell, Direction),
    /// Merges the leaves within this cell, all of them halves of it along one direction or both.
    Coarsen(Cell),
}

impl Edit {
    /// The leaf that is split, or made.
    pub fn cell(&self) -> Cell {
        let (Edit::Refine(cell) | Edit::Halve(cell, _) | Edit::Coarsen(cell)) = *self;
        cell
    }

    /// Whether it merges.
    pub fn merges(&self) -> bool {
        matches!(self, Edit::Coarsen(_))
    }

    fn split(cell: Cell, along: [bool; 2]) -> Option<Edit> {
        match [0, 1].map(|k| along[k] && cell.size[k] > 1) {
            [true, true] => Some(Edit::Refine(cell)),
            [true, false] => Some(Edit::Halve(cell, 0)),
            [false, true] => Some(Edit::Halve(cell, 1)),
            [false, false] => None,
        }
    }

    /// The levels of the leaves within its cell, when it is made.
    fn levels(&self) -> Levels {
        let levels = self.cell().levels();
        match *self {
            Edit::Refine(_) => levels.map(|level| level.saturating_sub(1)),
            Edit::Halve(_, along) => [0, 1].map(|k| levels[k].saturating_sub(u8::from(k == along))),
            Edit::Coarsen(_) => levels,
        }
    }
}

/// Why an edit does not fit the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// The cell to split is no leaf, or is of the finest size; or those to merge are no whole leaves of the sheet.
    #[error("no such leaves")]
    Leaves,
    /// A neighbour would differ by more than a factor of two, or a particle hang on one that hangs itself.
    #[error("a neighbour would differ by more than a factor of two")]
    Balance,
}

/// The leaves around a site: `[low or high side in i][in j]`, `None` outside the sheet.
type Around = [[Option<Levels>; 2]; 2];

impl Grid {
    /// Makes edits, in order, all or none of them; the mesh must be in balance when all are made. The epoch rises if there are any.
    pub fn edit(&mut self, edits: &[Edit]) -> Result<(), Unfit> {
        let before = self.levels.clone();
        let made = edits.iter().try_for_each(|&edit| {
            self.has_leaves(edit)?;
            self.set(edit);
            Ok(())
        });
        let sites = || edits.iter().flat_map(|edit| rim(&edit.cell()));
        let is_balanced = || sites().all(|site| balanced(site, &self.around(site)));
        if let Err(unfit) = made.and_then(|()| is_balanced().then_some(()).ok_or(Unfit::Balance)) {
            self.levels = before;
            return Err(unfit);
        }
        self.finish(edits);
        Ok(())
    }

    /// Whether an edit fits the mesh.
    pub fn fits(&self, edit: Edit) -> Result<(), Unfit> {
        self.has_leaves(edit)?;
        if rim(&edit.cell()).all(|site| balanced(site, &self.around_after(site, edit))) {
            Ok(())
        } else {
            Err(Unfit::Balance)
        }
    }

    fn has_leaves(&self, edit: Edit) -> Result<(), Unfit> {
        let cell = edit.cell();
        let changes = edit.merges() || edit.levels() != cell.levels();
        let is_there = changes && self.cell_at(cell.corner, cell.size).is_some();
        let has_leaves =
            is_there && if edit.merges() { self.is_tiled(&cell) } else { self.is_whole_leaf(&cell) };
        has_leaves.then_some(()).ok_or(Unfit::Leaves)
    }

    /// Makes those of the edits that fit, in order; returns them. The epoch rises if there are any.
    pub fn edit_what_fits(&mut self, edits: impl IntoIterator<Item = Edit>) -> Vec<Edit> {
        let mut made = |edit: &Edit| self.fits(*edit).map(|()| self.set(*edit)).is_ok();
        let done: Vec<Edit> = edits.into_iter().filter(&mut made).collect();
        self.finish(&done);
        done
    }

    /// Splits leaves, and the larger neighbours that stand in the way; returns all edits.
    pub fn refine(&mut self, cells: impl IntoIterator<Item = Cell>) -> Vec<Edit> {
        self.refine_along(cells.into_iter().map(|cell| (cell, [true; 2])))
    }

    /// The same along warp, weft or both.
    pub fn refine_along(&mut self, cells: impl IntoIterator<Item = (Cell, [bool; 2])>) -> Vec<Edit> {
        let mut edits = Vec::new();
        cells.into_iter().for_each(|(cell, along)| self.split(cell, along, &mut edits));
        self.finish(&edits);
        edits
    }

    fn finish(&mut self, edits: &[Edit]) {
        if !edits.is_empty() {
            self.rebuild();
            self.epoch += 1;
        }
    }

    fn split(&mut self, cell: Cell, along: [bool; 2], edits: &mut Vec<Edit>) {
        let Some(edit) = Edit::split(cell, along).filter(|&edit| self.has_leaves(edit).is_ok()) else {
            return;
        };
        self.set(edit);
        edits.push(edit);
        // Every split leaves smaller leaves, so this ends.
        while let Some((other, along)) = rim(&cell).find_map(|site| self.too_long_at(site)) {
            self.split(other, along, edits);
        }
    }

    /// A leaf around a site that is out of balance with the others, and along what it is too long.
    fn too_long_at(&self, site: Site) -> Option<(Cell, [bool; 2])> {
        let around = self.around(site);
        let too_long = too_long(site, &around);
        [[0, 0], [0, 1], [1, 0], [1, 1]].into_iter().find_map(|[a, b]| {
            let along = too_long(around[a][b]?);
            (along != [false; 2]).then(|| (self.leaf([site[0] + a - 1, site[1] + b - 1]), along))
        })
    }

    /// The leaf that covers the interval whose corner nearest (0, 0) is `corner`.
    pub fn leaf(&self, corner: Site) -> Cell {
        self.leaf_of(self.interval(corner))
    }

    /// The leaves that a site lies in or on; one that it lies inside, or on a side of, several times.
    pub fn cells_at(&self, site: Site) -> impl Iterator<Item = Cell> {
        let low = site.map(|k| k.saturating_sub(1));
        let last = [0, 1].map(|k| site[k].min(self.counts[k] - 2));
        [low, [low[0], last[1]], [last[0], low[1]], last].into_iter().map(|place| self.leaf(place))
    }

    /// The cell of this size at a corner, where the lattice has one.
    pub fn cell_at(&self, corner: Site, size: [usize; 2]) -> Option<Cell> {
        let cell = Cell { corner, size };
        let has = |k: usize| {
            size[k].is_power_of_two() && corner[k].is_multiple_of(size[k]) && cell.end()[k] < self.counts[k]
        };
        (has(0) && has(1)).then_some(cell)
    }

    /// The mesh with four leaves merged wherever that fits, else two along their shorter sides, the finest first, and its epoch
    /// unchanged: the next coarser level of a multigrid. `None` where nothing can be merged.
    pub fn coarsened(&self) -> Option<Grid> {
        let mut coarse = self.clone();
        let mut sizes: Vec<[usize; 2]> = self.cells.iter().map(|c| c.size).collect();
        sizes.sort_unstable_by_key(|size| (size[0] * size[1], *size));
        sizes.dedup();
        let mut merged = false;
        // From the finest: what merges makes room for its larger neighbours. Only leaves of this mesh merge, each once.
        for size in sizes {
            let mut ways = vec![[true, true]];
            ways.extend((size[0] != size[1]).then_some([size[0] < size[1], size[1] < size[0]]));
            for way in ways {
                let larger = [0, 1].map(|k| if way[k] { 2 * size[k] } else { size[k] });
                for cell in self.cells.iter().filter(|c| c.size == size) {
                    let parent = Cell::around(cell.corner, larger);
                    let edit = Edit::Coarsen(parent);
                    let first = parent.corner == cell.corner;
                    if first && self.is_tiled_by(&parent, size) && coarse.fits(edit).is_ok() {
                        coarse.set(edit);
                        merged = true;
                    }
                }
            }
        }
        merged.then(|| {
            coarse.rebuild();
            coarse
        })
    }

    /// Intervals of a cell, one in each quarter of it.
    fn quarters(&self, cell: &Cell) -> impl Iterator<Item = usize> {
        let [i, j] = [0, 1].map(|k| (cell.corner[k]..cell.end()[k]).step_by((cell.size[k] / 2).max(1)));
        i.flat_map(move |a| j.clone().map(move |b| [a, b])).map(|corner| self.interval(corner))
    }

    /// Whether halves or quarters of a cell tile it, uncut.
    fn is_tiled(&self, cell: &Cell) -> bool {
        let levels = cell.levels();
        // A leaf that is at least half as long as the cell both ways covers a quarter of it.
        self.quarters(cell).all(|n| {
            let is_part = |k: usize| self.levels[n][k] <= levels[k] && self.levels[n][k] + 1 >= levels[k];
            self.cover[n] == Cover::Whole && is_part(0) && is_part(1) && self.levels[n] != levels
        })
    }

    /// Whether leaves of one size, half of the cell's or more, tile it.
    fn is_tiled_by(&self, cell: &Cell, size: [usize; 2]) -> bool {
        let inside = self.cell_at(cell.corner, cell.size).is_some();
        inside && self.quarters(cell).all(|n| self.leaf_of(n).size == size && self.cover[n] == Cover::Whole)
    }

    fn is_whole_leaf(&self, cell: &Cell) -> bool {
        let n = self.interval(cell.corner);
        self.levels[n] == cell.levels() && self.cover[n] == Cover::Whole
    }

    fn set(&mut self, edit: Edit) {
        let cell = edit.cell();
        for i in cell.corner[0]..cell.end()[0] {
            let first = self.interval([i, cell.corner[1]]);
            self.levels[first..first + cell.size[1]].fill(edit.levels());
        }
    }

    fn interval(&self, corner: Site) -> usize {
        corner[0] * (self.counts[1] - 1) + corner[1]
    }

    pub(super) fn leaf_of(&self, interval: usize) -> Cell {
        let across = self.counts[1] - 1;
        Cell::around([interval / across, interval % across], self.levels[interval].map(|level| 1 << level))
    }

    /// The leaves around a site.
    pub(super) fn around(&self, site: Site) -> Around {
        self.around_by(site, |n, _| self.levels[n])
    }

    fn around_after(&self, site: Site, edit: Edit) -> Around {
        let (cell, levels) = (edit.cell(), edit.levels());
        let (corner, end) = (cell.corner, cell.end());
        let is_within = |at: Site| (0..2).all(|k| (corner[k]..end[k]).contains(&at[k]));
        self.around_by(site, |n, at| if is_within(at) { levels } else { self.levels[n] })
    }

    fn around_by(&self, site: Site, levels: impl Fn(usize, Site) -> Levels) -> Around {
        let at = |di: usize, dj: usize| {
            let (i, j) = ((site[0] + di).checked_sub(1)?, (site[1] + dj).checked_sub(1)?);
            let inside = i + 1 < self.counts[0] && j + 1 < self.counts[1];
            let n = inside.then(|| self.interval([i, j]))?;
            (self.cover[n] != Cover::Nothing).then(|| levels(n, [i, j]))
        };
        [[at(0, 0), at(0, 1)], [at(1, 0), at(1, 1)]]
    }

    /// Makes cells and the particles' status from the levels.
    pub(super) fn rebuild(&mut self) {
        self.cells.clear();
        for i in 0..self.counts[0] - 1 {
            for j in 0..self.counts[1] - 1 {
                let n = self.interval([i, j]);
                let leaf = self.leaf_of(n);
                if leaf.corner == [i, j] && self.cover[n] != Cover::Nothing {
                    self.cells.push(leaf);
                }
            }
        }
        let sites = (0..self.particles()).map(|n| self.site(n));
        self.status = sites.map(|site| status(site, &self.around(site))).collect();
        self.active = (0..self.particles() as u32).filter(|&n| self.is_active(n as usize)).collect();
    }
}

/// The sites on the sides of a cell.
fn rim(cell: &Cell) -> impl Iterator<Item = Site> + use<> {
    let ([i, j], [last_i, last_j]) = (cell.corner, cell.end());
    let along_i = (i..=last_i).flat_map(move |a| [[a, j], [a, last_j]]);
    along_i.chain((j + 1..last_j).flat_map(move |b| [[i, b], [last_i, b]]))
}

/// Whether a site lies on the lines through a leaf's sides: `[in i, in j]`.
fn on_lines(site: Site, levels: Levels) -> [bool; 2] {
    [0, 1].map(|k| site[k].is_multiple_of(1 << levels[k]))
}

fn is_corner(site: Site, levels: Levels) -> bool {
    on_lines(site, levels) == [true; 2]
}

/// What the leaves around a site make of its particle.
fn status(site: Site, around: &Around) -> Status {
    let mut lines = around.iter().flatten().flatten().map(|&levels| on_lines(site, levels));
    let Some(first) = lines.next() else { return Status::Absent };
    let (least, most) = lines.fold((first, first), |(least, most), on| (least.min(on), most.max(on)));
    match (least, most) {
        ([true, true], _) => Status::Active,
        (_, most) if most != [true, true] => Status::Absent,
        ([false, true], _) => Status::Hanging(0),
        ([true, false], _) => Status::Hanging(1),
        _ => Status::Absent,
    }
}

/// Whether the leaves around a site are in balance: none of them is too long.
pub(super) fn balanced(site: Site, around: &Around) -> bool {
    let too_long = too_long(site, around);
    around.iter().flatten().flatten().all(|levels| too_long(*levels) == [false; 2])
}

/// Along what a leaf around a site is more than twice as long as another, or, where two meet in the middle of a larger one's side,
/// longer than the other: else a particle would hang on one that hangs itself.
fn too_long(site: Site, around: &Around) -> impl Fn(Levels) -> [bool; 2] {
    let leaves = || around.iter().flatten().flatten().copied();
    let least = [0, 1].map(|k| leaves().map(|levels| levels[k]).min().unwrap_or(0));
    let across = match status(site, around) {
        Status::Hanging(along) => Some(1 - along),
        _ => None,
    };
    let meeting = leaves().filter(|levels| is_corner(site, *levels));
    let shortest = across.and_then(|k| meeting.map(|levels| levels[k]).min()).unwrap_or(0);
    move |levels| {
        [0, 1].map(|k| {
            let is_too_long_there = across == Some(k) && is_corner(site, levels) && levels[k] > shortest;
            levels[k] > least[k] + 1 || is_too_long_there
        })
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
                    let along = [[2, 2], [2, 1], [1, 2]][random.random_range(0..3)];
                    let size = [0, 1].map(|k| along[k] * leaf.size[k]);
                    vec![Edit::Coarsen(Cell::around(leaf.corner, size))]
                } else {
                    let along = [[true, true], [true, false], [false, true]][random.random_range(0..3)];
                    grid.clone().refine_along([(leaf, along)])
                };
                let epoch = grid.epoch;
                if grid.edit(&edits).is_ok() && grid.epoch > epoch {
                    done[usize::from(edits[0].merges())] += 1;
                }
                grid.validate(&grid.elements(|_| false)).unwrap();
            }
            assert!(done[0] > 100 && done[1] > 100, "{done:?}");
        }
    }

    #[test]
    fn an_edit_that_does_not_fit_changes_nothing() {
        let mut grid = Grid::uniform([9, 9], [1.0, 1.0]);
        let cell = Cell::square;
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
            let edits = grid.clone().refine([grid.leaf([0, 0])]);
            grid.edit(&edits).unwrap();
            grid.validate(&grid.elements(|_| false)).unwrap();
        }
        assert_eq!(grid.leaf([0, 0]).size, [1, 1]);
        assert_eq!(grid.leaf([15, 15]).size, [8, 8], "16 was split for balance");
    }
}
