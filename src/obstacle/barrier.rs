//! Energy that grows as a gap closes: a parabola below the activation distance, a logarithm below half of it.
//!
//! Twice continuously differentiable where the two meet; infinite at a closed gap. Live steps of one or two solves like the
//! parabola: Newton lands on it at once. Form: [Chen 2025], after the barrier of [Li 2020].

/// A barrier per area.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Barrier {
    /// Gap [m] below which it acts.
    pub activation: f64,
    /// Pressure per approach on the parabola [Pa/m].
    pub stiffness: f64,
}

impl Barrier {
    /// Energy per area [J/m²].
    pub fn energy(&self, gap: f64) -> f64 {
        let (d, k) = (self.activation, self.stiffness);
        let half = 0.5 * d;
        if gap >= d {
            0.0
        } else if gap >= half {
            0.5 * k * (d - gap).powi(2)
        } else if gap > 0.0 {
            0.5 * k * half * half - k * half * half * (gap / half).ln()
        } else {
            f64::INFINITY
        }
    }

    /// First derivative [Pa], never positive, and second [Pa/m], never negative.
    pub fn slope(&self, gap: f64) -> (f64, f64) {
        let (d, k) = (self.activation, self.stiffness);
        let half = 0.5 * d;
        if gap >= d {
            (0.0, 0.0)
        } else if gap >= half {
            (k * (gap - d), k)
        } else {
            // A closed gap pushes hard, with a finite number.
            let gap = gap.max(1e-12 * d);
            (-k * half * half / gap, k * (half / gap).powi(2))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_differences_and_are_continuous_at_half_the_activation() {
        let barrier = Barrier { activation: 1e-3, stiffness: 1.6e7 };
        for gap in [1e-8, 1e-5, 3e-4, 4.9e-4, 5.1e-4, 9e-4, 1.1e-3] {
            let h = 1e-5 * gap;
            let [up, down] = [gap + h, gap - h];
            let slope = (barrier.energy(up) - barrier.energy(down)) / (2.0 * h);
            let curvature = (barrier.slope(up).0 - barrier.slope(down).0) / (2.0 * h);
            let (exact, second) = barrier.slope(gap);
            assert!((slope - exact).abs() <= 1e-6 * exact.abs(), "{gap}: {slope} {exact}");
            assert!((curvature - second).abs() <= 1e-6 * second, "{gap}: {curvature} {second}");
        }
        let [below, above] = [0.5e-3 * (1.0 - 1e-12), 0.5e-3].map(|g| (barrier.energy(g), barrier.slope(g)));
        assert!((below.0 - above.0).abs() < 1e-9 * above.0);
        assert!((below.1.0 - above.1.0).abs() < 1e-9 * above.1.0.abs());
        assert!((below.1.1 - above.1.1).abs() < 1e-9 * above.1.1);
    }
}
