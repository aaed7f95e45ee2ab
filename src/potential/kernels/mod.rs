//! Kernels that take a batch of elements at a time: measures, gradient, Hessian.
//!
//! The formulas are those of `edge`, `triple`, `shear` and `twist`, which tests compare with; here they run in all lanes at once. The order of
//! the batches fixes the order of every sum.

use crate::{
    batch::{Batches, Ids, Planes},
    fabric::{Fabric, law::Lanes},
    math::pack::{Pack, Pack3, WIDTH},
    potential::Curvature,
    state::History,
};
use pulp::Simd;

pub mod edges;
pub mod energy;
pub mod laws;
pub mod lean;
pub mod shears;
pub mod triples;
pub mod twists;

/// What every kernel reads.
#[derive(Clone, Copy)]
pub struct Given<'a> {
    /// Elements.
    pub batches: &'a Batches,
    /// Laws.
    pub fabric: &'a Fabric,
    /// Internal variables.
    pub history: &'a History,
    /// Part of the elements' rests that counts.
    pub rests: f64,
    /// Positions [m].
    pub x: &'a Planes,
}

impl Given<'_> {
    /// What counts as none of the elements' rests.
    #[inline(always)]
    fn none<S: Simd>(&self, simd: S, rests: &[f64; WIDTH], from: usize) -> Pack<S> {
        Pack::load(simd, rests, from) * Pack::splat(simd, self.rests)
    }
}

/// Force and stiffness of a law, as a Hessian of a kind takes them.
#[inline(always)]
fn answer<S: Simd>(law: &mut Lanes, simd: S, x: Pack<S>, p: Pack<S>, kind: Curvature) -> [Pack<S>; 2] {
    let [force, stiffness, _] = match kind {
        Curvature::Exact | Curvature::Clamped => law.evaluate(simd, x, p),
        Curvature::Bounding => law.bound(simd, x, p),
    };
    [force, stiffness]
}

/// Positions of one node of each element. Lanes of a run that do not count get what lies there: finite numbers.
#[inline(always)]
fn gather<S: Simd>(simd: S, x: &Planes, is_run: bool, nodes: &[u32; WIDTH], from: usize) -> Pack3<S> {
    if is_run {
        return x.load(simd, nodes[0] as usize + from);
    }
    let Planes { list, stride } = x;
    let mut lanes = [[0.0; WIDTH]; 3];
    for lane in 0..S::F64_LANES {
        for k in 0..3 {
            lanes[k][lane] = list[k * stride + nodes[from + lane] as usize];
        }
    }
    [Pack::load(simd, &lanes[0], 0), Pack::load(simd, &lanes[1], 0), Pack::load(simd, &lanes[2], 0)]
}

/// Positions of every node of each element.
#[inline(always)]
pub(super) fn gather_all<S: Simd, const N: usize>(
    simd: S,
    x: &Planes,
    is_run: bool,
    nodes: &[[u32; WIDTH]; N],
    from: usize,
) -> [Pack3<S>; N] {
    let mut out = [[Pack::splat(simd, 0.0); 3]; N];
    for n in 0..N {
        out[n] = gather(simd, x, is_run, &nodes[n], from);
    }
    out
}

/// Numbers of the elements themselves.
#[inline(always)]
fn pick<S: Simd>(simd: S, values: &[f64], ids: &Ids, from: usize) -> Pack<S> {
    if ids.is_run {
        return Pack::load_at(simd, values, ids.lanes[0] as usize + from);
    }
    let mut lanes = [0.0; WIDTH];
    for lane in 0..S::F64_LANES {
        lanes[lane] = values[ids.lanes[from + lane] as usize];
    }
    Pack::load(simd, &lanes, 0)
}

/// The `which`-th of two numbers of the elements themselves.
#[inline(always)]
fn pick_of<S: Simd>(simd: S, values: &[[f64; 2]], which: usize, ids: &Ids, from: usize) -> Pack<S> {
    let mut lanes = [0.0; WIDTH];
    if ids.is_run {
        let values = &values[ids.lanes[0] as usize + from..][..S::F64_LANES];
        for lane in 0..S::F64_LANES {
            lanes[lane] = values[lane][which];
        }
    } else {
        for lane in 0..S::F64_LANES {
            lanes[lane] = values[ids.lanes[from + lane] as usize][which];
        }
    }
    Pack::load(simd, &lanes, 0)
}

/// Puts a number of each element that counts in its place.
#[inline(always)]
fn put<S: Simd>(to: &mut [f64], ids: &Ids, from: usize, value: Pack<S>) {
    if ids.is_run && from + S::F64_LANES <= ids.full {
        return value.store_at(to, ids.lanes[0] as usize + from);
    }
    let mut lanes = [0.0; WIDTH];
    value.store(&mut lanes, 0);
    for (id, value) in ids.counting(from, S::F64_LANES).iter().zip(lanes) {
        to[*id as usize] = value;
    }
}

/// Adds a vector to one node of each element.
#[inline(always)]
fn scatter<S: Simd>(out: &mut Planes, is_run: bool, nodes: &[u32; WIDTH], from: usize, value: Pack3<S>) {
    if is_run {
        return out.add(nodes[0] as usize + from, value);
    }
    let Planes { list, stride } = out;
    let mut lanes = [[0.0; WIDTH]; 3];
    for k in 0..3 {
        value[k].store(&mut lanes[k], 0);
    }
    for lane in 0..S::F64_LANES {
        for k in 0..3 {
            list[k * *stride + nodes[from + lane] as usize] += lanes[k][lane];
        }
    }
}

/// Keeps what an element measured and how its law answered.
#[inline(always)]
fn keep<S: Simd>(to: &mut [[f64; 2]], ids: &Ids, from: usize, measure: Pack<S>, force: Pack<S>) {
    let mut lanes = [[0.0; WIDTH]; 2];
    measure.store(&mut lanes[0], 0);
    force.store(&mut lanes[1], 0);
    if ids.is_run && from + S::F64_LANES <= ids.full {
        let to = &mut to[ids.lanes[0] as usize + from..][..S::F64_LANES];
        for lane in 0..S::F64_LANES {
            to[lane] = [lanes[0][lane], lanes[1][lane]];
        }
        return;
    }
    for (lane, id) in ids.counting(from, S::F64_LANES).iter().enumerate() {
        to[*id as usize] = [lanes[0][lane], lanes[1][lane]];
    }
}
