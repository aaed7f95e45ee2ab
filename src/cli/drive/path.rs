//! Paths of a driven hand: positions over time, from where it grabbed.

use std::f64::consts::TAU;

/// Time over which the speed rises from zero [s].
const RAMP: f64 = 0.05;

/// A path.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Path {
    /// Around in the x–z plane, from the lowest point.
    Circle { radius: f64, speed: f64 },
    /// Up and back, again and again.
    Pull { length: f64, speed: f64 },
    /// Positions [m] at times [s], straight between them; stays at the last.
    Points(Vec<(f64, [f64; 3])>),
}

impl Path {
    /// A path by name, or from a CSV file.
    pub(super) fn parse(text: &str, radius: f64, speed: f64) -> Result<Path, String> {
        match text {
            "circle" => Ok(Path::Circle { radius, speed }),
            "pull" => Ok(Path::Pull { length: radius, speed }),
            file if file.ends_with(".csv") => {
                let text = std::fs::read_to_string(file).map_err(|e| format!("path {file}: {e}"))?;
                Path::points(&text).map_err(|e| format!("path {file}{e}"))
            }
            other => Err(format!("path is {other:?}, allowed: circle, pull, or a file that ends in .csv")),
        }
    }

    /// Reads `t_s,x_m,y_m,z_m`, times rising; errors begin with the line.
    fn points(text: &str) -> Result<Path, String> {
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text.as_bytes());
        let head = reader.headers().map_err(|e| format!(": {e}"))?;
        if head != ["t_s", "x_m", "y_m", "z_m"].as_slice() {
            return Err(format!(":1: columns are {head:?}, allowed: t_s,x_m,y_m,z_m"));
        }
        let mut points: Vec<(f64, [f64; 3])> = Vec::new();
        for (row, line) in reader.deserialize::<(f64, f64, f64, f64)>().zip(2..) {
            let (t, x, y, z) = row.map_err(|e| format!(":{line}: {e}"))?;
            if ![t, x, y, z].iter().all(|v| v.is_finite()) {
                return Err(format!(":{line}: allowed: finite numbers"));
            }
            if points.last().is_some_and(|p| t <= p.0) {
                return Err(format!(":{line}: t_s is {t}, allowed: above the line before"));
            }
            points.push((t, [x, y, z]));
        }
        if points.is_empty() { Err(": no rows".into()) } else { Ok(Path::Points(points)) }
    }

    /// Position [m] at `t` [s], for a hand that grabbed at `home` [m].
    pub(super) fn at(&self, t: f64, home: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = home;
        match self {
            Path::Circle { radius, speed } => {
                let (sin, cos) = (travel(*speed, t) / radius).sin_cos();
                [x + radius * sin, y, z + radius * (1.0 - cos)]
            }
            Path::Pull { length, speed } => {
                let phase = travel(*speed, t) / length * TAU / 4.0;
                [x, y, z + length * 0.5 * (1.0 - phase.cos())]
            }
            Path::Points(points) => {
                let k = points.partition_point(|p| p.0 <= t);
                let (a, b) = (points[k.saturating_sub(1)], points[k.min(points.len() - 1)]);
                let s = if b.0 > a.0 { ((t - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 0.0 };
                std::array::from_fn(|i| a.1[i] + s * (b.1[i] - a.1[i]))
            }
        }
    }
}

/// Way gone [m] after `t` [s], with the speed ramped up from zero.
fn travel(speed: f64, t: f64) -> f64 {
    if t < RAMP { speed * t * t / (2.0 * RAMP) } else { speed * (t - RAMP / 2.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_begin_where_the_hand_grabbed_and_keep_their_size() {
        let home = [0.1, 0.2, 0.3];
        for path in [Path::Circle { radius: 0.02, speed: 0.1 }, Path::Pull { length: 0.02, speed: 0.1 }] {
            assert_eq!(path.at(0.0, home), home);
            for k in 0..1000 {
                let p = path.at(f64::from(k) * 0.005, home);
                let far = (0..3).map(|i| (p[i] - home[i]).powi(2)).sum::<f64>().sqrt();
                assert!(far <= 0.04 + 1e-12, "{path:?}: {far}");
            }
        }
    }

    #[test]
    fn points_are_joined_by_straight_lines_and_bad_files_are_named_by_line() {
        let path = Path::points("t_s,x_m,y_m,z_m\n0, 0,0,0\n2, 1,0,-1\n").unwrap();
        assert_eq!(path.at(1.0, [9.0; 3]), [0.5, 0.0, -0.5]);
        assert_eq!(path.at(7.0, [9.0; 3]), [1.0, 0.0, -1.0]);
        assert_eq!(path.at(-1.0, [9.0; 3]), [0.0; 3]);
        for (text, start) in [
            ("t,x,y,z\n", ":1:"),
            ("t_s,x_m,y_m,z_m\n0,0,0,zero\n", ":2:"),
            ("t_s,x_m,y_m,z_m\n0,0,0,0\n0,0,0,0\n", ":3:"),
            ("t_s,x_m,y_m,z_m\n", ": no rows"),
        ] {
            let words = Path::points(text).unwrap_err();
            assert!(words.starts_with(start), "{words}");
        }
    }
}
