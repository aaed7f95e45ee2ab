//! Whether two rests are the same one.

use super::{Look, rounding_of_energy};
use crate::{math::Vec3, world::World};

/// Rests are on different branches where a particle of theirs is farther apart than this part of the sheet's side.
const BRANCH: f64 = 1e-3;
/// Places on the way between two rests at which a hill is looked for.
const PLACES: u32 = 64;

/// A place where a cloth came to rest.
pub struct Rest {
    /// Stored energy [J].
    pub energy: f64,
    /// Stored energy with contact [J], and its rounding.
    potential: [f64; 2],
    /// Norm over all free particles of the force out of balance [N].
    unbalanced: f64,
    /// Dead loads that hold it [N].
    loads: Vec<Vec3>,
    active: Vec<usize>,
    positions: Vec<Vec3>,
    side: f64,
}

impl Rest {
    /// Where a world is.
    pub fn of(world: &World) -> Rest {
        let (look, grid) = (Look::at(world), world.grid());
        let candidates = look.candidates();
        let positions = look.state.positions.clone();
        let gradient = look.gradient(look.state, &candidates, &positions);
        let free = grid.active().filter(|n| world.reaction(grid.site(*n)).is_none());
        let squares = free.map(|n| (gradient[n] - look.state.load(n)).norm_squared());
        Rest {
            energy: look.report.energy,
            potential: [look.potential(&candidates, &positions), rounding_of_energy(&look)],
            unbalanced: squares.sum::<f64>().sqrt(),
            loads: look.state.all_loads(),
            active: grid.active().collect(),
            side: grid.size[0].max(grid.size[1]),
            positions,
        }
    }

    /// Largest distance of a particle here and there [m].
    pub fn apart(&self, other: &Rest) -> f64 {
        self.ways(other).map(|way| way.norm()).fold(0.0, f64::max)
    }

    /// By how much energies of this and the other rest on the same mesh, in its `potential` of positions [J], may differ as they are held
    /// otherwise [J].
    ///
    /// Merged elements of one may have rests that the other's have not: its potential here shows what they make. And in a convex potential
    /// energies differ by no more than the work of dead loads, those of this or of the other, over the way between.
    pub fn held_apart(&self, other: &Rest, potential: impl Fn(&[Vec3]) -> f64) -> f64 {
        let works = [self, other].map(|rest| {
            let works = rest.loads.iter().zip(self.ways(other)).map(|(load, way)| load.dot(&way));
            works.sum::<f64>().abs()
        });
        works[0].max(works[1]) + (potential(&self.positions) - self.potential[0]).abs()
    }

    /// Whether it is the other one, found less exactly, in a `potential` of positions [J].
    ///
    /// They must be on one mesh, as merged elements have rests at which they pull as those did that they stand for, so what they store is
    /// not what those stored: 9.5 mJ on 24 particles where on 27 it would be 14.3. They must be near. And were the potential convex between
    /// them, the higher would lie above the lower by no more than its slope times their distance: what lies higher than the forces out of
    /// balance account for, and beyond a hill, rests in a bowl of its own.
    pub fn is_same(&self, other: &Rest, potential: impl Fn(&[Vec3]) -> f64) -> bool {
        let is_near = self.apart(other) <= BRANCH * self.side;
        self.shares_mesh(other)
            && is_near
            && !(self.is_beyond_slope(other) && self.is_beyond_hill(other, potential))
    }

    /// Whether the same particles are active in both.
    pub fn shares_mesh(&self, other: &Rest) -> bool {
        self.active == other.active
    }

    /// Whether the forces out of balance do not account for the difference of the energies.
    fn is_beyond_slope(&self, other: &Rest) -> bool {
        let distance = self.ways(other).map(|way| way.norm_squared()).sum::<f64>().sqrt();
        let [a, b] = [self, other].map(|rest| rest.potential);
        (a[0] - b[0]).abs() > self.unbalanced.max(other.unbalanced) * distance + a[1] + b[1]
    }

    /// Whether the potential on the straight way there is somewhere higher than at both ends.
    fn is_beyond_hill(&self, other: &Rest, potential: impl Fn(&[Vec3]) -> f64) -> bool {
        let [a, b] = [self, other].map(|rest| rest.potential);
        let height = a[0].max(b[0]) + a[1] + b[1];
        let mut places = (1..PLACES).map(|place| f64::from(place) / f64::from(PLACES));
        places.any(|part| {
            let way = self.ways(other);
            let place: Vec<Vec3> = self.positions.iter().zip(way).map(|(x, way)| x - way * part).collect();
            potential(&place) > height
        })
    }

    fn ways(&self, other: &Rest) -> impl Iterator<Item = Vec3> {
        self.positions.iter().zip(&other.positions).map(|(a, b)| a - b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A single particle in a potential of so many joule, so many newton out of balance.
    fn rest(x: f64, potential: f64, unbalanced: f64) -> Rest {
        let positions = vec![Vec3::new(x, 0.0, 0.0)];
        let loads = vec![Vec3::zeros()];
        Rest {
            energy: 0.0,
            potential: [potential, 1e-15],
            unbalanced,
            loads,
            active: vec![0],
            positions,
            side: 1.0,
        }
    }

    #[test]
    fn what_no_slope_accounts_for_rests_beyond_a_hill() {
        // ½ k x² with 100 N/m, left 0.1 mm too early; and a dip of its own there, 0.3 µJ deep.
        let bowl = |x: &[Vec3]| 50.0 * x[0].x * x[0].x;
        let hill = |x: &[Vec3]| bowl(x) - if (x[0].x - 1e-4).abs() < 2e-5 { 0.3e-6 } else { 0.0 };
        let bottom = rest(0.0, 0.0, 1e-9);
        let short = rest(1e-4, 0.5e-6, 1e-2);
        let dip = rest(1e-4, 0.2e-6, 1e-9);
        let far = rest(2e-3, 0.0, 1e-9);
        assert!(bottom.is_same(&short, bowl) && short.is_same(&bottom, bowl));
        assert!(!bottom.is_same(&dip, hill) && !dip.is_same(&bottom, hill));
        // Said to be in balance, with nothing between them: no branch, but for the judge to tell of.
        let wrong = rest(1e-4, 0.5e-6, 1e-9);
        assert!(bottom.is_same(&wrong, bowl));
        assert!(!bottom.is_same(&far, bowl));
        let finer = Rest { active: vec![0, 1], ..dip };
        assert!(!bottom.shares_mesh(&finer) && !bottom.is_same(&finer, bowl));
    }

    #[test]
    fn energies_of_rests_differ_by_what_holds_them_apart() {
        // ½ k x² with 100 N/m, held 0.1 mm beside its bottom by 10 mN: 0.5 µJ higher, for 1 µJ of work.
        let bowl = |x: &[Vec3]| 50.0 * x[0].x * x[0].x;
        let bottom = rest(0.0, 0.0, 1e-9);
        let held = Rest { loads: vec![Vec3::x() * 1e-2], ..rest(1e-4, 0.5e-6, 1e-9) };
        for apart in [bottom.held_apart(&held, bowl), held.held_apart(&bottom, bowl)] {
            assert!((apart - 1e-6).abs() < 1e-18, "{apart}");
        }
        let short = rest(1e-4, 0.5e-6, 1e-2);
        assert_eq!(bottom.held_apart(&short, bowl), 0.0);
        let higher = bottom.held_apart(&short, |x| bowl(x) + 0.3e-6);
        assert!((higher - 0.3e-6).abs() < 1e-18, "{higher}");
    }
}
