//! Friction anchors from mesh to mesh: what holds the cloth on an obstacle goes on holding it.
//!
//! Pieces of cloth that both meshes know keep their slip; where they stand for another area now, for as much per area. Particles that
//! merge hand pull and pressure on to their masters, those that are split off get them per area from theirs. Edges and triangles that are
//! no more let go: dead loads hold the cloth until others take hold in the next commit.

use crate::{
    grid::Interpolation,
    math::Vec3,
    model::Model,
    state::{Anchor, Meeting, Pair, State},
};
use nalgebra::Point3;
use std::collections::{BTreeMap, HashMap};

/// What a particle's friction does, in the obstacle's frame.
#[derive(Clone, Copy, Default)]
struct Hold {
    /// Pull towards the anchor, reversed [N].
    pull: Vec3,
    /// Normal force [N].
    force: f64,
    /// Outward normals, weighted by their forces.
    normal: Vec3,
}

/// The anchors on the new mesh, ordered by pair.
pub fn carry(old: &Model, new: &Model, state: &State, positions: &[Vec3]) -> Vec<Anchor> {
    let (was, now) = (&old.surface, &new.surface);
    if state.anchors.is_empty() {
        return Vec::new();
    }
    let edges: HashMap<[u32; 2], u32> = now.edges.iter().zip(0..).map(|(nodes, k)| (*nodes, k)).collect();
    let triangles: HashMap<[u32; 3], u32> =
        now.triangles.iter().zip(0..).map(|(nodes, k)| (*nodes, k)).collect();
    // What falls to particles that are split off, over what their masters stood for.
    let mut heirs: HashMap<u32, Vec<(usize, f64)>> = HashMap::new();
    for n in (0..now.areas.len()).filter(|&n| now.areas[n] > 0.0 && was.areas[n] == 0.0) {
        for (master, weight) in old.grid.masters(n, Interpolation::Linear) {
            let share = weight * now.areas[n] / was.areas[master as usize];
            heirs.entry(master).or_default().push((n, share));
        }
    }
    let mut carried = Vec::with_capacity(state.anchors.len());
    let mut holds: BTreeMap<Pair, Hold> = BTreeMap::new();
    let keep = |a: &Anchor, cloth: u32, areas: [f64; 2]| {
        let share = areas[1] / areas[0];
        let pair = Pair { cloth, ..a.pair };
        Anchor { pair, force: a.force * share, stiffness: a.stiffness * share, ..*a }
    };
    for a in &state.anchors {
        let k = a.pair.cloth as usize;
        match a.pair.kind {
            Meeting::EdgeRidge => carried.extend(
                edges
                    .get(&was.edges[k])
                    .map(|&to| keep(a, to, [was.edge_areas[k], now.edge_areas[to as usize]])),
            ),
            Meeting::TriangleCorner => carried.extend(
                triangles
                    .get(&was.triangles[k])
                    .map(|&to| keep(a, to, [was.triangle_areas[k], now.triangle_areas[to as usize]])),
            ),
            Meeting::ParticleFace => {
                let pose = &state.poses[a.pair.obstacle as usize];
                let place = pose.inverse_transform_point(&Point3::from(state.positions[k])).coords;
                let away = place - a.point;
                let pull = (away - a.normal * a.normal.dot(&away)) * a.stiffness;
                let mut give = |to: usize, share: f64| {
                    let hold = holds.entry(Pair { cloth: to as u32, ..a.pair }).or_default();
                    hold.pull += pull * share;
                    hold.force += a.force * share;
                    hold.normal += a.normal * (a.force * share);
                };
                // Heirs get no more than there is, and what none of them has stays, also where the area shrinks as triangles change.
                let inherited = heirs.get(&a.pair.cloth).map_or(&[][..], Vec::as_slice);
                let sum: f64 = inherited.iter().map(|(_, share)| share).sum();
                inherited.iter().for_each(|&(n, share)| give(n, share / sum.max(1.0)));
                let rest = 1.0 - sum.min(1.0);
                if now.areas[k] == 0.0 {
                    let masters = new.grid.masters(k, Interpolation::Linear);
                    masters.into_iter().for_each(|(n, w)| give(n as usize, w * rest));
                } else {
                    give(k, rest);
                }
            }
        }
    }
    for (pair, Hold { pull, force, normal }) in holds.into_iter().filter(|(_, hold)| hold.force > 0.0) {
        let n = pair.cloth as usize;
        let pose = &state.poses[pair.obstacle as usize];
        let place = pose.inverse_transform_point(&Point3::from(positions[n])).coords;
        let stiffness = new.contact.tangential * now.areas[n];
        let point = place - pull / stiffness;
        let nodes = [pair.cloth; 3];
        let weights = [1.0, 0.0, 0.0];
        carried.push(Anchor { pair, nodes, weights, point, normal: normal.normalize(), force, stiffness });
    }
    carried.sort_unstable_by_key(|a| a.pair);
    carried
}
