//! A disc cut from the rectangular sheet: how much of each cell it covers, exactly.
//!
//! Knows no elements. `grid` asks it how much of a cell's covered area each corner bears, and gives masses, widths and areas
//! in that proportion, so they sum to the disc's whatever the cells' size. The rim itself is no line of particles: cells that it
//! crosses keep all four corners, those outside it carry nothing, and particles of such cells alone are absent.

/// A disc in the sheet's own coordinates: lengths at rest along warp and weft from particle (0, 0).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cut {
    /// Centre along warp and weft [m].
    pub center: [f64; 2],
    /// Radius [m].
    pub radius: f64,
}

/// Slices of a crossed cell along each side, where its area is parted among its corners.
const SLICES: usize = 16;

impl Cut {
    /// Area [m²] of the rectangle from `low` to `high` [m] that the disc covers; exactly 0 and exactly all of it where they
    /// do not cross.
    pub fn covered(&self, low: [f64; 2], high: [f64; 2]) -> f64 {
        let [x0, y0] = [0, 1].map(|k| low[k] - self.center[k]);
        let [x1, y1] = [0, 1].map(|k| high[k] - self.center[k]);
        let whole = (high[0] - low[0]) * (high[1] - low[1]);
        if [x0, x1].iter().all(|x| [y0, y1].iter().all(|y| x.hypot(*y) <= self.radius)) {
            return whole;
        }
        if 0.0_f64.clamp(x0, x1).hypot(0.0_f64.clamp(y0, y1)) >= self.radius {
            return 0.0;
        }
        let corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
        let area: f64 = (0..4).map(|k| self.wedge(corners[k], corners[(k + 1) % 4])).sum();
        area.clamp(0.0, whole)
    }

    /// Covered area [m²] of the rectangle from `low` to `high` [m], parted among its corners (0,0), (1,0), (0,1), (1,1) by
    /// bilinear weights: its sum is exact, its centre nearly so, and every corner of a crossed cell gets some.
    pub fn shares(&self, low: [f64; 2], high: [f64; 2]) -> [f64; 4] {
        let size = [0, 1].map(|k| high[k] - low[k]);
        let area = self.covered(low, high);
        if area == 0.0 || area == size[0] * size[1] {
            return [0.25 * area; 4];
        }
        let mut shares = [0.0; 4];
        for n in 0..SLICES * SLICES {
            let from = [n / SLICES, n % SLICES].map(|s| s as f64 / SLICES as f64);
            let at = |part: f64| [0, 1].map(|k| low[k] + size[k] * (from[k] + part / SLICES as f64));
            let part = self.covered(at(0.0), at(1.0));
            let [u, v] = from.map(|s| s + 0.5 / SLICES as f64);
            let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
            shares.iter_mut().zip(weights).for_each(|(share, weight)| *share += part * weight);
        }
        shares
    }

    /// Signed area [m²] of the disc's part between the centre and the segment from `a` to `b`, both from the centre.
    fn wedge(&self, a: [f64; 2], b: [f64; 2]) -> f64 {
        let along = [b[0] - a[0], b[1] - a[1]];
        let length = along[0].hypot(along[1]);
        // The part of the segment inside the disc, around the foot of the centre's perpendicular.
        let foot = -(a[0] * along[0] + a[1] * along[1]) / (length * length);
        let distance = (a[0] * along[1] - a[1] * along[0]) / length;
        let inside = self.radius * self.radius - distance * distance;
        let half = inside.max(0.0).sqrt() / length;
        let at = |t: f64| [a[0] + t * along[0], a[1] + t * along[1]];
        let [enter, leave] = [foot - half, foot + half].map(|t| at(t.clamp(0.0, 1.0)));
        let cross = |p: [f64; 2], q: [f64; 2]| p[0] * q[1] - p[1] * q[0];
        let sector = |p: [f64; 2], q: [f64; 2]| {
            0.5 * self.radius * self.radius * cross(p, q).atan2(p[0] * q[0] + p[1] * q[1])
        };
        sector(a, enter) + 0.5 * cross(enter, leave) + sector(leave, b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covered_area_matches_slices() {
        let cut = Cut { center: [0.3, -0.1], radius: 0.7 };
        for (low, high) in [
            ([0.0, 0.0], [1.0, 1.0]),
            ([-2.0, -2.0], [2.0, 2.0]),
            ([0.25, -0.12], [0.35, 0.02]),
            ([0.9, -0.4], [1.2, 0.3]),
            ([0.2, 0.55], [0.4, 0.9]),
            ([-0.6, -0.9], [-0.1, -0.3]),
        ] {
            let slices = 200_000;
            let step = (high[0] - low[0]) / f64::from(slices);
            let sliced: f64 = (0..slices)
                .map(|k| {
                    let x = low[0] + (f64::from(k) + 0.5) * step - cut.center[0];
                    let half = (cut.radius * cut.radius - x * x).max(0.0).sqrt();
                    let top = (cut.center[1] + half).min(high[1]);
                    (top - (cut.center[1] - half).max(low[1])).max(0.0) * step
                })
                .sum();
            let covered = cut.covered(low, high);
            assert!((covered - sliced).abs() < 1e-7, "{low:?} {high:?}: {covered} for {sliced}");
        }
    }

    #[test]
    fn shares_are_positive_and_keep_area_and_centre() {
        let cut = Cut { center: [0.0, 0.0], radius: 1.0 };
        // An octant's worth of cells: their moments about the axes are those of the quarter disc.
        let h = 0.1;
        let [mut area, mut moment] = [0.0; 2];
        for n in 0..100 {
            let low = [(n / 10) as f64 * h, (n % 10) as f64 * h];
            let shares = cut.shares(low, [low[0] + h, low[1] + h]);
            let sum: f64 = shares.iter().sum();
            assert!(sum == 0.0 || shares.iter().all(|s| *s > 0.0), "{low:?}: {shares:?}");
            area += sum;
            moment += sum * low[0] + h * (shares[1] + shares[3]);
        }
        assert!((area / std::f64::consts::FRAC_PI_4 - 1.0).abs() < 1e-12, "{area}");
        assert!((moment * 3.0 - 1.0).abs() < 1e-5, "{moment}");
    }

    #[test]
    fn cells_of_any_size_sum_to_the_disc() {
        let cut = Cut { center: [0.15, 0.15], radius: 0.15 };
        for n in [1_usize, 7, 38, 76] {
            let h = 0.3 / n as f64;
            let sum: f64 = (0..n * n)
                .map(|k| [(k / n) as f64 * h, (k % n) as f64 * h])
                .map(|low| cut.covered(low, [low[0] + h, low[1] + h]))
                .sum();
            let disc = std::f64::consts::PI * 0.15 * 0.15;
            assert!((sum / disc - 1.0).abs() < 1e-12, "{n}: {sum}");
        }
    }
}
