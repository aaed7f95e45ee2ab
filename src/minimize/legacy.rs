//! What the solver of one mesh leaves to that of another.

use super::Minimizer;
use crate::{
    grid::Interpolation,
    math::{Mat3, Vec3},
    model::Model,
};

/// What is fixed, what the hand's response was, what is out of balance.
pub struct Legacy {
    /// Fixed particles.
    pub fixed: Vec<bool>,
    hand: Option<u32>,
    gradient: Vec<Vec3>,
    response: Vec<Mat3>,
    responds_to: Option<u32>,
    stiffness: Mat3,
    is_static: bool,
    pauses: [u32; 3],
    was_exact: bool,
    solves: u32,
    troubled: bool,
    strayed: bool,
    circles: bool,
}

impl Minimizer {
    /// What it leaves.
    pub fn legacy(&self) -> Legacy {
        Legacy {
            fixed: self.system.fixed.clone(),
            hand: self.system.hand,
            gradient: self.gradient.clone(),
            response: self.response.clone(),
            responds_to: self.responds_to,
            stiffness: self.stiffness,
            is_static: self.iterative.as_ref().is_some_and(|iterative| iterative.is_static),
            pauses: [self.pause, self.next_pause, self.lean_pause],
            was_exact: self.was_exact,
            solves: self.solves,
            troubled: self.troubled,
            strayed: self.strayed,
            circles: self.circles,
        }
    }

    /// Goes on where the solver of another mesh was.
    pub fn take_over(&mut self, legacy: &Legacy, old: &Model, new: &Model) {
        let particles = old.grid.particles();
        self.system.fixed[..particles].copy_from_slice(&legacy.fixed[..particles]);
        self.system.hand = legacy.hand;
        [self.pause, self.next_pause, self.lean_pause] = legacy.pauses;
        (self.stiffness, self.responds_to) = (legacy.stiffness, legacy.responds_to);
        (self.was_exact, self.solves) = (legacy.was_exact, legacy.solves);
        (self.troubled, self.strayed, self.circles) = (legacy.troubled, legacy.strayed, legacy.circles);
        for n in new.grid.active() {
            if old.grid.is_active(n) {
                (self.gradient[n], self.response[n]) = (legacy.gradient[n], legacy.response[n]);
                continue;
            }
            let masters = old.grid.masters(n, Interpolation::Linear);
            self.gradient[n] = Vec3::zeros();
            self.response[n] = masters.iter().map(|&(m, w)| legacy.response[m as usize] * w).sum();
        }
        self.share_response();
        self.iterative.iter_mut().for_each(|iterative| iterative.is_static = legacy.is_static);
    }
}
