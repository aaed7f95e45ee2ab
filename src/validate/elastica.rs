//! References for bent strips, by integrating the elastica.
//!
//! The self-weight cantilever is integrated from its free tip, where only the tip's slope is unknown: with ψ the angle from the vertical and
//! σ the distance from the tip over the length, ψ″ = Γ σ sin ψ, ψ′(0) = 0. The solution grows towards the clamp as fast as
//! e^(⅔√Γ), so its logarithm at the tip is what is searched: ψ(1) = π/2 determines it, however stiff or limp the strip.

use std::f64::consts::FRAC_PI_2;

/// One classical Runge–Kutta step of y′ = f(t, y).
pub fn runge_kutta<const N: usize>(
    f: &impl Fn(f64, &[f64; N]) -> [f64; N],
    t: f64,
    y: &[f64; N],
    h: f64,
) -> [f64; N] {
    let along = |k: &[f64; N], h: f64| -> [f64; N] { std::array::from_fn(|n| y[n] + h * k[n]) };
    let k1 = f(t, y);
    let k2 = f(t + 0.5 * h, &along(&k1, 0.5 * h));
    let k3 = f(t + 0.5 * h, &along(&k2, 0.5 * h));
    let k4 = f(t + h, &along(&k3, h));
    std::array::from_fn(|n| y[n] + h / 6.0 * (k1[n] + 2.0 * (k2[n] + k3[n]) + k4[n]))
}

/// A bent cantilever of unit length.
#[derive(Clone, Debug)]
pub struct Cantilever {
    /// Drop of the tip, H/L.
    pub drop: f64,
    /// Horizontal reach, W/L.
    pub reach: f64,
    /// Slope of the tip below the horizontal [rad].
    pub tip: f64,
    /// The shape from the clamp to the tip: reach and drop.
    pub shape: Vec<[f64; 2]>,
}

/// Steps of the integration: the error is some 1e-10 at Γ = 1 and 1e-8 at Γ = 10,000.
const STEPS: usize = 8000;

/// The cantilever under its own weight, Γ = w L³/B above 0.
pub fn self_weight(gamma: f64) -> Cantilever {
    let f = |s: f64, y: &[f64; 4]| [y[1], gamma * s * y[0].sin(), y[0].cos(), y[0].sin()];
    shoot(&f, &|slope| [slope, 0.0, 0.0, 0.0])
}

/// The cantilever under a tip load, a = P L²/B above 0.
pub fn tip_load(load: f64) -> Cantilever {
    let f = |_: f64, y: &[f64; 4]| [y[1], load * y[0].sin(), y[0].cos(), y[0].sin()];
    shoot(&f, &|slope| [slope, 0.0, 0.0, 0.0])
}

/// Integrates from the tip and searches the tip's angle from the vertical such that the clamp is level. `f` gives the derivatives of that
/// angle, of its slope, of the drop and of the reach.
fn shoot(f: &impl Fn(f64, &[f64; 4]) -> [f64; 4], start: &dyn Fn(f64) -> [f64; 4]) -> Cantilever {
    let h = 1.0 / STEPS as f64;
    let clamp = |log: f64| {
        let mut y = start(log.exp());
        for k in 0..STEPS {
            y = runge_kutta(f, k as f64 * h, &y, h);
            if y[0] > FRAC_PI_2 {
                return y[0];
            }
        }
        y[0]
    };
    let (mut low, mut high) = (-700.0, FRAC_PI_2.ln());
    for _ in 0..70 {
        let middle = 0.5 * (low + high);
        if clamp(middle) > FRAC_PI_2 { high = middle } else { low = middle }
    }
    let tip = (0.5 * (low + high)).exp();
    let mut y = start(tip);
    let mut backwards = vec![[0.0, 0.0]];
    for k in 0..STEPS {
        y = runge_kutta(f, k as f64 * h, &y, h);
        if (k + 1) % (STEPS / 200) == 0 {
            backwards.push([y[3], y[2]]);
        }
    }
    let shape = backwards.iter().rev().map(|p| [y[3] - p[0], y[2] - p[1]]).collect();
    Cantilever { drop: y[2], reach: y[3], tip: FRAC_PI_2 - tip, shape }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Γ, H/L, W/L, slope of the tip in degrees: integrated elsewhere, to seven digits.
    #[test]
    fn self_weight_agrees_with_an_independent_integration() {
        for [gamma, drop, reach, tip] in [
            [0.1, 0.0124984, 0.9999107, 0.9548],
            [1.0, 0.1234714, 0.9912464, 9.4604],
            [2.0, 0.2385066, 0.9668929, 18.4260],
            [5.0, 0.4959050, 0.8466572, 39.9354],
            [8.004197, 0.6407798, 0.7242699, 53.8805],
            [10.0, 0.7001997, 0.6563538, 60.3120],
            [20.0, 0.8298814, 0.4452321, 76.7478],
            [50.0, 0.9079171, 0.2450148, 87.4593],
            [100.0, 0.9375239, 0.1592234, 89.6167],
            [200.0, 0.9567692, 0.1074204, 89.9743],
            [1000.0, 0.9811413, 0.0459865, 90.0],
            [10000.0, 0.9941099, 0.0142609, 90.0],
        ] {
            let c = self_weight(gamma);
            assert!((c.drop - drop).abs() < 1e-7, "Γ {gamma}: H/L {}", c.drop);
            assert!((c.reach - reach).abs() < 1e-7, "Γ {gamma}: W/L {}", c.reach);
            assert!((c.tip.to_degrees() - tip).abs() < 1e-4, "Γ {gamma}: tip {}", c.tip.to_degrees());
        }
    }

    /// Load, tip's drop, loss of reach, slope in radians.
    #[test]
    fn tip_load_agrees_with_elliptic_integrals() {
        for [load, drop, loss, tip] in [
            [0.2, 0.06636, 0.00265, 0.09964],
            [0.5, 0.16214, 0.01592, 0.24453],
            [1.0, 0.30172, 0.05643, 0.46135],
            [2.0, 0.49346, 0.16064, 0.78175],
            [5.0, 0.71379, 0.38763, 1.21537],
            [10.0, 0.81061, 0.55500, 1.43029],
        ] {
            let c = tip_load(load);
            let found = [c.drop, 1.0 - c.reach, c.tip];
            for (got, known) in found.iter().zip([drop, loss, tip]) {
                assert!((got - known).abs() < 1e-5, "a {load}: {found:?}");
            }
        }
    }
}
