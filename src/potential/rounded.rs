//! Squared lengths of vectors that are 1 at rest, rounded off where they vanish: P(s) = s from s = c on, s + c (1 − s/c)³/3 below.
//!
//! Directions, and angles between directions, have derivatives that grow as one over the length. Where a fold is sharper than a cell,
//! opposite sides of the cell go opposite ways and their mean is next to nothing: a thousandth of a side pulled with newtons, by a stiffness
//! of 1e5 N/m, and no Newton step went past it. Rounded off, directions fade out there. P and its first two derivatives go on
//! smoothly at c, so cells that a mesh resolves are measured exactly.

use crate::math::pack::Pack;
use pulp::Simd;

/// Square c from which on nothing is rounded: mean sides that are half as long as at rest, or areas that are half as large.
pub const FROM: f64 = 0.25;

/// A rounded square P, and the derivatives of P^(-1/2) by the vector v whose square it stands for: −first · v P^(-1/2), and in the second
/// (second · v vᵀ − first) P^(-1/2).
#[derive(Clone, Copy, Debug)]
pub struct Rounded {
    /// 1/P.
    pub inverse: f64,
    /// P′/P.
    pub first: f64,
    /// 3 (P′/P)² − 2 P″/P.
    pub second: f64,
}

impl Rounded {
    /// Of a square.
    pub fn new(square: f64) -> Rounded {
        let lacks = (1.0 - square / FROM).max(0.0);
        let inverse = 1.0 / (square + FROM / 3.0 * lacks * lacks * lacks);
        let first = (1.0 - lacks * lacks) * inverse;
        Rounded { inverse, first, second: 3.0 * first * first - 4.0 / FROM * lacks * inverse }
    }
}

/// The same per lane.
#[derive(Clone, Copy)]
pub struct RoundedLanes<S: Simd> {
    /// 1/P.
    pub inverse: Pack<S>,
    /// P′/P.
    pub first: Pack<S>,
    lacks: Pack<S>,
}

impl<S: Simd> RoundedLanes<S> {
    /// Of squares.
    #[inline(always)]
    pub fn new(square: Pack<S>) -> RoundedLanes<S> {
        let one = square.like(1.0);
        let lacks = (one - square * one.like(1.0 / FROM)).max(one.like(0.0));
        let missing = lacks * lacks;
        let inverse = (missing * lacks).mul_add(one.like(FROM / 3.0), square).inverse();
        RoundedLanes { inverse, first: (one - missing) * inverse, lacks }
    }

    /// 3 (P′/P)² − 2 P″/P.
    #[inline(always)]
    pub fn second(&self) -> Pack<S> {
        let three = self.first.like(3.0);
        three * self.first * self.first - self.lacks * self.inverse * three.like(4.0 / FROM)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_square_from_the_bound_on_and_its_derivatives_are_those_of_differences_below() {
        let whole = Rounded::new(0.7);
        assert_eq!([whole.inverse, whole.first], [1.0 / 0.7, 1.0 / 0.7]);
        assert!((whole.second - 3.0 / 0.49).abs() < 1e-14);
        let root = |s: f64| Rounded::new(s).inverse.sqrt();
        for s in [0.01, 0.1, 0.2, 0.249, 0.251, 0.4] {
            let Rounded { first, second, .. } = Rounded::new(s);
            // With v = √s: d/dv of P^(-1/2) is −first v P^(-1/2), and d²/dv² is (second s − first) P^(-1/2).
            let v = f64::sqrt(s);
            let step = 1e-4;
            let [before, now, behind] = [v - step, v, v + step].map(|v| root(v * v));
            let slope = (behind - before) / (2.0 * step);
            let curvature = (behind - 2.0 * now + before) / (step * step);
            assert!((slope + first * v * now).abs() < 1e-5 * now, "{s}: {slope}");
            assert!((curvature - (second * s - first) * now).abs() < 1e-3 * now, "{s}: {curvature}");
        }
        assert!(Rounded::new(0.0).inverse <= 3.0 / FROM, "what vanishes is not divided by");
    }
}
