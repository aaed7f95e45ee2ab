//! Whether two rests are the same one.

use super::{Look, rounding_of_energy};
use crate::{math::Vec3, world::World};

/// Rests are on different branches where a particle of theirs is farther apart than this part of the sheet's side.
const BRANCH: f64 = 1e-3;

/// A place where a cloth came to rest.
pub struct Rest {
    /// Stored energy [J].
    pub energy: f64,
    /// Stored energy with contact [J], and its rounding.
    potential: [f64; 2],
    /// Norm over all free particles of the force out of balance [N].
    unbalanced: f64,
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
        let squares = free.map(|n| (gradient[n] - look.state.loads[n]).norm_squared());
        Rest {
            energy: look.report.energy,
            potential: [look.potential(&candidates), rounding_of_energy(&look)],
            unbalanced: squares.sum::<f64>().sqrt(),
            active: grid.active().collect(),
            side: grid.size[0].max(grid.size[1]),
            positions,
        }
    }

    /// Largest distance of a particle here and there [m].
    pub fn apart(&self, other: &Rest) -> f64 {
        self.ways(other).map(|way| way.norm()).fold(0.0, f64::max)
    }

    /// Whether it is the other one, found less exactly.
    ///
    /// They must be near. And were the potential convex between them, the higher would lie above the lower by no more than its slope times
    /// their distance: what lies higher than the forces out of balance account for rests in a bowl of its own.
    pub fn is_same(&self, other: &Rest) -> bool {
        let distance = self.ways(other).map(|way| way.norm_squared()).sum::<f64>().sqrt();
        let [a, b] = [self, other].map(|rest| rest.potential);
        let convex = (a[0] - b[0]).abs() <= self.unbalanced.max(other.unbalanced) * distance + a[1] + b[1];
        // On another mesh the potential is another one.
        self.apart(other) <= BRANCH * self.side && (convex || self.active != other.active)
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
        Rest { energy: 0.0, potential: [potential, 1e-15], unbalanced, active: vec![0], positions, side: 1.0 }
    }

    #[test]
    fn what_is_no_lower_than_its_slope_tells_is_the_same_rest() {
        // ½ k x² with 100 N/m, left 0.1 mm too early; and a dip of its own there.
        let bottom = rest(0.0, 0.0, 1e-9);
        let short = rest(1e-4, 0.5e-6, 1e-2);
        let dip = rest(1e-4, 0.5e-6, 1e-9);
        let far = rest(2e-3, 0.0, 1e-9);
        assert!(bottom.is_same(&short) && short.is_same(&bottom));
        assert!(!bottom.is_same(&dip) && !dip.is_same(&bottom));
        assert!(!bottom.is_same(&far));
        let finer = Rest { active: vec![0, 1], ..dip };
        assert!(bottom.is_same(&finer));
    }
}
