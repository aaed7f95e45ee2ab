//! What the guard knows of the step that it looks at, and of the place from which that starts.

use crate::{math::Vec3, model::Model};
use nalgebra::Isometry3;

/// A plane with the obstacle's piece behind it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Plane {
    /// Away from the piece.
    pub normal: Vec3,
    /// A point of the plane [m].
    pub foot: Vec3,
}

impl Plane {
    /// How far a place is in front of it [m].
    pub fn height(&self, x: Vec3) -> f64 {
        self.normal.dot(&(x - self.foot))
    }
}

/// A plane that a node would come too near to.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// The node.
    pub node: u32,
    /// The plane's normal.
    pub normal: Vec3,
    /// How much nearer it may come [m].
    pub room: f64,
}

/// Memory of the guard.
#[derive(Clone, Debug, Default)]
pub struct Room {
    /// What keeps nodes from their whole steps.
    pub stops: Vec<Stop>,
    /// Nodes whose pieces of cloth are to be looked at.
    pub asked: Vec<bool>,
    /// Share of each particle's step that it may go.
    pub shares: Vec<f64>,
    /// What is known beside each obstacle.
    pub beside: Vec<Beside>,
}

/// What is known beside an obstacle.
#[derive(Clone, Debug, Default)]
pub struct Beside {
    /// Per node the planes of the shape that it keeps above all the way.
    pub above: Vec<Above>,
    /// Per triangle the plane that it was last above as a whole.
    pub last: Vec<u8>,
    /// Per triangle where it was when a plane between it and the obstacle was last found, and that plane: several steps are tried from one
    /// place.
    pub partings: Vec<([Vec3; 3], Plane)>,
    /// Where the obstacle was then.
    pose: Isometry3<f64>,
}

/// Which planes of a shape a node keeps above all the way, a bit each; and which were looked at.
#[derive(Clone, Copy, Debug, Default)]
pub struct Above {
    planes: u8,
    seen: u8,
}

impl Above {
    /// Whether it keeps above a plane, which is looked at once.
    #[inline]
    pub fn knows(&mut self, plane: usize, keeps_above: impl FnOnce() -> bool) -> bool {
        let bit = 1 << plane;
        if self.seen & bit == 0 {
            self.seen |= bit;
            self.planes |= if keeps_above() { bit } else { 0 };
        }
        self.planes & bit != 0
    }
}

impl Room {
    /// Asks for the nodes that go somewhere.
    pub fn ask_for_movers(&mut self, model: &Model, step: &[Vec3]) {
        self.asked.clear();
        self.asked.extend(step.iter().map(|way| *way != Vec3::zeros()));
        self.ask_for_ghosts(model);
    }

    /// Asks for the nodes that stops keep from something, and forgets what they keep above.
    pub fn ask_for_stopped(&mut self, model: &Model) {
        let Room { stops, asked, .. } = self;
        asked.fill(false);
        for stop in &*stops {
            model.elements.each_master(stop.node, |m, _| asked[m as usize] = true);
        }
        self.ask_for_ghosts(model);
        for beside in &mut self.beside {
            let asked_for = beside.above.iter_mut().zip(&self.asked).filter(|(_, asked)| **asked);
            asked_for.for_each(|(above, _)| *above = Above::default());
        }
    }

    /// Ghosts go where their masters go.
    fn ask_for_ghosts(&mut self, model: &Model) {
        for ghost in &model.elements.ghosts {
            self.asked[ghost.node as usize] = ghost.masters.iter().any(|&(m, _)| self.asked[m as usize]);
        }
    }

    /// Forgets what nodes keep above on their way, and of obstacles that are elsewhere now all.
    pub fn begin(&mut self, model: &Model, poses: &[Isometry3<f64>], nodes: usize) {
        self.beside.resize_with(poses.len(), Beside::default);
        for (beside, pose) in self.beside.iter_mut().zip(poses) {
            beside.above.clear();
            beside.above.resize(nodes, Above::default());
            let triangles = model.surface.triangles.len();
            beside.last.resize(triangles, 0);
            if beside.pose != *pose || beside.partings.len() != triangles {
                // No triangle is at a place that is not a number.
                let unknown = ([Vec3::repeat(f64::NAN); 3], Plane::default());
                beside.partings.clear();
                beside.partings.resize(triangles, unknown);
                beside.pose = *pose;
            }
        }
    }
}
