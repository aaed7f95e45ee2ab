//! The energy that moving things may bring in, exact on any way.

use super::{Before, Look};
use crate::{
    math::Vec3,
    potential::{
        Potential, Pull,
        contact::{Contact, Pressed, candidates::Candidates, friction::Slip},
        shear, triple, twist,
    },
    state::{Pair, State},
};
use std::collections::BTreeMap;

/// Works of a step [J].
#[derive(Debug, Default)]
pub(super) struct Works {
    pub held: f64,
    pub loads: f64,
    pub unbalanced: f64,
    pub turned: f64,
    pub faded: f64,
}

/// Where a step led.
///
/// The force of what is moved is known at the end of its way alone. Yet laws are convex in their strains, barriers in their gaps, friction in
/// its slip: what each gained is no more than its force at the end on the change of its strain, gap or slip. Forces at the end, on the
/// ways of particles, give that change as it goes on there; what turns on its way (a cell that is drawn through a fold, cloth that slides on an
/// obstacle that turns) changes by more or less. The energy of this difference is exact, of any element on any way.
pub(super) struct Course {
    /// Ways of all nodes [m].
    pub way: Vec<Vec3>,
}

impl Course {
    pub fn new(look: &Look, before: &Before) -> Course {
        let ends = look.state.positions.iter().zip(&before.state.positions);
        Course { way: ends.map(|(b, a)| b - a).collect() }
    }

    /// Change of a strain by its gradient in the nodes.
    fn rate(&self, nodes: &[u32], gradient: &[Vec3]) -> f64 {
        nodes.iter().zip(gradient).map(|(n, g)| g.dot(&self.way[*n as usize])).sum()
    }

    /// That energy of elements [J].
    pub fn bent(&self, look: &Look, before: &Before) -> f64 {
        let (elements, fabric, history) = (&look.model.elements, &look.model.fabric, &before.state.history);
        let (candidates, pull) = (Candidates::default(), Pull::default());
        let potential =
            Potential { model: look.model, state: look.state, candidates: &candidates, pull: &pull };
        let (x1, x0) = (&look.state.positions, &before.state.positions);
        let mut work = 0.0;
        for (e, &p) in elements.edges.iter().zip(&history.edges) {
            let [old, new] = [x0, x1].map(|x| potential.strain(e, x));
            let rate = self.rate(&e.nodes, &[-new.gradient, new.gradient]);
            let force = fabric.tensile[e.direction].evaluate(new.value, p).force;
            work += e.width * e.length * force * (new.value - old.value - rate);
        }
        for (t, &p) in elements.triples.iter().zip(&history.triples) {
            let weights = triple::Weights::new(t);
            let [old, new] = [x0, x1].map(|x| potential.bend(t, &weights, x));
            let rate = self.rate(&t.nodes, &weights.spread(&new.gradient));
            let force = fabric.bending[t.direction].evaluate(new.value, p).force;
            work += t.area * force * (new.value - old.value - rate);
        }
        for (s, &p) in elements.shears.iter().zip(&history.shears) {
            let weights = shear::Weights::new(s);
            let [old, new] = [x0, x1].map(|x| potential.angle(s, &weights, x));
            let rate = self.rate(&s.nodes, &weights.spread(&new.gradient));
            let force = fabric.shear.evaluate(new.value, p).force;
            work += s.area * force * (new.value - old.value - rate);
            let weights = twist::Weights::new(s);
            let [old, new] = [x0, x1].map(|x| potential.turn(s, &weights, x));
            let rate = self.rate(&s.bent, &weights.spread(&new.gradient));
            work += s.area * fabric.twist * new.value * (new.value - old.value - rate);
        }
        work
    }

    /// That energy of pairs that touch, and of friction [J].
    ///
    /// A gap counts from where the barrier begins at the most. A fade is not convex: what it changed counts as it is. A pair that presses no
    /// more gained nothing.
    pub fn pressed(&self, look: &Look, before: &Before) -> f64 {
        let (model, state) = (look.model, look.state);
        let pressed = |state: &State| -> BTreeMap<Pair, Pressed> {
            let candidates = Candidates::of(model, state);
            let contact = Contact { model, state, candidates: &candidates };
            let mut pressed = BTreeMap::new();
            contact.pressed(&state.positions, &self.way, &mut |p| _ = pressed.insert(p.pair, p));
            pressed
        };
        let started = pressed(&before.state);
        let mut work = 0.0;
        for Pressed { pair, gap: [gap, coming], fade: [fade, turning], whole, force } in
            pressed(state).into_values()
        {
            let (from, faded) = started.get(&pair).map_or((model.contact.barrier.activation, 0.0), |p| {
                (p.gap[0], (fade - p.fade[0]) * p.whole)
            });
            work += force * (from - gap + coming) + faded - turning * whole;
        }
        for anchor in &before.state.anchors {
            let o = anchor.pair.obstacle as usize;
            let [start, end] = [&before.state, state].map(|s| Slip::new(model, s, anchor, &s.positions));
            // It depends on how long the slip is: that may as well have turned with the obstacle.
            let turned =
                state.poses[o].rotation * (before.state.poses[o].rotation.inverse() * start.offset());
            let own: Vec3 =
                anchor.nodes.iter().zip(anchor.weights).map(|(&n, w)| self.way[n as usize] * w).sum();
            work += end.gradient().dot(&(end.offset() - turned - own));
        }
        work
    }
}
