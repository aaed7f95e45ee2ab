//! What a step's first solve leaves out of balance, told to the next one in advance.
//!
//! A mixed Newton step that is solved once leaves what goes with the square of its length, what its matrix lags behind, and what the
//! iteration does not reach. Under a hand that goes on, the next step would leave much the same: so that is made up for before it is left.
//! What is told, p, follows what two steps left, r and r′, by p ← 0.7 p + 0.3 (r + r′): of what stays the same a third is left then, and
//! what changes its sign from step to step is not told. Where telling left more than there was to tell, little is told until it helps again:
//! edges that change between tension and compression else let it grow. What presses is told nothing, as contact comes and goes, nor is a
//! cloth that nobody moves: where it falls, what is left is what takes many iterations, and telling makes them more.

use crate::{grid::Elements, math::Vec3, potential::contact::Touches};

/// Part of what was told that is told again, and parts of what the last two steps left that are told from then on.
const KEPT: f64 = 0.7;
const TAKEN: f64 = 0.3;
/// Part of its trust that is left where it did not help, and what it wins where it did.
const MISTRUST: f64 = 0.25;
const REGAINED: f64 = 0.25;

/// What steps left and will leave out of balance [N], per particle; zero for fixed ones.
pub(super) struct Remainder {
    told: Vec<Vec3>,
    left: Vec<Vec3>,
    /// Part of what is expected that is told.
    trust: f64,
    is_known: bool,
}

impl Remainder {
    /// Nothing, for a mesh of so many nodes.
    pub(super) fn new(nodes: usize) -> Remainder {
        let [told, left] = [(); 2].map(|()| vec![Vec3::zeros(); nodes]);
        Remainder { told, left, trust: 1.0, is_known: false }
    }

    /// Begins anew: after trouble, or where another cloth goes on.
    pub(super) fn forget(&mut self) {
        (self.trust, self.is_known) = (1.0, false);
    }

    /// A gradient [N] and what the next solve will leave of it, into `rhs`.
    pub(super) fn foretell(&self, elements: &Elements, gradient: &[Vec3], rhs: &mut [Vec3]) {
        if self.is_known {
            elements.present().for_each(|n| rhs[n] = gradient[n] + self.told[n]);
        } else {
            elements.copy(gradient, rhs);
        }
    }

    /// Learns what a solve that was told so left, by the gradient [N] where it led and by what presses there.
    pub(super) fn learn(
        &mut self,
        elements: &Elements,
        gradient: &[Vec3],
        touches: &Touches,
        fixed: &[bool],
    ) {
        if !self.is_known {
            self.told.fill(Vec3::zeros());
            self.left.fill(Vec3::zeros());
        }
        self.is_known = true;
        let (mut with, mut without) = (0.0, 0.0);
        for n in elements.present().filter(|&n| !fixed[n]) {
            with += gradient[n].norm_squared();
            without += (gradient[n] + self.told[n]).norm_squared();
        }
        self.trust = if with > without { self.trust * MISTRUST } else { (self.trust + REGAINED).min(1.0) };
        for n in elements.present() {
            let now = if fixed[n] { Vec3::zeros() } else { gradient[n] };
            let before = std::mem::replace(&mut self.left[n], now);
            self.told[n] = (self.told[n] * KEPT + (now + before) * TAKEN) * self.trust;
        }
        for n in touches.nodes() {
            elements.each_master(n, |m, _| {
                (self.told[m as usize], self.left[m as usize]) = (Vec3::zeros(), Vec3::zeros());
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Grid;

    /// What is left on a particle, tick by tick, where a solve leaves what there is to leave [N] less what it was told.
    fn left(loads: impl IntoIterator<Item = f64>) -> Vec<f64> {
        let elements = Grid::uniform([3, 3], [0.1, 0.1]).elements(|_| false);
        let (mut remainder, fixed) = (Remainder::new(9), [false; 9]);
        let (none, mut told) = ([Vec3::zeros(); 9], [Vec3::zeros(); 9]);
        let left = |load: f64| {
            remainder.foretell(&elements, &none, &mut told);
            let mut gradient = none;
            gradient[4].y = load - told[4].y;
            remainder.learn(&elements, &gradient, &Touches::default(), &fixed);
            gradient[4].y
        };
        loads.into_iter().map(left).collect()
    }

    #[test]
    fn of_what_stays_the_same_a_third_is_left() {
        let left = left([2.0; 40]);
        assert_eq!(left[0], 2.0);
        assert!((left[39] - 2.0 / 3.0).abs() < 1e-9, "{left:?}");
        assert!(left.iter().all(|r| (0.0..=2.0).contains(r)), "{left:?}");
    }

    #[test]
    fn what_changes_its_sign_is_hardly_told() {
        let left = left((0..40).map(|k| if k % 2 == 0 { 1.0 } else { -1.0 }));
        assert!(left[10..].iter().all(|r| (r.abs() - 1.0).abs() < 0.05), "{left:?}");
    }

    #[test]
    fn what_comes_every_third_time_does_not_grow() {
        let left = left((0..60).map(|k| if k % 3 == 0 { 1.0 } else { 0.0 }));
        assert!(left.iter().all(|r| r.abs() < 1.01), "{left:?}");
        let sum = |of: &mut dyn Iterator<Item = &f64>| of.map(|r| r * r).sum::<f64>();
        assert!(sum(&mut left[30..].iter()) < 1.1 * 10.0, "{left:?}");
    }

    #[test]
    fn fixed_particles_are_told_nothing_and_all_is_forgotten() {
        let elements = Grid::uniform([3, 3], [0.1, 0.1]).elements(|_| false);
        let mut remainder = Remainder::new(9);
        let (gradient, none) = ([Vec3::x(); 9], [Vec3::zeros(); 9]);
        let mut fixed = [false; 9];
        fixed[2] = true;
        remainder.learn(&elements, &gradient, &Touches::default(), &fixed);
        let mut told = none;
        remainder.foretell(&elements, &none, &mut told);
        assert!(told[2] == Vec3::zeros() && told[4].x > 0.0, "{told:?}");
        remainder.forget();
        remainder.foretell(&elements, &none, &mut told);
        assert_eq!(told, none);
        // What was learnt before is no part of what is told from then on, were it not a number.
        remainder.learn(&elements, &[Vec3::repeat(f64::NAN); 9], &Touches::default(), &fixed);
        remainder.forget();
        remainder.learn(&elements, &gradient, &Touches::default(), &fixed);
        remainder.foretell(&elements, &none, &mut told);
        assert_eq!(told[4], Vec3::x() * TAKEN);
    }
}
