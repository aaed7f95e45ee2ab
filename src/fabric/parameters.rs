//! From KES parameters to laws: the shortest curves that return the parameters they were made from. All in SI.
//!
//! What the parameters do not fix (stick, compression, the curve past the instrument's range) is in `Chosen`, nowhere else.

use crate::fabric::{
    instrument::{BENDING_RANGE, SHEAR_RANGE, SHEAR_WIDTHS},
    law::{Branches, Law, Unfit},
    units::{DEGREE, PER_CM},
};

/// What KES does not measure and somebody had to choose. A fabric file may override each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chosen {
    /// Tensile strain left when the load is gone, over EMT [1]; none: (1 − RT)/2, a middle choice.
    pub residual_strain: Option<f64>,
    /// In-plane compression: stiffness over the initial tensile one [1]. Cloth buckles long before; the solver needs some.
    pub compression: f64,
    /// Compressive strain over which the tensile stiffness falls to that of compression [1].
    pub compression_blend: f64,
    /// Way of the tensile history from the middle to sliding, over the whole of g [1]. Sets the stiffness after a reversal.
    pub tensile_stick: f64,
    /// Change of curvature from the middle to full sliding [1/m].
    pub bending_stick: f64,
    /// Change of shear angle from the middle to full sliding [rad].
    pub shear_stick: f64,
    /// Shear angle within which the kink of the hysteresis at zero is rounded [rad]; less than the station of 2HG.
    pub shear_rounding: f64,
    /// Twist rigidity [N·m]; none: that of an isotropic sheet.
    pub twist: Option<f64>,
}

impl Default for Chosen {
    fn default() -> Chosen {
        Chosen {
            residual_strain: None,
            compression: 0.1,
            compression_blend: 1e-4,
            tensile_stick: 0.01,
            bending_stick: 0.05 * PER_CM,
            shear_stick: 0.1 * DEGREE,
            shear_rounding: 0.3 * DEGREE,
            twist: None,
        }
    }
}

/// Parameters of one tensile test.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tensile {
    /// Load at which the test turns [N/m].
    pub max_load: f64,
    /// EMT: strain at that load [1].
    pub emt: f64,
    /// LT: linearity [1].
    pub lt: f64,
    /// RT: resilience as a fraction [1].
    pub rt: f64,
}

/// Parameters of one bending test.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bending {
    /// B: rigidity per width [N·m].
    pub b: f64,
    /// 2HB: width of the loop [N], the same at every curvature.
    pub width: f64,
}

/// Parameters of one shear test.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shear {
    /// G: slope at small angles [N/(m·rad)].
    pub g: f64,
    /// 2HG: width of the loop at the smaller station [N/m].
    pub width: f64,
    /// 2HG5: width of the loop at the larger station [N/m].
    pub width5: f64,
}

/// Intervals of the tensile curve.
const TENSILE_INTERVALS: usize = 96;
/// Half width of the rounding of the tensile curve's kinks, over EMT.
const TENSILE_ROUNDING: f64 = 2e-3;

impl Tensile {
    /// The tensile law: exponential branches, straight beyond EMT, soft in compression.
    ///
    /// The elastic stick at both turns of the test takes a part of the loop, known in closed form: the loop that is driven has
    /// the area 2 g(EMT)(1 − stick). The envelope is made wider by that, so that RT comes back as given.
    pub fn law(&self, chosen: &Chosen) -> Result<Law, Unfit> {
        let Tensile { max_load, emt, lt, rt } = *self;
        let rt_envelope = 1.0 - (1.0 - rt) / (1.0 - chosen.tensile_stick);
        let residual = emt * chosen.residual_strain.unwrap_or(0.5 * (1.0 - rt));
        let lt_unloading = lt * rt_envelope / (1.0 - residual / emt);
        let loading = Exponential::new(max_load, emt, lt).ok_or(Unfit::NotACurve)?;
        let unloading = Exponential::new(max_load, emt - residual, lt_unloading).ok_or(Unfit::NotACurve)?;
        tensile_law([emt, residual], |x| loading.at(x), |x| unloading.at(x - residual), chosen)
    }
}

/// Assembles a tensile law from its branches as force and slope over strain: `upper` on [0, `emt`], `lower` on
/// [`residual`, `emt`]; the unloading branch is slack below. Kinks are rounded within one small interval.
pub fn tensile_law(
    [emt, residual]: [f64; 2],
    upper: impl Fn(f64) -> [f64; 2],
    lower: impl Fn(f64) -> [f64; 2],
    chosen: &Chosen,
) -> Result<Law, Unfit> {
    let elastic = residual < 1e-6 * emt;
    let lower = |x: f64| match x {
        _ if elastic => upper(x),
        x if x < residual => [0.0, 0.0],
        x => lower(x),
    };
    let mut round = TENSILE_ROUNDING * emt;
    let mut blend = chosen.compression_blend.min(0.1 * emt);
    if !elastic {
        round = round.min(0.5 * residual);
        blend = blend.min(0.25 * residual);
    }
    let slope = upper(0.0)[1];
    let soft = chosen.compression * slope;
    let bottom = [-0.5 * (slope + soft) * blend, soft];
    // The unloading branch passes zero strain on one cubic from (−blend, bottom) to (blend, 0): its middle is a knot too.
    let middle = if elastic { upper(0.0) } else { [-0.25 * slope * blend, 0.375 * slope + 0.125 * soft] };
    let mut envelope = vec![
        Branches { x: -blend, loading: bottom, unloading: bottom },
        Branches { x: 0.0, loading: upper(0.0), unloading: middle },
    ];
    let kinks = [0.0, residual, emt];
    let uniform = (1..TENSILE_INTERVALS).map(|i| emt * i as f64 / TENSILE_INTERVALS as f64);
    let mut strains: Vec<f64> =
        uniform.filter(|x| kinks.iter().all(|k| (x - k).abs() > 1.5 * round.max(blend))).collect();
    if !elastic {
        strains.extend([blend, residual - round, residual + round]);
    }
    strains.push(emt - round);
    strains.sort_by(f64::total_cmp);
    envelope.extend(strains.iter().map(|&x| Branches { x, loading: upper(x), unloading: lower(x) }));
    envelope.push(Branches { x: emt, loading: upper(emt), unloading: upper(emt) });

    let enclosed = Law::from_envelope(&envelope, 1.0, 0.0)?.enclosed(emt);
    let stick = positive(chosen.tensile_stick * enclosed);
    // A virgin element slides from the first strain on: gravity alone never would make it, and would meet half the stiffness.
    Law::from_envelope(&envelope, stick, -stick)
}

impl Bending {
    /// The bending law: M = B κ ± HB.
    pub fn law(&self, chosen: &Chosen) -> Result<Law, Unfit> {
        let half = 0.5 * self.width;
        let ends = [-BENDING_RANGE, BENDING_RANGE].map(|x| Branches {
            x,
            loading: [self.b * x + half, self.b],
            unloading: [self.b * x - half, self.b],
        });
        Law::from_envelope(&ends, positive(half * chosen.bending_stick), 0.0)
    }
}

impl Shear {
    /// Growth of half the loop's width with the angle, h' [N/(m·rad)].
    pub fn growth(&self) -> f64 {
        0.5 * (self.width5 - self.width) / (SHEAR_WIDTHS[1] - SHEAR_WIDTHS[0])
    }

    /// The shear law: F = E φ ± h(φ), h growing with the angle within the instrument's range and constant beyond.
    pub fn law(&self, chosen: &Chosen) -> Result<Law, Unfit> {
        let growth = self.growth();
        let elastic = self.g - growth;
        let round = chosen.shear_rounding;
        let h = |angle: f64| 0.5 * self.width + growth * (angle - SHEAR_WIDTHS[0]);
        let flat = h(SHEAR_RANGE) + 0.5 * growth * round;
        let right = [
            (round, h(round), growth),
            (SHEAR_RANGE, h(SHEAR_RANGE), growth),
            (SHEAR_RANGE + round, flat, 0.0),
        ];
        let at = |x: f64, half: f64, slope: f64| Branches {
            x,
            loading: [elastic * x + half, elastic + slope],
            unloading: [elastic * x - half, elastic - slope],
        };
        let left = right.iter().rev().map(|&(x, half, slope)| at(-x, half, -slope));
        let envelope: Vec<Branches> =
            left.chain(right.iter().map(|&(x, half, slope)| at(x, half, slope))).collect();
        let stick = Law::from_envelope(&envelope, 1.0, 0.0)?.enclosed(chosen.shear_stick);
        Law::from_envelope(&envelope, positive(stick), 0.0)
    }
}

/// A law without hysteresis has no stick either; any positive one serves it.
fn positive(stick: f64) -> f64 {
    if stick > 0.0 { stick } else { 1.0 }
}

/// F = Fm (e^(a x/xm) − 1)/(e^a − 1), with a from the linearity.
struct Exponential {
    end: [f64; 2],
    rise: f64,
}

impl Exponential {
    /// From (0, 0) to (`x`, `force`) with this linearity; none outside 0 < linearity < 1.
    fn new(force: f64, x: f64, linearity: f64) -> Option<Exponential> {
        let of = |a: f64| 2.0 * (1.0 / a - 1.0 / a.exp_m1());
        let [mut low, mut high] = [1e-5, 700.0];
        if !(force > 0.0 && x > 0.0 && linearity < of(low) && linearity > of(high)) {
            return None;
        }
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            if of(middle) > linearity { low = middle } else { high = middle }
        }
        Some(Exponential { end: [x, force], rise: 0.5 * (low + high) })
    }

    /// Force and slope.
    fn at(&self, x: f64) -> [f64; 2] {
        let [end, force] = self.end;
        let scale = force / self.rise.exp_m1();
        let t = self.rise * x / end;
        [scale * t.exp_m1(), scale * t.exp() * self.rise / end]
    }
}
