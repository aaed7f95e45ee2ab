//! The KES instruments: the strain paths they drive and how they read parameters from the loop that comes out.
//!
//! Works on samples `[strain, force]` in time order, wherever they come from: a law, a virtual test, a measured file. It
//! does not know how a specimen is clamped, nor any viscosity: KES fixes none [Kawabata 1980].

use crate::fabric::{
    law::Law,
    units::{DEGREE, PER_CM},
};

/// Curvature at both ends of a bending test [1/m].
pub const BENDING_RANGE: f64 = 2.5 * PER_CM;
/// Curvatures between which B is read [1/m].
pub const BENDING_SLOPE: [f64; 2] = [0.5 * PER_CM, 1.5 * PER_CM];
/// Shear angle at both ends of a shear test [rad].
pub const SHEAR_RANGE: f64 = 8.0 * DEGREE;
/// Shear angles between which G is read [rad].
pub const SHEAR_SLOPE: [f64; 2] = [0.5 * DEGREE, 2.5 * DEGREE];
/// Shear angles at which 2HG and 2HG5 are read [rad].
pub const SHEAR_WIDTHS: [f64; 2] = [0.5 * DEGREE, 5.0 * DEGREE];

/// What a tensile test says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TensileReading {
    /// Largest tension [N/m].
    pub max_load: f64,
    /// EMT: strain at the largest tension [1].
    pub emt: f64,
    /// LT: work of loading over that of a straight line [1].
    pub lt: f64,
    /// WT: work of loading per area [J/m²].
    pub wt: f64,
    /// RT: work of unloading over work of loading [1].
    pub rt: f64,
}

/// What a bending test says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BendingReading {
    /// B: slope of the moment over the curvature [N·m].
    pub b: f64,
    /// 2HB: width of the loop [N].
    pub width: f64,
}

/// What a shear test says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShearReading {
    /// G: slope of the shear force over the angle [N/(m·rad)].
    pub g: f64,
    /// 2HG: width of the loop at the smaller angle [N/m].
    pub width: f64,
    /// 2HG5: width of the loop at the larger angle [N/m].
    pub width5: f64,
}

/// Why a loop cannot be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Unreadable {
    /// The strain does not go the instrument's way.
    #[error("{found} branches found, {expected} expected: the strain must go {path}")]
    Path { found: usize, expected: usize, path: &'static str },
    /// A branch ends before a station where it must be read.
    #[error("a branch does not reach {0} where it must be read")]
    Short(f64),
    /// A loop has negative area.
    #[error("the loop runs backwards: it returns {0:.4} times the work put in")]
    Backwards(f64),
}

/// Strains from `0` through the `turns` in order, `steps` to a leg, the start included.
pub fn path(turns: &[f64], steps: usize) -> Vec<f64> {
    let mut strains = vec![0.0];
    let mut from = 0.0;
    for &to in turns {
        strains.extend((1..=steps).map(|s| from + (to - from) * s as f64 / steps as f64));
        from = to;
    }
    strains
}

/// Drives a virgin law along `strains` and records `[strain, force]`.
pub fn drive(law: &Law, strains: &[f64]) -> Vec<[f64; 2]> {
    let mut p = law.virgin();
    strains
        .iter()
        .map(|&x| {
            let force = law.evaluate(x, p).force;
            p = law.commit(x, p);
            [x, force]
        })
        .collect()
}

/// Splits samples into branches where the strain turns; a turn is believed once the strain came back by 1 % of its range.
pub fn branches(samples: &[[f64; 2]]) -> Vec<&[[f64; 2]]> {
    let strains = || samples.iter().map(|s| s[0]);
    let range = strains().fold(f64::MIN, f64::max) - strains().fold(f64::MAX, f64::min);
    let believed = 0.01 * range;
    let [mut start, mut tip] = [0, 0];
    let mut sign = 0.0;
    let mut found = Vec::new();
    for (i, sample) in samples.iter().enumerate() {
        let way = sample[0] - samples[tip][0];
        if sign == 0.0 && way.abs() > believed {
            sign = way.signum();
        }
        if way * sign > 0.0 {
            tip = i;
        } else if way.abs() > believed {
            found.push(&samples[start..=tip]);
            [start, tip] = [tip, i];
            sign = -sign;
        }
    }
    if tip > start {
        found.push(&samples[start..=tip]);
    }
    found
}

/// Work done along samples: the integral of the force over the strain.
pub fn work(samples: &[[f64; 2]]) -> f64 {
    samples.windows(2).map(|s| 0.5 * (s[0][1] + s[1][1]) * (s[1][0] - s[0][0])).sum()
}

/// Force on a branch at strain `x`, linear between samples.
pub fn force_at(branch: &[[f64; 2]], x: f64) -> Result<f64, Unreadable> {
    let slack = 1e-9 * x.abs();
    for s in branch.windows(2) {
        let [low, high] = [s[0][0].min(s[1][0]), s[0][0].max(s[1][0])];
        if high > low && x >= low - slack && x <= high + slack {
            return Ok(s[0][1] + (s[1][1] - s[0][1]) * (x - s[0][0]) / (s[1][0] - s[0][0]));
        }
    }
    Err(Unreadable::Short(x))
}

/// Reads a tensile test 0 → largest load → 0. Tension below zero does not count as work given back.
pub fn read_tensile(samples: &[[f64; 2]]) -> Result<TensileReading, Unreadable> {
    let found = branches(samples);
    let [up, down] = found[..] else {
        let path = "from 0 to the largest load and back";
        return Err(Unreadable::Path { found: found.len(), expected: 2, path });
    };
    let [emt, max_load] = up[up.len() - 1];
    let wt = work(up);
    let pulling: Vec<[f64; 2]> = down.iter().map(|s| [s[0], s[1].max(0.0)]).collect();
    let rt = -work(&pulling) / wt;
    if !(wt > 0.0 && rt <= 1.0) {
        return Err(Unreadable::Backwards(rt));
    }
    Ok(TensileReading { max_load, emt, lt: wt / (0.5 * max_load * emt), wt, rt })
}

/// Reads a bending test 0 → +κ → −κ → 0; the width of its loop at curvature `station` [1/m].
pub fn read_bending(samples: &[[f64; 2]], station: f64) -> Result<BendingReading, Unreadable> {
    let legs = legs(samples, "0, +2.5, -2.5, 0 1/cm")?;
    Ok(BendingReading { b: slope(legs, BENDING_SLOPE)?, width: width(legs, station)? })
}

/// Reads a shear test 0 → +φ → −φ → 0.
pub fn read_shear(samples: &[[f64; 2]]) -> Result<ShearReading, Unreadable> {
    let legs = legs(samples, "0, +8, -8, 0 degrees")?;
    let [width, width5] = [width(legs, SHEAR_WIDTHS[0])?, width(legs, SHEAR_WIDTHS[1])?];
    Ok(ShearReading { g: slope(legs, SHEAR_SLOPE)?, width, width5 })
}

fn legs<'a>(samples: &'a [[f64; 2]], path: &'static str) -> Result<[&'a [[f64; 2]]; 3], Unreadable> {
    let found = branches(samples);
    let Ok(legs) = <[_; 3]>::try_from(found) else {
        return Err(Unreadable::Path { found: branches(samples).len(), expected: 3, path });
    };
    if work(samples) < 0.0 {
        return Err(Unreadable::Backwards(work(samples) / work(legs[0]).abs()));
    }
    Ok(legs)
}

/// Mean slope of the branches that lead away from zero, on both sides.
fn slope([out, over, _]: [&[[f64; 2]]; 3], [near, far]: [f64; 2]) -> Result<f64, Unreadable> {
    let positive = (force_at(out, far)? - force_at(out, near)?) / (far - near);
    let negative = (force_at(over, -near)? - force_at(over, -far)?) / (far - near);
    Ok(0.5 * (positive + negative))
}

/// Mean width of the loop at ±`station`.
fn width([out, over, home]: [&[[f64; 2]]; 3], station: f64) -> Result<f64, Unreadable> {
    let positive = force_at(out, station)? - force_at(over, station)?;
    let negative = force_at(home, -station)? - force_at(over, -station)?;
    Ok(0.5 * (positive + negative))
}
