//! Carries a state from one mesh to the next.
//!
//! Positions follow cubic lines, so that curvature stays. Velocities go linearly, with the weights that mass is shared by: what is
//! split keeps its momentum exactly, what is merged gives it to its masters. Hysteresis is carried as the slip state in [−1, 1], an
//! area mean where elements merge, so forces stay in their envelopes. What the new mesh is then out of balance by, against the
//! accelerations of the old one, becomes a dead load that fades: neither shape nor force jumps. Tensions are an exception. Where the cloth is
//! bent, a merged edge is the chord of the arc that it was, compressed by θ²/24 of its turn θ; dead loads that held that back would let limp cloth
//! buckle into a zigzag and do work on it. So loads are those of edges that pull as before, and lengths come right in the next step. A transfer
//! either splits or merges.

use crate::{
    batch::Measures,
    fabric::law::Law,
    grid::{Edge, Interpolation, Shear, Triple},
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, edge, shear, triple},
    state::{Anchor, History, Meeting, State},
};
use std::collections::HashMap;

/// Weights over particles.
type Masters = Vec<(u32, f64)>;

/// How a new mesh's particles and elements follow from an old one's.
#[derive(Debug)]
pub struct Transfer {
    born: Vec<Born>,
    /// Particles that are active in the old mesh only, with their masters in the new one.
    gone: Vec<(u32, Masters)>,
    edges: Vec<Source>,
    triples: Vec<Source>,
    shears: Vec<Source>,
}

/// A particle that is active in the new mesh only, with its masters in the old one.
#[derive(Debug)]
struct Born {
    node: u32,
    cubic: Masters,
    linear: Masters,
}

/// How far from the straight way between its masters a new particle may be, over that way. An arc so high is 0.7 % longer than its chord;
/// live meshes stay below, but across large cells in folds, and crumpled ones, cubic lines would stretch the cloth without bounds.
const ARC: f64 = 0.05;

impl Born {
    /// Where it is: on the cubic line, as far as that is near the straight one.
    fn place(&self, x: &[Vec3]) -> Vec3 {
        let straight = sum(&self.linear, x);
        let way = self.linear.iter().map(|(n, _)| (x[*n as usize] - straight).norm()).fold(0.0, f64::max);
        let arc = sum(&self.cubic, x) - straight;
        straight + arc * (2.0 * ARC * way / arc.norm().max(f64::MIN_POSITIVE)).min(1.0)
    }
}

/// Where an element's history comes from.
#[derive(Debug)]
enum Source {
    /// The same element of the old mesh.
    Same(u32),
    /// Old elements, with weights that sum to one.
    Mean(Vec<(u32, f64)>),
}

impl Transfer {
    /// Finds what follows from what.
    pub fn new(old: &Model, new: &Model) -> Transfer {
        let (from, to) = (&old.grid, &new.grid);
        let born = to.active().filter(|&n| !from.is_active(n)).map(|n| Born {
            node: n as u32,
            cubic: from.masters(n, Interpolation::Cubic),
            linear: from.masters(n, Interpolation::Linear),
        });
        let gone = from.active().filter(|&n| !to.is_active(n));
        let sources = Sources::new(old);
        Transfer {
            born: born.collect(),
            gone: gone.map(|n| (n as u32, to.masters(n, Interpolation::Linear))).collect(),
            edges: new.elements.edges.iter().map(|e| sources.edge(e)).collect(),
            triples: new.elements.triples.iter().map(|t| sources.triple(t)).collect(),
            shears: new.elements.shears.iter().map(|s| sources.shear(s)).collect(),
        }
    }

    /// The state on the new mesh, its dead loads included. `fixed` particles keep the force that holds them.
    pub fn carry(&self, old: &Model, new: &Model, state: &State, fixed: &[bool]) -> State {
        let mut positions = self.room(new, &state.positions);
        for b in &self.born {
            positions[b.node as usize] = b.place(&state.positions);
        }
        new.elements.fill(&mut positions);
        let mut carried = State {
            history: self.history(old, new, state, &positions),
            anchors: self.anchors(old, new, state),
            poses: state.poses.clone(),
            motions: state.motions.clone(),
            velocities: self.velocities(old, new, &state.velocities),
            loads: vec![Vec3::zeros(); positions.len()],
            positions,
        };
        carried.loads = self.loads(old, new, state, &carried, fixed);
        carried
    }

    /// A field on the old nodes with the particles that both meshes know kept, and room for the new nodes.
    fn room(&self, new: &Model, field: &[Vec3]) -> Vec<Vec3> {
        let mut room = field[..new.grid.particles()].to_vec();
        room.resize(new.elements.nodes(), Vec3::zeros());
        room
    }

    /// Velocities or accelerations on the new mesh, so that mass times them sums to the same.
    pub fn velocities(&self, old: &Model, new: &Model, field: &[Vec3]) -> Vec<Vec3> {
        let mut carried = self.room(new, field);
        for b in &self.born {
            carried[b.node as usize] = sum(&b.linear, field);
        }
        let mut given: HashMap<u32, Vec3> = HashMap::new();
        for (k, masters) in &self.gone {
            for &(n, w) in masters {
                *given.entry(n).or_default() += field[*k as usize] * (old.mass(*k as usize) * w);
            }
        }
        for (n, momentum) in given {
            let n = n as usize;
            carried[n] = (field[n] * old.mass(n) + momentum) / new.mass(n);
        }
        new.elements.fill(&mut carried);
        carried
    }

    /// Dead loads that keep every particle's acceleration, and the force that holds fixed ones, but for what lengths bring about.
    fn loads(&self, old: &Model, new: &Model, state: &State, carried: &State, fixed: &[bool]) -> Vec<Vec3> {
        let [before, mut loads] = [(old, state), (new, carried)].map(|(model, state)| {
            let pull = Pull::none(model);
            let mut gradient = vec![Vec3::zeros(); state.positions.len()];
            let candidates = Candidates::of(model, state);
            let potential = Potential { model, state, candidates: &candidates, pull: &pull };
            potential.gradient(&state.positions, &mut gradient, &mut Measures::new(&model.elements));
            gradient
        });
        let mut acceleration = vec![Vec3::zeros(); before.len()];
        for n in old.grid.active().filter(|&n| !fixed[n]) {
            acceleration[n] = (state.loads[n] - before[n]) / old.mass(n);
        }
        old.elements.fill(&mut acceleration);
        let acceleration = self.velocities(old, new, &acceleration);
        for n in new.grid.active() {
            let force = if fixed[n] { state.loads[n] - before[n] } else { acceleration[n] * new.mass(n) };
            loads[n] += force;
        }
        let lacking = self.lacking_tension(old, new, state, carried);
        new.grid.active().for_each(|n| loads[n] += lacking[n]);
        loads
    }

    /// What the new gradient would have more if edges pulled as those did that they follow from [N].
    fn lacking_tension(&self, old: &Model, new: &Model, state: &State, carried: &State) -> Vec<Vec3> {
        let tension = |model: &Model, state: &State, k: usize| {
            let e = &model.elements.edges[k];
            let [a, b] = e.nodes.map(|n| state.positions[n as usize]);
            let strain = edge::strain(b - a, e.length);
            let law = &model.fabric.tensile[e.direction];
            (law.evaluate(strain.value, state.history.edges[k]).force, strain.gradient)
        };
        let area = |k: usize| old.elements.edges[k].width * old.elements.edges[k].length;
        let mut forces = vec![Vec3::zeros(); carried.positions.len()];
        for (k, source) in self.edges.iter().enumerate() {
            let was = source.mean(&area, &|k| tension(old, state, k).0);
            let e = &new.elements.edges[k];
            let (now, gradient) = tension(new, carried, k);
            let lacks = gradient * ((was - now) * e.width * e.length);
            forces[e.nodes[0] as usize] -= lacks;
            forces[e.nodes[1] as usize] += lacks;
        }
        new.elements.gather(&mut forces);
        forces
    }

    fn history(&self, old: &Model, new: &Model, state: &State, positions: &[Vec3]) -> History {
        let pull = Pull::default();
        let before = Potential { model: old, state, candidates: &Candidates::default(), pull: &pull };
        let after = Potential { model: new, ..before };
        let (fabric, was) = (&new.fabric, &state.history);
        let carry = |sources: &[Source], old_p: &[f64], area: &dyn Fn(usize) -> f64, measure: &Measure| {
            sources.iter().enumerate().map(|(k, source)| source.history(k, old_p, area, measure)).collect()
        };
        let (from, to) = (&old.elements, &new.elements);
        let (x, y) = (&state.positions, positions);
        let bend = |p: &Potential, t: &Triple, x: &[Vec3]| p.bend(t, &triple::Weights::new(t), x).value;
        let angle = |p: &Potential, s: &Shear, x: &[Vec3]| p.angle(s, &shear::Weights::new(s), x).value;
        History {
            edges: carry(
                &self.edges,
                &was.edges,
                &|k| from.edges[k].width * from.edges[k].length,
                &Measure {
                    law: &|k| &fabric.tensile[to.edges[k].direction],
                    before: &|k| before.strain(&from.edges[k], x).value,
                    after: &|k| after.strain(&to.edges[k], y).value,
                },
            ),
            triples: carry(
                &self.triples,
                &was.triples,
                &|k| from.triples[k].area,
                &Measure {
                    law: &|k| &fabric.bending[to.triples[k].direction],
                    before: &|k| bend(&before, &from.triples[k], x),
                    after: &|k| bend(&after, &to.triples[k], y),
                },
            ),
            shears: carry(
                &self.shears,
                &was.shears,
                &|k| from.shears[k].area,
                &Measure {
                    law: &|_| &fabric.shear,
                    before: &|k| angle(&before, &from.shears[k], x),
                    after: &|k| angle(&after, &to.shears[k], y),
                },
            ),
        }
    }

    /// Anchors of particles that both meshes know, with their new share of the pressure; what else touches takes hold in the next
    /// commit, and dead loads hold it until then.
    fn anchors(&self, old: &Model, new: &Model, state: &State) -> Vec<Anchor> {
        let (was, now) = (&old.surface.areas, &new.surface.areas);
        let keeps = |a: &&Anchor| {
            let n = a.pair.cloth as usize;
            a.pair.kind == Meeting::ParticleFace && new.grid.is_active(n) && old.grid.is_active(n)
        };
        let carry = |a: &Anchor| {
            let share = now[a.pair.cloth as usize] / was[a.pair.cloth as usize];
            Anchor { force: a.force * share, stiffness: a.stiffness * share, ..*a }
        };
        state.anchors.iter().filter(keeps).map(carry).collect()
    }
}

/// Law and strains of a kind of element, on the old mesh and on the new one.
struct Measure<'a> {
    /// Law of a new element.
    law: &'a dyn Fn(usize) -> &'a Law,
    /// Strain of an old element.
    before: &'a dyn Fn(usize) -> f64,
    /// Strain of a new element.
    after: &'a dyn Fn(usize) -> f64,
}

impl Source {
    fn history(&self, new: usize, old: &[f64], area: &dyn Fn(usize) -> f64, measure: &Measure) -> f64 {
        let (law, after) = ((measure.law)(new), (measure.after)(new));
        let only = match self {
            Source::Same(k) => Some(*k as usize),
            Source::Mean(merged) => merged.first().filter(|_| merged.len() == 1).map(|f| f.0 as usize),
        };
        if let Some(k) = only
            && (measure.before)(k) == after
        {
            return old[k];
        }
        let slip = |k: usize| ((law.enclosed((measure.before)(k)) - old[k]) / law.stick()).clamp(-1.0, 1.0);
        law.enclosed(after) - law.stick() * self.mean(area, &slip)
    }

    /// Mean over the area of what the old elements have.
    fn mean(&self, area: &dyn Fn(usize) -> f64, value: &dyn Fn(usize) -> f64) -> f64 {
        let merged = match self {
            Source::Same(k) => return value(*k as usize),
            Source::Mean(merged) => merged,
        };
        let (mut sum, mut total) = (0.0, 0.0);
        for &(k, weight) in merged {
            let k = k as usize;
            // An area of 0 (clamped) still counts a little, so that something does.
            let weight = weight * area(k).max(1e-15);
            sum += weight * value(k);
            total += weight;
        }
        sum / total
    }
}

fn sum(masters: &Masters, x: &[Vec3]) -> Vec3 {
    masters.iter().map(|&(n, w)| x[n as usize] * w).sum()
}

/// The elements of a mesh by their places.
struct Sources<'a> {
    model: &'a Model,
    edges: HashMap<[u32; 2], u32>,
    /// Per direction and particle: the edge over the interval that begins there.
    over: [Vec<Option<u32>>; 2],
    /// Per direction and particle: the triple there.
    bends: [Vec<Option<u32>>; 2],
    /// The shear element of the cell whose corner nearest (0, 0) is there.
    shears: HashMap<u32, u32>,
}

impl<'a> Sources<'a> {
    fn new(model: &'a Model) -> Sources<'a> {
        let (grid, elements) = (&model.grid, &model.elements);
        let empty = || [vec![None; grid.particles()], vec![None; grid.particles()]];
        let (mut over, mut bends) = (empty(), empty());
        for (e, k) in elements.edges.iter().zip(0..) {
            let [from, to] = e.nodes.map(|n| grid.site(n as usize));
            for step in from[e.direction]..to[e.direction] {
                let mut site = from;
                site[e.direction] = step;
                over[e.direction][grid.index(site)] = Some(k);
            }
        }
        for (t, k) in elements.triples.iter().zip(0..) {
            bends[t.direction][t.site as usize] = Some(k);
        }
        Sources {
            model,
            edges: elements.edges.iter().zip(0..).map(|(e, k)| (e.nodes, k)).collect(),
            over,
            bends,
            shears: elements.shears.iter().zip(0..).map(|(s, k)| (s.nodes[0], k)).collect(),
        }
    }

    fn edge(&self, e: &Edge) -> Source {
        if let Some(&k) = self.edges.get(&e.nodes) {
            return Source::Same(k);
        }
        let grid = &self.model.grid;
        let [from, to] = e.nodes.map(|n| grid.site(n as usize));
        let mut found = Vec::new();
        for step in from[e.direction]..to[e.direction] {
            let mut site = from;
            site[e.direction] = step;
            if let Some(k) = self.over[e.direction][grid.index(site)] {
                found.push((k, 1.0));
                continue;
            }
            // Inside an old cell: its two sides alongside.
            let cell = grid.leaf([0, 1].map(|k| site[k].min(grid.counts[k] - 2)));
            for side in [0, cell.size] {
                site[1 - e.direction] = cell.corner[1 - e.direction] + side;
                found.extend(self.over[e.direction][grid.index(site)].map(|k| (k, 0.5)));
            }
        }
        Source::Mean(found)
    }

    fn triple(&self, t: &Triple) -> Source {
        let (grid, bends) = (&self.model.grid, &self.bends[t.direction]);
        let here = bends[t.site as usize];
        if let Some(k) = here.filter(|&k| self.model.elements.triples[k as usize].lengths == t.lengths) {
            return Source::Same(k);
        }
        // Old triples within half an arm of its centre, along and across.
        let site = grid.site(t.site as usize);
        let arm = [0, 1].map(|k| (t.lengths[k] / grid.spacing(t.direction)).round() as usize / 2);
        let mut found = Vec::new();
        for step in site[t.direction].saturating_sub(arm[0])..=site[t.direction] + arm[1] {
            let reach = arm[0].min(arm[1]);
            let across = site[1 - t.direction];
            for beside in across.saturating_sub(reach)..=across + reach {
                let mut place = [beside; 2];
                place[t.direction] = step;
                if grid.contains(place) {
                    found.extend(bends[grid.index(place)].map(|k| (k, 1.0)));
                }
            }
        }
        if found.is_empty() {
            let masters = grid.masters(t.site as usize, Interpolation::Linear);
            found.extend(masters.iter().filter_map(|&(n, w)| Some((bends[n as usize]?, w))));
        }
        if found.is_empty() {
            // Beside a border, where no master bends this way: whatever does, nearest along the line.
            let next = |forward: bool| {
                (1..grid.counts[t.direction]).find_map(|step| {
                    let mut place = site;
                    place[t.direction] = if forward {
                        site[t.direction] + step
                    } else {
                        site[t.direction].checked_sub(step)?
                    };
                    grid.contains(place).then(|| bends[grid.index(place)]).flatten()
                })
            };
            found.extend(next(true).or_else(|| next(false)).map(|k| (k, 1.0)));
        }
        Source::Mean(found)
    }

    fn shear(&self, s: &Shear) -> Source {
        let grid = &self.model.grid;
        let [low, high] = [s.nodes[0], s.nodes[3]].map(|n| grid.site(n as usize));
        let mut found: Vec<(u32, f64)> = Vec::new();
        let places = (low[0]..high[0]).flat_map(|i| (low[1]..high[1]).map(move |j| [i, j]));
        for place in places {
            let cell = grid.leaf(place);
            if let Some(&k) = self.shears.get(&(grid.index(cell.corner) as u32)) {
                if cell.corner == low && low[0] + cell.size == high[0] {
                    return Source::Same(k);
                }
                // A share per interval of the new cell; the old cell's own area must not count again.
                let share = 1.0 / self.model.elements.shears[k as usize].area;
                match found.iter_mut().find(|f| f.0 == k) {
                    Some(known) => known.1 += share,
                    None => found.push((k, share)),
                }
            }
        }
        Source::Mean(found)
    }
}
