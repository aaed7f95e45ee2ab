//! A pair that touches: its energy, forces and Hessian.

use super::distance::{Blocks, Near};
use crate::{
    math::{Mat3, Vec3},
    model::Model,
    obstacle::Gap,
    potential::Curvature,
    state::Pair,
};

/// Squared sine of the angle between an edge and a ridge below which they are faded out, for an edge at rest length.
const PARALLEL: f64 = 1e-3;

/// A pair that presses: its energy is `fade` times `whole`, and its gap and fade are felt along a way of the cloth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pressed {
    /// What touches what.
    pub pair: Pair,
    /// Gap [m], and its change along the way while the obstacle stands [m].
    pub gap: [f64; 2],
    /// What is left where an edge and a ridge are nearly parallel, and its change along the way.
    pub fade: [f64; 2],
    /// Energy without the fade [J].
    pub whole: f64,
    /// Normal force [N].
    pub force: f64,
}

/// A pair below the activation distance.
#[derive(Clone)]
pub(super) struct Touch {
    pub pair: Pair,
    pub nodes: [u32; 3],
    pub count: usize,
    pub weights: [f64; 3],
    pub gap: f64,
    pub normal: Vec3,
    /// Area it stands for [m²].
    pub area: f64,
    pub nearest: Nearest,
    pub fade: Option<Fade>,
}

/// What the Hessian of the gap comes from.
#[derive(Clone)]
pub(super) enum Nearest {
    Shape(Mat3),
    Parts(Near),
}

/// A factor that falls to 0 as an edge and a ridge become parallel: z (2 − z), z the squared sine over its bound.
#[derive(Clone)]
pub(super) struct Fade {
    value: f64,
    /// In the edge's vector.
    gradient: Vec3,
    hessian: Mat3,
}

impl Fade {
    pub fn new(edge: Vec3, rest: f64, ridge: Vec3) -> Option<Fade> {
        let u = ridge.normalize();
        let scale = 1.0 / (PARALLEL * rest * rest);
        let across = (Mat3::identity() - u * u.transpose()) * scale;
        let z = edge.dot(&(across * edge));
        if z >= 1.0 {
            return None;
        }
        let turn = across * edge * 2.0;
        let gradient = turn * (2.0 - 2.0 * z);
        let hessian = across * (2.0 * (2.0 - 2.0 * z)) - turn * turn.transpose() * 2.0;
        Some(Fade { value: z * (2.0 - z), gradient, hessian })
    }
}

impl Touch {
    pub fn of_particle(pair: Pair, area: f64, gap: &Gap) -> Touch {
        Touch {
            pair,
            nodes: [pair.cloth; 3],
            count: 1,
            weights: [1.0, 0.0, 0.0],
            gap: gap.value,
            normal: gap.normal,
            area,
            nearest: Nearest::Shape(gap.hessian),
            fade: None,
        }
    }

    pub fn of_parts(pair: Pair, nodes: [u32; 3], count: usize, near: Near, radius: f64, area: f64) -> Touch {
        Touch {
            pair,
            nodes,
            count,
            weights: near.weights,
            gap: near.distance - radius,
            normal: near.normal,
            area,
            nearest: Nearest::Parts(near),
            fade: None,
        }
    }

    pub fn fade(&self) -> f64 {
        self.fade.as_ref().map_or(1.0, |f| f.value)
    }

    pub fn energy(&self, model: &Model) -> f64 {
        self.area * self.fade() * model.contact.barrier.energy(self.gap)
    }

    /// Normal force [N].
    pub fn force(&self, model: &Model) -> f64 {
        -self.area * self.fade() * model.contact.barrier.slope(self.gap).0
    }

    /// The fade's gradient per unit of its value in particle `k` of the edge.
    fn turn(fade: &Fade, k: usize) -> Vec3 {
        if k == 0 { -fade.gradient } else { fade.gradient }
    }

    /// How the gap changes along a way of the cloth [m].
    fn coming(&self, way: &[Vec3]) -> f64 {
        (0..self.count).map(|k| self.normal.dot(&way[self.nodes[k] as usize]) * self.weights[k]).sum()
    }

    /// Whether what presses here would, led along a way [m] beyond its reach, be pushed back within the step by the force that it bears,
    /// where particles yield [m/N] to it.
    pub fn returns(&self, model: &Model, way: &[Vec3], yields: &dyn Fn(u32) -> f64) -> bool {
        let beyond = self.gap + self.coming(way) - model.contact.barrier.activation;
        let yields: f64 = (0..self.count).map(|k| self.weights[k].powi(2) * yields(self.nodes[k])).sum();
        (0.0..self.force(model) * yields).contains(&beyond)
    }

    pub fn pressed(&self, model: &Model, way: &[Vec3]) -> Pressed {
        let coming = self.coming(way);
        let way = |k: usize| way[self.nodes[k] as usize];
        let turning = self.fade.as_ref().map_or(0.0, |f| f.gradient.dot(&(way(1) - way(0))));
        Pressed {
            pair: self.pair,
            gap: [self.gap, coming],
            fade: [self.fade(), turning],
            whole: self.area * model.contact.barrier.energy(self.gap),
            force: self.force(model),
        }
    }

    pub fn gradient(&self, model: &Model, k: usize) -> Vec3 {
        let mut gradient = self.normal * (-self.force(model) * self.weights[k]);
        if let Some(fade) = &self.fade {
            gradient += Touch::turn(fade, k) * (self.area * model.contact.barrier.energy(self.gap));
        }
        gradient
    }

    pub fn hessian(&self, model: &Model, kind: Curvature, x: &[Vec3]) -> Blocks {
        let (w, n) = (self.weights, self.normal);
        let (slope, curvature) = model.contact.barrier.slope(self.gap);
        let press = n * n.transpose() * (self.area * self.fade() * curvature);
        let mut blocks = Blocks::default();
        for a in 0..self.count {
            for b in 0..self.count {
                blocks[a][b] = press * (w[a] * w[b]);
            }
        }
        if kind != Curvature::Exact {
            return blocks;
        }
        let turning = match &self.nearest {
            Nearest::Shape(hessian) => {
                let mut blocks = Blocks::default();
                blocks[0][0] = *hessian;
                blocks
            }
            Nearest::Parts(near) => {
                let cloth = self.nodes.map(|n| x[n as usize]);
                near.hessian(&cloth[..self.count])
            }
        };
        let energy = self.area * model.contact.barrier.energy(self.gap);
        for a in 0..self.count {
            for b in 0..self.count {
                blocks[a][b] += turning[a][b] * (self.area * self.fade() * slope);
                if let Some(fade) = &self.fade {
                    let sign = if a == b { 1.0 } else { -1.0 };
                    let [ta, tb] = [a, b].map(|k| Touch::turn(fade, k));
                    let mixed = ta * (n * w[b]).transpose() + (n * w[a]) * tb.transpose();
                    blocks[a][b] += fade.hessian * (sign * energy) + mixed * (self.area * slope);
                }
            }
        }
        blocks
    }
}
