//! Whether a mesh is sound: what every edit must keep.

use super::{Cell, Cover, Elements, Grid, Status, tree::balanced};

/// A sum that makes rounding good [Neumaier 1974]: fifteen thousand areas would else sum to 1e-12 too much.
fn total(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut lost) = (0.0_f64, 0.0);
    for value in values {
        let next = sum + value;
        let [large, small] = if sum.abs() >= value.abs() { [sum, value] } else { [value, sum] };
        lost += (large - next) + small;
        sum = next;
    }
    sum + lost
}

impl Grid {
    /// Checks what every mesh must keep; says what is broken.
    ///
    /// Leaves tile the lattice and differ by a factor of two at the most; elements name active particles and ghosts only; masters
    /// are active and weights sum to one; areas of particles, edges, shears sum to the sheet's; no element is degenerate.
    pub fn validate(&self, elements: &Elements) -> Result<(), String> {
        self.validate_cells()?;
        self.validate_ghosts(elements)?;
        self.validate_elements(elements)
    }

    fn validate_cells(&self) -> Result<(), String> {
        let area: usize = self.cells().iter().map(Cell::intervals).sum();
        if area != self.cover.iter().filter(|c| **c != Cover::Nothing).count() {
            return Err(format!("the leaves cover {area} intervals"));
        }
        for cell in self.cells() {
            if self.cell_at(cell.corner, cell.size) != Some(*cell) {
                return Err(format!("{cell:?} does not lie in the lattice"));
            }
        }
        match (0..self.particles()).find(|&n| !balanced(self.site(n), &self.around(self.site(n)))) {
            Some(n) => Err(format!("around {:?} the leaves are out of balance", self.site(n))),
            None => Ok(()),
        }
    }

    fn validate_ghosts(&self, elements: &Elements) -> Result<(), String> {
        let [_, hanging] = self.tally();
        let linear = elements.ghosts.iter().filter(|g| (g.node as usize) < self.particles()).count();
        if linear != hanging {
            return Err(format!("{hanging} particles hang, {linear} have masters"));
        }
        for ghost in &elements.ghosts {
            if let Some(master) = ghost.masters.iter().find(|m| !self.is_active(m.0 as usize)) {
                return Err(format!("{ghost:?}: master {} is not active", master.0));
            }
            let sum: f64 = ghost.masters.iter().map(|m| m.1).sum();
            if (sum - 1.0).abs() > 1e-12 {
                return Err(format!("{ghost:?}: the weights sum to {sum}"));
            }
        }
        Ok(())
    }

    fn validate_elements(&self, elements: &Elements) -> Result<(), String> {
        let known = |n: &u32| {
            elements.ghost(*n).is_some() || (*n as usize) < self.particles() && self.is_active(*n as usize)
        };
        let [sheet, shears] = [
            total(self.cells().iter().flat_map(|c| self.shares(c))),
            total(elements.shears.iter().map(|s| s.area)),
        ];
        let along = |d: usize| elements.edges.iter().filter(move |e| e.direction == d);
        let edges = [0, 1].map(|d| total(along(d).map(|e| e.width * e.length)));
        let areas = [
            ("particles", total(elements.areas.iter().copied())),
            ("shears", shears),
            ("warp edges", edges[0]),
            ("weft edges", edges[1]),
        ];
        for (what, area) in areas {
            if (area / sheet - 1.0).abs() > 1e-12 {
                return Err(format!("the areas of {what} sum to {area} m², the sheet has {sheet} m²"));
            }
        }
        for (n, &area) in elements.areas.iter().enumerate() {
            let active = n < self.particles() && self.is_active(n);
            if active != (area > 0.0) {
                return Err(format!("node {n} has the area {area} m²"));
            }
        }
        if elements.shears.len() != self.cells().len() {
            return Err(format!("{} cells, {} shears", self.cells().len(), elements.shears.len()));
        }
        let sides: usize = self.triples_expected();
        if elements.triples.len() != sides {
            return Err(format!("{} triples, {sides} expected", elements.triples.len()));
        }
        if let Some(e) =
            elements.edges.iter().find(|e| !(e.nodes.iter().all(known) && e.length > 0.0 && e.width > 0.0))
        {
            return Err(format!("{e:?}"));
        }
        if let Some(s) = elements.shears.iter().find(|s| !s.nodes.iter().all(known)) {
            return Err(format!("{s:?}"));
        }
        let sound = |t: &&super::Triple| {
            let [previous, centre, next, _, _] = t.nodes;
            let apart = previous != centre && centre != next && next != previous;
            !(t.nodes.iter().all(known) && apart && t.span > 0.0 && t.area >= 0.0 && t.reach > 0.0)
        };
        if let Some(t) = elements.triples.iter().find(sound) {
            return Err(format!("{t:?}"));
        }
        Ok(())
    }

    /// Two triples per active particle less those that a border takes, one per hanging particle.
    fn triples_expected(&self) -> usize {
        let triples = |n: usize| match self.status(n) {
            Status::Active => {
                let site = self.site(n);
                let meets = |k: usize| [false, true].iter().all(|&f| self.next(site, k, f).is_some());
                (0..2).filter(|&k| meets(k)).count()
            }
            Status::Hanging(_) => 1,
            Status::Absent => 0,
        };
        (0..self.particles()).map(triples).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::super::*;
    use rand::{RngExt, SeedableRng};

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

    #[test]
    fn triples_cover_the_sheet_but_for_half_cells_at_its_border() {
        let mut random = rand_pcg::Pcg64::seed_from_u64(5);
        for _ in 0..20 {
            // Two fine rows at both ends of the warp, so that just half an interval is left there.
            let mut grid = Grid::uniform([29, 25], [28.0, 24.0]);
            for _ in 0..600 {
                let size = [0, 1].map(|_| 1 << random.random_range(0..3));
                let cell = Cell::around([random.random_range(4..24), random.random_range(0..24)], size);
                grid.edit_what_fits([Edit::Coarsen(cell)]);
            }
            assert!(grid.cells().iter().any(|c| c.size[0] != c.size[1]));
            let elements = grid.elements(|_| false);
            let along = elements.triples.iter().filter(|t| t.direction == 0);
            let area: f64 = along.map(|t| t.area).sum();
            assert!((area - 27.0 * 24.0).abs() < 1e-9, "{area}");
        }
    }
}
