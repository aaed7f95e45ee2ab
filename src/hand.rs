//! What the hand feels: reaction with its error bound, condensed stiffness, and the affine force model around the continued path.
//!
//! With H the last factored Hessian and X = H_ii⁻¹ H_ih (the cloth's response to the hand): the raw gradient at the handle is
//! not the force while the cloth is out of balance; g_h − Xᵀ g_i is, to first order, and |Xᵀ g_i| bounds what was corrected.

use crate::{
    grid::{Elements, Site},
    math::{Mat3, Vec3},
    minimize::Minimizer,
};

/// What the hand feels: F(p, t) = force + rate·τ − stiffness (p − position − velocity τ), τ from 0 to the horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandReport {
    /// The held particle.
    pub particle: Site,
    /// True while a client's hand holds it; false while it is merely pinned.
    pub held: bool,
    /// Position [m].
    pub position: Vec3,
    /// Velocity [m/s].
    pub velocity: Vec3,
    /// Force of the cloth on the hand [N].
    pub force: Vec3,
    /// Bound on the error of the force from incomplete minimization [N].
    pub force_error: f64,
    /// Rate of the force along the continued path [N/s].
    pub rate: Vec3,
    /// Condensed stiffness within the horizon [N/m], symmetric; not yet clamped to a device.
    pub stiffness: Mat3,
    /// Validity: distance from the continued path [m].
    pub radius: f64,
    /// Validity: time from the state [s].
    pub horizon: f64,
}

/// How every node moves with a unit displacement of the hand, by the last factor.
#[derive(Clone, Debug)]
pub struct Reach(Vec<Mat3>);

impl Reach {
    /// From a minimizer that has just solved with a hand; ghosts follow their masters.
    pub fn new(minimizer: &Minimizer, elements: &Elements) -> Reach {
        let system = &minimizer.system;
        let free = |n: usize| if system.fixed[n] { Mat3::zeros() } else { -minimizer.response[n] };
        let mut reach: Vec<Mat3> = (0..minimizer.response.len()).map(free).collect();
        if let Some(hand) = system.hand {
            reach[hand as usize] = Mat3::identity();
        }
        for ghost in &elements.ghosts {
            reach[ghost.node as usize] = ghost.masters.iter().map(|&(n, w)| reach[n as usize] * w).sum();
        }
        Reach(reach)
    }

    /// Displacement of a node per displacement of the hand [1].
    pub fn response(&self, node: usize) -> Mat3 {
        self.0[node]
    }
}

/// Gradients of the cloth at the hand, each corrected for free particles out of balance, and the corrections: (g_h − Xᵀ g_i, Xᵀ g_i) [N].
pub fn corrected<const K: usize>(minimizer: &Minimizer, gradients: [&[Vec3]; K]) -> [(Vec3, Vec3); K] {
    let Minimizer { system, response, .. } = minimizer;
    let Some(hand) = system.hand else { return [(Vec3::zeros(), Vec3::zeros()); K] };
    let mut corrections = [Vec3::zeros(); K];
    for n in system.pattern.order.iter().map(|&n| n as usize).filter(|&n| !system.fixed[n]) {
        for (correction, gradient) in corrections.iter_mut().zip(gradients) {
            *correction += response[n].tr_mul(&gradient[n]);
        }
    }
    std::array::from_fn(|k| (gradients[k][hand as usize] - corrections[k], corrections[k]))
}

/// Condensed stiffness K = H_hh − H_hi H_ii⁻¹ H_ih of the last factor [N/m], made symmetric against rounding.
pub fn stiffness(minimizer: &Minimizer) -> Mat3 {
    let k = minimizer.stiffness;
    (k + k.transpose()) * 0.5
}
