//! The sheet's shape at the start: flat or bowed, with a tiny smooth imperfection. Edges of a bowed sheet keep their length.

use crate::{math::Vec3, scene::Scene};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::f64::consts::{PI, TAU};

/// Waves of the imperfection along each direction.
const WAVES: usize = 4;

/// Positions [m] of all particles of a valid scene, particle (i, j) at i·J + j.
pub fn positions(scene: &Scene) -> Vec<Vec3> {
    let [count_i, count_j] = scene.particles;
    let place = &scene.placement;
    let [warp, weft] = [place.warp_axis, place.weft_axis].map(|a| Vec3::from(a).normalize());
    let normal = warp.cross(&weft);
    let step = scene.size_m[0] / (count_i - 1) as f64;
    let line = arc(count_j, scene.size_m[1], place.bow);
    let waves = Waves::new(place.seed);
    let mut positions = Vec::with_capacity(count_i * count_j);
    for i in 0..count_i {
        for (j, &[along, out]) in line.iter().enumerate() {
            let [u, v] = [i as f64 / (count_i - 1) as f64, j as f64 / (count_j - 1) as f64];
            let height = out + place.imperfection_m * waves.at(u, v);
            positions
                .push(Vec3::from(place.origin_m) + warp * (step * i as f64) + weft * along + normal * height);
        }
    }
    positions
}

/// A polyline of `count` particles with equal edges, `length` [m] in all, its ends nearer by the part `bow`: along and out [m].
fn arc(count: usize, length: f64, bow: f64) -> Vec<[f64; 2]> {
    let edges = (count - 1) as f64;
    let edge = length / edges;
    // Chord over length of a regular polyline that turns by `turn` at every particle.
    let chord = |turn: f64| (0.5 * edges * turn).sin() / (edges * (0.5 * turn).sin());
    let [mut low, mut high] = [0.0, TAU / edges];
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if middle > 0.0 && chord(middle) > 1.0 - bow { low = middle } else { high = middle }
    }
    let turn = if bow > 0.0 { 0.5 * (low + high) } else { 0.0 };
    let mut points = vec![[0.0, 0.0]];
    for n in 0..count - 1 {
        let heading = turn * (0.5 * (edges - 1.0) - n as f64);
        let [along, out] = points[n];
        points.push([along + edge * heading.cos(), out + edge * heading.sin()]);
    }
    points
}

/// A few waves with random phases and weights: smooth, at most 1 high.
struct Waves([[f64; 4]; WAVES * WAVES]);

impl Waves {
    fn new(seed: u64) -> Waves {
        let mut random = Pcg64::seed_from_u64(seed);
        let mut waves = [[0.0; 4]; WAVES * WAVES];
        for (n, wave) in waves.iter_mut().enumerate() {
            let [a, b] = [n / WAVES, n % WAVES].map(|k| PI * (k as f64 + 1.0));
            *wave = [a, b, random.random_range(0.0..TAU), random.random_range(-1.0..1.0)];
        }
        let sum: f64 = waves.iter().map(|w| w[3].abs()).sum();
        waves.iter_mut().for_each(|w| w[3] /= sum);
        Waves(waves)
    }

    fn at(&self, u: f64, v: f64) -> f64 {
        self.0.iter().map(|[a, b, phase, weight]| weight * (a * u + b * v + phase).cos()).sum()
    }
}
