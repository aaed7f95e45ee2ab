//! Carries a state from one mesh to the next.
//!
//! Positions follow cubic lines, so that curvature stays. Velocities go linearly, with the weights that mass is shared by: what is
//! split keeps its momentum exactly, what is merged gives it to its masters. Hysteresis is carried as the slip state in [−1, 1], an
//! area mean where elements merge, so forces stay in their envelopes.
//!
//! A merged element sees less than those that it stands for: an edge is the chord of an arc, shorter by θ²/24 of its turn θ, a ghost lies
//! in the middle of its side and not beside it, and what pulls in one thread and not in the next becomes one mean. So it measures from a
//! rest of its own, at which it pulls as they did together; rests fade while the cloth moves on. What the new mesh is then still out of
//! balance by, against the accelerations of the old one, becomes a dead load: neither shape nor force jumps. In a quiet cloth it is held
//! until the cloth moves on (the τ of multigrid, frozen), else it fades. Where cells are split, loads leave out what lengths bring about,
//! which come right in the next step: held back, it would let limp cloth buckle into a zigzag. A transfer either splits or merges.

use super::{
    anchors,
    source::{Source, Sources},
};
use crate::{
    batch::Measures,
    fabric::law::Law,
    grid::{Interpolation, Shear, Triple},
    math::Vec3,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, shear, triple},
    state::{History, State},
};
use std::collections::HashMap;

/// Weights over particles.
type Masters = Vec<(u32, f64)>;

/// Speed [m/s], and force out of balance over weight, below which a cloth is so near to rest that what merged elements do not see of it
/// stays.
const QUIET: [f64; 2] = [4e-3, 2e-3];

fn is_quiet(model: &Model, state: &State, fixed: &[bool]) -> bool {
    if state.velocities.iter().any(|v| v.norm() >= QUIET[0]) {
        return false;
    }
    let forces = gradient(model, state).0;
    let free = model.grid.active().filter(|&n| !fixed[n]);
    let pull: f64 = free.map(|n| (state.load(n) - forces[n]).norm()).sum();
    pull < QUIET[1] * model.weight_on_earth()
}

/// Gradient of a state without inertia [N]; what elements measure, and what may press.
fn gradient(model: &Model, state: &State) -> (Vec<Vec3>, Measures, Candidates) {
    let (pull, candidates) = (Pull::none(model), Candidates::of(model, state));
    let potential = Potential { model, state, candidates: &candidates, pull: &pull };
    let mut gradient = vec![Vec3::zeros(); state.positions.len()];
    let mut measures = Measures::new(&model.elements);
    potential.gradient(&state.positions, &mut gradient, &mut measures);
    (gradient, measures, candidates)
}

/// A state on a new mesh.
pub struct Carried {
    /// The state.
    pub state: State,
    /// What its elements measure.
    pub measures: Measures,
    /// What may press.
    pub candidates: Candidates,
}

/// Nodes of an element, where all nodes are, and the rest that it measures from.
type Place<'a> = (&'a [u32], &'a [Vec3], f64);

/// Whether an element lies where another one does and measures from the same rest.
fn stays((from, x, was): Place, (to, y, now): Place) -> bool {
    was == now && from.iter().zip(to).all(|(from, to)| x[*from as usize] == y[*to as usize])
}

/// How a new mesh's particles and elements follow from an old one's.
#[derive(Debug)]
pub struct Transfer {
    born: Vec<Born>,
    /// Particles that are active in the old mesh only, with their masters in the new one.
    gone: Vec<(u32, Masters)>,
    edges: Vec<Source>,
    triples: Vec<Source>,
    shears: Vec<Source>,
    /// Part of the old elements' rests that counted when those of merged ones were made.
    counted: f64,
    /// Whether what merged elements do not see is held: in a quiet cloth.
    pub holds: bool,
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

impl Transfer {
    /// Finds what follows from what.
    pub fn new(old: &Model, new: &Model) -> Transfer {
        let (from, to) = (&old.grid, &new.grid);
        let born = to.active().filter(|&n| !from.is_active(n)).map(|n| Born {
            node: n as u32,
            cubic: from.masters(n, Interpolation::Cubic),
            linear: from.masters(n, Interpolation::Linear),
        });
        let born: Vec<Born> = born.collect();
        let gone = from.active().filter(|&n| !to.is_active(n));
        let (sources, merges) = (Sources::new(old), born.is_empty());
        Transfer {
            gone: gone.map(|n| (n as u32, to.masters(n, Interpolation::Linear))).collect(),
            edges: sources.of_edges(new, merges),
            triples: sources.of_triples(new, merges),
            shears: sources.of_shears(new),
            counted: 0.0,
            holds: false,
            born,
        }
    }

    /// Whether cells merge.
    fn merges(&self) -> bool {
        self.born.is_empty()
    }

    /// Lets merged elements measure from where they answer as those do together that they follow from. What they do not see belongs to the
    /// shape of its time: where cells are split, only elements that stay keep their rests.
    pub fn fit_rests(&mut self, old: &Model, new: &mut Model, state: &State, fixed: &[bool]) {
        self.counted = state.rests;
        self.holds = self.merges() && is_quiet(old, state, fixed);
        if !self.merges() && state.rests == 0.0 {
            return;
        }
        let positions = self.positions(new, &state.positions);
        new.set_rests(self.kinds(old, new, state, &positions, |sources, kind| {
            let rest = |(k, source)| if self.merges() { kind.rest(k, source) } else { kind.kept(source) };
            sources.iter().enumerate().map(rest).collect()
        }));
    }

    /// Part of the new elements' rests that counts: all of them where cells merge, but for what has faded since they were made.
    fn rests(&self, state: &State) -> f64 {
        if !self.merges() {
            state.rests
        } else if self.counted > 0.0 {
            // Of a state that was restored meanwhile more may count.
            (state.rests / self.counted).min(1.0)
        } else {
            1.0
        }
    }

    /// Positions of the new mesh's nodes.
    fn positions(&self, new: &Model, old: &[Vec3]) -> Vec<Vec3> {
        let mut positions = old[..new.grid.particles()].to_vec();
        positions.resize(new.elements.nodes(), Vec3::zeros());
        for b in &self.born {
            positions[b.node as usize] = b.place(old);
        }
        new.elements.fill(&mut positions);
        positions
    }

    /// The state on the new mesh, its dead loads included. `fixed` particles keep the force that holds them.
    pub fn carry(&self, old: &Model, new: &Model, state: &State, fixed: &[bool]) -> Carried {
        let positions = self.positions(new, &state.positions);
        let [edges, triples, shears] = self.kinds(old, new, state, &positions, |sources, kind| {
            sources.iter().enumerate().map(|(k, source)| kind.history(k, source)).collect()
        });
        let mut carried = State {
            history: History { edges, triples, shears },
            anchors: anchors::carry(old, new, state, &positions),
            poses: state.poses.clone(),
            motions: state.motions.clone(),
            velocities: self.velocities(old, new, &state.velocities),
            loads: vec![Vec3::zeros(); positions.len()],
            held: vec![Vec3::zeros(); positions.len()],
            rests: self.rests(state),
            positions,
        };
        let (forces, measures, candidates) = gradient(new, &carried);
        let loads = self.loads(old, new, state, &carried, forces, fixed);
        if self.holds {
            carried.loads = self.forces(new, &state.loads);
            for (n, load) in loads.iter().enumerate() {
                carried.held[n] = load - carried.loads[n];
            }
        } else {
            carried.loads = loads;
        }
        Carried { state: carried, measures, candidates }
    }

    /// A field on the old nodes where both meshes know a particle, zero elsewhere.
    fn room(&self, new: &Model, field: &[Vec3]) -> Vec<Vec3> {
        let mut room = vec![Vec3::zeros(); new.elements.nodes()];
        new.grid.active().for_each(|n| room[n] = field[n]);
        room
    }

    /// Velocities or accelerations on the new mesh, so that mass times them sums to the same.
    pub fn velocities(&self, old: &Model, new: &Model, field: &[Vec3]) -> Vec<Vec3> {
        let mut carried = self.room(new, field);
        for b in &self.born {
            carried[b.node as usize] = sum(&b.linear, field);
        }
        for (n, momentum) in self.given(|k, w| field[k] * (old.mass(k) * w)) {
            carried[n] = (field[n] * old.mass(n) + momentum) / new.mass(n);
        }
        new.elements.fill(&mut carried);
        carried
    }

    /// Forces on the particles of the new mesh: those of merged ones go to their masters.
    fn forces(&self, new: &Model, field: &[Vec3]) -> Vec<Vec3> {
        let mut carried = self.room(new, field);
        self.given(|k, w| field[k] * w).into_iter().for_each(|(n, force)| carried[n] += force);
        carried
    }

    /// What merged particles give in all to each of their masters: each the `share` that its weight makes.
    fn given(&self, share: impl Fn(usize, f64) -> Vec3) -> HashMap<usize, Vec3> {
        let mut given: HashMap<usize, Vec3> = HashMap::new();
        for (k, masters) in &self.gone {
            for &(n, w) in masters {
                *given.entry(n as usize).or_default() += share(*k as usize, w);
            }
        }
        given
    }

    /// Dead loads, for forces of the new mesh, that keep every particle's acceleration, and the force that holds fixed ones, but for what
    /// lengths of split edges bring about.
    fn loads(
        &self,
        old: &Model,
        new: &Model,
        state: &State,
        carried: &State,
        forces: Vec<Vec3>,
        fixed: &[bool],
    ) -> Vec<Vec3> {
        let ((before, ..), mut loads) = (gradient(old, state), forces);
        let mut acceleration = vec![Vec3::zeros(); before.len()];
        for n in old.grid.active().filter(|&n| !fixed[n]) {
            acceleration[n] = (state.load(n) - before[n]) / old.mass(n);
        }
        old.elements.fill(&mut acceleration);
        let acceleration = self.velocities(old, new, &acceleration);
        for n in new.grid.active() {
            let force = if fixed[n] { state.load(n) - before[n] } else { acceleration[n] * new.mass(n) };
            loads[n] += force;
        }
        if !self.merges() {
            let lacking = self.lacking_tension(old, new, state, carried);
            new.grid.active().for_each(|n| loads[n] += lacking[n]);
        }
        loads
    }

    /// What the new gradient would have more if edges pulled as those of their own line did that they follow from [N].
    fn lacking_tension(&self, old: &Model, new: &Model, state: &State, carried: &State) -> Vec<Vec3> {
        let tension = |model: &Model, state: &State, k: usize| {
            let e = &model.elements.edges[k];
            let (candidates, pull) = (Candidates::default(), Pull::default());
            let potential = Potential { model, state, candidates: &candidates, pull: &pull };
            let strain = potential.strain(e, &state.positions);
            let law = &model.fabric.tensile[e.direction];
            (law.evaluate(strain.value, state.history.edges[k]).force, strain.gradient)
        };
        let area = |k: usize| old.elements.edges[k].width * old.elements.edges[k].length;
        let mut forces = vec![Vec3::zeros(); carried.positions.len()];
        let (x, y) = (&state.positions, &carried.positions);
        for (k, source) in self.edges.iter().enumerate() {
            if let Source::Same(of) = *source {
                let (was, now) = (&old.elements.edges[of as usize], &new.elements.edges[k]);
                let rests = [state.rests * was.rest, carried.rests * now.rest];
                if stays((&was.nodes, x, rests[0]), (&now.nodes, y, rests[1])) {
                    continue;
                }
            }
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

    /// Something of every element of each kind.
    fn kinds<T>(
        &self,
        old: &Model,
        new: &Model,
        state: &State,
        positions: &[Vec3],
        each: impl Fn(&[Source], &Kind) -> T,
    ) -> [T; 3] {
        let pull = Pull::default();
        let before = Potential { model: old, state, candidates: &Candidates::default(), pull: &pull };
        let after = Potential { model: new, ..before };
        let (fabric, history) = (&new.fabric, &state.history);
        let (from, to) = (&old.elements, &new.elements);
        let (x, y) = (&state.positions, positions);
        // New elements measure from their rests as they will count.
        let counts = self.rests(state);
        let more = counts - state.rests;
        let bend = |p: &Potential, t: &Triple, x: &[Vec3]| p.bend(t, &triple::Weights::new(t), x).value;
        let angle = |p: &Potential, s: &Shear, x: &[Vec3]| p.angle(s, &shear::Weights::new(s), x).value;
        [
            each(
                &self.edges,
                &Kind {
                    law: &|k| &fabric.tensile[to.edges[k].direction],
                    history: &history.edges,
                    area: &|k| from.edges[k].width * from.edges[k].length,
                    before: &|k| before.strain(&from.edges[k], x).value,
                    after: &|k| after.strain(&to.edges[k], y).value - more * to.edges[k].rest,
                    rest_of: &|k| from.edges[k].rest,
                    rests: state.rests,
                    stays: &|k, new| {
                        let (was, now) = (&from.edges[k], &to.edges[new]);
                        stays((&was.nodes, x, state.rests * was.rest), (&now.nodes, y, counts * now.rest))
                    },
                },
            ),
            each(
                &self.triples,
                &Kind {
                    law: &|k| &fabric.bending[to.triples[k].direction],
                    history: &history.triples,
                    area: &|k| from.triples[k].area,
                    before: &|k| bend(&before, &from.triples[k], x),
                    after: &|k| bend(&after, &to.triples[k], y) - more * to.triples[k].rest,
                    rest_of: &|k| from.triples[k].rest,
                    rests: state.rests,
                    stays: &|k, new| {
                        let (was, now) = (&from.triples[k], &to.triples[new]);
                        stays((&was.nodes, x, state.rests * was.rest), (&now.nodes, y, counts * now.rest))
                    },
                },
            ),
            each(
                &self.shears,
                &Kind {
                    law: &|_| &fabric.shear,
                    history: &history.shears,
                    area: &|k| from.shears[k].area,
                    before: &|k| angle(&before, &from.shears[k], x),
                    after: &|k| angle(&after, &to.shears[k], y) - more * to.shears[k].rest,
                    rest_of: &|k| from.shears[k].rest,
                    rests: state.rests,
                    stays: &|k, new| {
                        let (was, now) = (&from.shears[k], &to.shears[new]);
                        stays((&was.nodes, x, state.rests * was.rest), (&now.nodes, y, counts * now.rest))
                    },
                },
            ),
        ]
    }
}

/// A kind of element, on the old mesh and on the new one.
struct Kind<'a> {
    /// Law of a new element.
    law: &'a dyn Fn(usize) -> &'a Law,
    /// Internal variable of the old elements.
    history: &'a [f64],
    /// Area of an old element [m²].
    area: &'a dyn Fn(usize) -> f64,
    /// Strain of an old element, from its rest.
    before: &'a dyn Fn(usize) -> f64,
    /// Strain of a new element, from its rest.
    after: &'a dyn Fn(usize) -> f64,
    /// Strain that would count as none in an old element, and the part of it that does.
    rest_of: &'a dyn Fn(usize) -> f64,
    rests: f64,
    /// Whether a new element lies where an old one does, and measures from the same rest.
    stays: &'a dyn Fn(usize, usize) -> bool,
}

impl Kind<'_> {
    /// Slip state in [−1, 1] that a new element takes over.
    fn slip(&self, new: usize, source: &Source) -> f64 {
        let law = (self.law)(new);
        let slip = |k: usize| (law.enclosed((self.before)(k)) - self.history[k]) / law.stick();
        source.mean(self.area, &|k| slip(k).clamp(-1.0, 1.0))
    }

    /// Internal variable of a new element.
    fn history(&self, new: usize, source: &Source) -> f64 {
        if let Source::Same(k) = source
            && (self.stays)(*k as usize, new)
        {
            return self.history[*k as usize];
        }
        let (law, after) = ((self.law)(new), (self.after)(new));
        if let Some(k) = source.only()
            && (self.before)(k) == after
        {
            return self.history[k];
        }
        law.enclosed(after) - law.stick() * self.slip(new, source)
    }

    /// What would count as none in an old element that stays.
    fn kept(&self, source: &Source) -> f64 {
        if let Source::Same(k) = source { (self.rest_of)(*k as usize) } else { 0.0 }
    }

    /// Strain that counts as none in a merged element, or in one that stays where others merge.
    fn rest(&self, new: usize, source: &Source) -> f64 {
        let (law, after) = ((self.law)(new), (self.after)(new));
        if let Source::Same(k) = source {
            let (before, rest) = ((self.before)(*k as usize), self.rests * (self.rest_of)(*k as usize));
            return if after - rest == before { rest } else { after - before };
        }
        let force = source.mean(self.area, &|k| law.evaluate((self.before)(k), self.history[k]).force);
        let [low, high] = source.range(self.before);
        after - law.strain_at(force, self.slip(new, source)).max(low).min(high)
    }
}

fn sum(masters: &Masters, x: &[Vec3]) -> Vec3 {
    masters.iter().map(|&(n, w)| x[n as usize] * w).sum()
}
