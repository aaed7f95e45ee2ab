//! What is left of a curvature that has no normal: where a fold or the tip of a cone is sharper than the mesh, the tangents a along a line and
//! b across it are parallel, or b is next to nothing, and the normal of a × b turns about at once.
//!
//! There a thousandth of a side pulled with newtons, by a stiffness of 1e5 N/m, and no Newton step went past it. So the chord of a bend
//! fades with the square s of what of b is across a: F(s) = 1 from s = c on, 1 − (1 − s/c)³ below. A line that folds itself, whose a
//! vanishes, does not fade: a fold must cost energy.

use crate::math::{
    Mat3, Vec3,
    block::Block,
    pack::{Pack, Pack3, axpy, dot, scale},
};
use pulp::Simd;

/// Square c from which on nothing fades: tangents at 30°, or neighbours across half as far apart as at rest.
const FROM: f64 = 0.25;
/// Squared rounding of |a|.
const ROUNDING: f64 = 1e-6;
/// Part by which rounding may make s smaller than |a × b|²/|a|².
const MARGIN: f64 = 1.001;

/// F of two vectors a and b.
#[derive(Clone, Copy, Debug)]
pub struct Fade {
    /// F.
    pub value: f64,
    /// F′ and F″.
    slopes: [f64; 2],
    a: Vec3,
    /// Part of b across a, over what a is of the part along it.
    across: Vec3,
    along: f64,
    /// 1/|a|².
    inverse: f64,
}

impl Fade {
    /// Of a and b.
    pub fn new(a: Vec3, b: Vec3) -> Fade {
        let inverse = 1.0 / (a.norm_squared() + ROUNDING);
        let along = a.dot(&b) * inverse;
        let across = b - a * along;
        let lacks = (1.0 - b.dot(&across) / FROM).max(0.0);
        let slopes = [3.0 / FROM * lacks * lacks, -6.0 / (FROM * FROM) * lacks];
        Fade { value: 1.0 - lacks * lacks * lacks, slopes, a, across, along, inverse }
    }

    /// ∂F/∂(a, b).
    pub fn gradient(&self) -> [Vec3; 2] {
        let by_b = self.across * (2.0 * self.slopes[0]);
        [by_b * -self.along, by_b]
    }

    /// ∂²F over (a, b): the blocks aa, ab, bb.
    pub fn hessian(&self) -> [Mat3; 3] {
        let Fade { slopes: [first, second], a, across: p, along: w, inverse, .. } = *self;
        // s is curved by 2 (|db − w da|² − (a·(db − w da) + p·da)²/|a|²).
        let (one, tilt) = (Mat3::identity(), p - a * w);
        let outer = |u: Vec3, v: Vec3| u * v.transpose();
        let (by_slope, by_curve) = (2.0 * first, outer(p, p) * (4.0 * second));
        [
            (one * (w * w) - outer(tilt, tilt) * inverse) * by_slope + by_curve * (w * w),
            (one * -w - outer(tilt, a) * inverse) * by_slope - by_curve * w,
            (one - outer(a, a) * inverse) * by_slope + by_curve,
        ]
    }
}

/// The same per lane.
#[derive(Clone, Copy)]
pub struct FadeLanes<S: Simd> {
    /// F.
    pub value: Pack<S>,
    /// What else there is, where anything fades.
    partial: Option<Partial<S>>,
}

#[derive(Clone, Copy)]
struct Partial<S: Simd> {
    slopes: [Pack<S>; 2],
    a: Pack3<S>,
    across: Pack3<S>,
    along: Pack<S>,
    inverse: Pack<S>,
}

impl<S: Simd> FadeLanes<S> {
    /// Of a and b with such a square of a × b.
    #[inline(always)]
    pub fn new(a: Pack3<S>, b: Pack3<S>, square: Pack<S>) -> FadeLanes<S> {
        let one = square.like(1.0);
        let length = dot(a, a);
        if square.less(length * one.like(MARGIN * FROM)).is_empty() {
            return FadeLanes { value: one, partial: None };
        }
        let inverse = (length + one.like(ROUNDING)).inverse();
        let along = dot(a, b) * inverse;
        let across = axpy(a, -along, b);
        let lacks = (one - dot(b, across) * one.like(1.0 / FROM)).max(one.like(0.0));
        let slopes = [lacks * lacks * one.like(3.0 / FROM), lacks * one.like(-6.0 / (FROM * FROM))];
        let partial = Partial { slopes, a, across, along, inverse };
        FadeLanes { value: one - lacks * lacks * lacks, partial: Some(partial) }
    }

    /// ∂F/∂(a, b), where anything fades.
    #[inline(always)]
    pub fn gradient(&self) -> Option<[Pack3<S>; 2]> {
        let Partial { slopes, across, along, .. } = self.partial?;
        let by_b = scale(across, slopes[0] + slopes[0]);
        Some([scale(by_b, -along), by_b])
    }

    /// ∂²F over (a, b), where anything fades: the blocks aa, ab, bb.
    #[inline(always)]
    pub fn hessian(&self) -> Option<[Block<S>; 3]> {
        let Partial { slopes: [first, second], a, across: p, along: w, inverse } = self.partial?;
        let tilt = axpy(a, -w, p);
        let (by_slope, by_curve) = (first + first, second * second.like(4.0));
        let (turned, curved) = (-(by_slope * inverse), scale(p, by_curve));
        Some([
            Block::diagonal(by_slope * w * w)
                .plus_outer(scale(tilt, turned), tilt)
                .plus_outer(scale(curved, w * w), p),
            Block::diagonal(-(by_slope * w))
                .plus_outer(scale(tilt, turned), a)
                .plus_outer(scale(curved, -w), p),
            Block::diagonal(by_slope).plus_outer(scale(a, turned), a).plus_outer(curved, p),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn its_derivatives_are_those_of_differences_and_nothing_fades_that_has_a_normal() {
        let whole = Fade::new(Vec3::new(0.1, 0.9, 0.2), Vec3::new(0.6, 0.3, 0.1));
        assert_eq!((whole.value, whole.gradient()), (1.0, [Vec3::zeros(); 2]));
        let (a, b) = (Vec3::new(0.3, 0.5, -0.2), Vec3::new(0.2, 0.6, -0.05));
        let fade = Fade::new(a, b);
        assert!(fade.value > 0.1 && fade.value < 0.9, "{}", fade.value);
        let [aa, ab, bb] = fade.hessian();
        let step = 1e-5;
        for k in 0..3 {
            let way = Vec3::ith(k, step);
            let along = |da: Vec3, db: Vec3| {
                let [after, before] = [Fade::new(a + da, b + db), Fade::new(a - da, b - db)];
                let slope = (after.value - before.value) / (2.0 * step);
                (slope, [0, 1].map(|v| (after.gradient()[v] - before.gradient()[v]) / (2.0 * step)))
            };
            let (by_a, by_b) = (along(way, Vec3::zeros()), along(Vec3::zeros(), way));
            let [ga, gb] = fade.gradient();
            assert!((by_a.0 - ga[k]).abs() < 1e-7 && (by_b.0 - gb[k]).abs() < 1e-7, "{k}");
            let near = |found: Vec3, told: Vec3| (found - told).norm() < 1e-6 * (1.0 + told.norm());
            assert!(near(by_a.1[0], aa.column(k).into()) && near(by_b.1[1], bb.column(k).into()), "{k}");
            assert!(near(by_b.1[0], ab.column(k).into()) && near(by_a.1[1], ab.row(k).transpose()), "{k}");
        }
        assert!(Fade::new(a, a * 2.0).value.abs() < 1e-4, "parallel ones have no normal");
        assert_eq!(Fade::new(Vec3::zeros(), b.normalize()).value, 1.0, "a line that folds itself has one");
    }
}
