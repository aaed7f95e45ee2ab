//! References for bent strips, by integrating the elastica: cantilevers and loops.
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
    /// The shape from the clamp to the tip at even steps: reach and drop.
    pub shape: Vec<[f64; 2]>,
}

/// Steps of the integration: the error is some 1e-10 at Γ = 1 and 1e-8 at Γ = 10,000.
const STEPS: usize = 8000;

/// The cantilever under its own weight, Γ = w L³/B above 0; it stretches by `stretch` = w L over the tensile stiffness where its whole weight pulls.
pub fn self_weight(gamma: f64, stretch: f64) -> Cantilever {
    let f = |s: f64, y: &[f64; 4]| {
        let longer = 1.0 + stretch * s * y[0].cos();
        [y[1], gamma * s * longer * y[0].sin(), longer * y[0].cos(), longer * y[0].sin()]
    };
    cantilever(&f)
}

/// The cantilever under a tip load, a = P L²/B above 0; it stretches by `stretch` where the whole load pulls.
pub fn tip_load(load: f64, stretch: f64) -> Cantilever {
    let f = |_: f64, y: &[f64; 4]| {
        let longer = 1.0 + stretch * y[0].cos();
        [y[1], load * longer * y[0].sin(), longer * y[0].cos(), longer * y[0].sin()]
    };
    cantilever(&f)
}

/// Integrates from the tip and searches the tip's angle from the vertical such that the clamp is level. `f` gives the derivatives of that
/// angle, of its slope, of the drop and of the reach.
fn cantilever(f: &impl Fn(f64, &[f64; 4]) -> [f64; 4]) -> Cantilever {
    let h = 1.0 / STEPS as f64;
    let clamp = |log: f64| {
        let mut y = [log.exp(), 0.0, 0.0, 0.0];
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
    let mut y = [tip, 0.0, 0.0, 0.0];
    let mut backwards = vec![[0.0, 0.0]];
    for k in 0..STEPS {
        y = runge_kutta(f, k as f64 * h, &y, h);
        if (k + 1) % (STEPS / SHOWN) == 0 {
            backwards.push([y[3], y[2]]);
        }
    }
    let shape = backwards.iter().rev().map(|p| [y[3] - p[0], y[2] - p[1]]).collect();
    Cantilever { drop: y[2], reach: y[3], tip: FRAC_PI_2 - tip, shape }
}

/// Intervals of the shapes that are kept.
pub const SHOWN: usize = 2000;

/// The loop that a strip of unit length makes when both ends are clamped at one place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Shape {
    /// Both ends point down.
    Pear,
    /// Both ends point up.
    Heart,
    /// The ends go on into each other, level.
    Ring,
}

/// A loop of unit length.
#[derive(Clone, Debug)]
pub struct Loop {
    /// From the clamp down to the lowest point.
    pub height: f64,
    /// Half of it from the lowest point to the clamp, at even steps: across and up from the lowest point.
    pub half: Vec<[f64; 2]>,
}

impl Shape {
    /// Direction in which the half to the right of the lowest point arrives at the clamp, from the horizontal [rad].
    fn arrival(self) -> f64 {
        match self {
            Shape::Pear => FRAC_PI_2,
            Shape::Heart => 3.0 * FRAC_PI_2,
            Shape::Ring => 2.0 * FRAC_PI_2,
        }
    }

    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Shape::Pear => "pear",
            Shape::Heart => "heart",
            Shape::Ring => "ring",
        }
    }

    /// The loop with β = w L³/B, 0 when it is weightless; none where the search ends elsewhere.
    ///
    /// From the lowest point, where the strip is level and only a horizontal force H acts, with θ the direction and s the distance from there:
    /// θ″ = H sin θ − β s cos θ. H and θ′(0) are searched, on the way from the weightless ring, such that the clamp lies above the lowest point.
    pub fn solve(self, beta: f64) -> Option<Loop> {
        let ring = Shape::Ring.arrival();
        let bent =
            follow([0.0, 2.0 * std::f64::consts::PI], &|part| [0.0, ring + part * (self.arrival() - ring)])?;
        // Even in the logarithm, as a loop answers to weight.
        let unknown = follow(bent, &|part| [(1.0 + beta).powf(part) - 1.0, self.arrival()])?;
        let half = half_loop(unknown, beta).1;
        Some(Loop { height: half[half.len() - 1][1], half })
    }
}

/// Follows a solution from one end of a path of β and arrival to the other, in steps that shorten where Newton's method fails.
fn follow(mut unknown: [f64; 2], path: &dyn Fn(f64) -> [f64; 2]) -> Option<[f64; 2]> {
    let (mut done, mut step, mut slope) = (0.0, 0.05, [0.0; 2]);
    while done < 1.0 {
        let next = f64::min(done + step, 1.0);
        let [beta, arrival] = path(next);
        let guess = [0, 1].map(|k| unknown[k] + (next - done) * slope[k]);
        match close(guess, beta, arrival) {
            Some(found) => {
                slope = [0, 1].map(|k| (found[k] - unknown[k]) / (next - done));
                (unknown, done, step) = (found, next, 1.5 * step);
            }
            None if step < 1e-4 => return None,
            None => step *= 0.4,
        }
    }
    Some(unknown)
}

/// Newton's method for the force and the curvature at the lowest point; none where it does not converge.
fn close(mut unknown: [f64; 2], beta: f64, arrival: f64) -> Option<[f64; 2]> {
    let miss = |u: [f64; 2]| {
        let end = half_loop(u, beta).0;
        [end[0] - arrival, end[2]]
    };
    for _ in 0..8 {
        let here = miss(unknown);
        if here[0].abs() + here[1].abs() < 1e-11 {
            return Some(unknown);
        }
        let step = [1e-6 * (1.0 + unknown[0].abs()), 1e-6 * (1.0 + unknown[1].abs())];
        let columns = [0, 1].map(|k| {
            let [mut up, mut down] = [unknown; 2];
            (up[k], down[k]) = (up[k] + step[k], down[k] - step[k]);
            let (up, down) = (miss(up), miss(down));
            [0, 1].map(|row| (up[row] - down[row]) / (2.0 * step[k]))
        });
        let [[a, c], [b, d]] = columns;
        let determinant = a * d - b * c;
        unknown[0] -= (d * here[0] - b * here[1]) / determinant;
        unknown[1] -= (a * here[1] - c * here[0]) / determinant;
    }
    let last = miss(unknown);
    (last[0].abs() + last[1].abs() < 1e-9).then_some(unknown)
}

/// Direction, its slope, across and up at the end of half a loop, and its shape.
fn half_loop([force, curvature]: [f64; 2], beta: f64) -> ([f64; 4], Vec<[f64; 2]>) {
    let f = |s: f64, y: &[f64; 4]| {
        let (sine, cosine) = y[0].sin_cos();
        [y[1], force * sine - beta * s * cosine, cosine, sine]
    };
    let h = 0.5 / SHOWN as f64;
    let mut y = [0.0, curvature, 0.0, 0.0];
    let mut shape = vec![[0.0, 0.0]];
    for k in 0..SHOWN {
        y = runge_kutta(&f, k as f64 * h, &y, h);
        shape.push([y[2], y[3]]);
    }
    (y, shape)
}

/// A point of a shape kept at even steps, at a fraction of its length.
pub fn at(shape: &[[f64; 2]], fraction: f64) -> [f64; 2] {
    let place = fraction.clamp(0.0, 1.0) * (shape.len() - 1) as f64;
    let k = (place as usize).min(shape.len() - 2);
    [0, 1].map(|n| shape[k][n] + (place - k as f64) * (shape[k + 1][n] - shape[k][n]))
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
            let c = self_weight(gamma, 0.0);
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
            let c = tip_load(load, 0.0);
            let found = [c.drop, 1.0 - c.reach, c.tip];
            for (got, known) in found.iter().zip([drop, loss, tip]) {
                assert!((got - known).abs() < 1e-5, "a {load}: {found:?}");
            }
        }
    }

    /// Height over length, known to six digits; weight in β = w L³/B.
    #[test]
    fn loops_agree_with_known_heights() {
        let ring = 1.0 / std::f64::consts::PI;
        for (shape, known) in [
            (Shape::Pear, vec![(0.0, 0.424308), (10.0, 0.425114), (100.0, 0.431306), (1000.0, 0.455146)]),
            (Shape::Heart, vec![(0.0, 0.133860), (10.0, 0.139540), (100.0, 0.184043), (200.0, 0.222389)]),
            (Shape::Ring, vec![(0.0, ring), (10.0, 0.321261), (50.0, 0.332156), (100.0, 0.343954)]),
        ] {
            for (beta, height) in known {
                let found = shape.solve(beta).expect("a loop").height;
                assert!((found - height).abs() < 1e-6, "{shape:?} β {beta}: {found} for {height}");
            }
        }
    }

    #[test]
    fn a_stretching_cantilever_drops_more() {
        let [stiff, soft] = [0.0, 1e-3].map(|stretch| self_weight(1000.0, stretch).drop);
        // It hangs: its own weight stretches it by half of that.
        assert!((soft - stiff - 0.5e-3).abs() < 5e-5, "{stiff} {soft}");
    }
}
