//! What the hand feels: the newest state as a force model for one device.
//!
//! The stiffness is clamped to what the device renders stably. The force is not: clamping it would hide from the client
//! how far its device is from the truth, and the device does it anyway.

use crate::{
    math::Mat3,
    protocol::{haptic::Device, pose::ForceModel},
    runner::Tick,
    session::LEASE,
    world::Outcome,
};
use nalgebra::SymmetricEigen;

/// Eigenvalues outside the allowed range by less than this part of the largest are rounding, not clamping.
const ROUNDING: f64 = 1e-9;

/// The model of a state for a device; `None` without a hand. Sequence number and change flags are left to the socket.
pub(super) fn model(tick: &Tick, device: &Device) -> Option<ForceModel> {
    let report = &tick.report;
    let hand = report.hand.as_ref()?;
    let (stiffness, clamped) = clamp(&hand.stiffness, device.max_stiffness_n_per_m);
    let flag = |on: bool, bit: u8| if on { bit } else { 0 };
    let (move_seq, move_us, past) = tick.newest_move.map_or((0, 0, 0.0), |m| (m.seq, m.t_us, m.past_s));
    Some(ForceModel {
        flags: flag(report.outcome == Outcome::Converged, ForceModel::CONVERGED)
            | flag(report.resting, ForceModel::RESTING)
            | flag(clamped, ForceModel::CLAMPED),
        seq: 0,
        server_us: tick.server_us,
        move_us,
        move_seq,
        lease_ms: LEASE.as_secs_f64() * 1e3,
        position: (hand.position - hand.velocity * past).into(),
        velocity: hand.velocity.into(),
        force: (hand.force - hand.rate * past).into(),
        rate: hand.rate.into(),
        stiffness: [
            stiffness[(0, 0)],
            stiffness[(0, 1)],
            stiffness[(0, 2)],
            stiffness[(1, 1)],
            stiffness[(1, 2)],
            stiffness[(2, 2)],
        ],
        radius: hand.radius,
        horizon_ms: (hand.horizon + past) * 1e3,
        force_error: hand.force_error,
        active: report.particles_active as u32,
        solve_ms: tick.solve_ms,
    })
}

/// Error of F0, in ranges of the device, beyond which a model is noise. Seen: about 3 while a coarse step falls behind a fast
/// hand, where the direction is still right; from 20 to 15,000 where a solve met a nearly singular Hessian.
const NOISE: f64 = 10.0;

/// Whether a model tells the hand anything: all of it is finite, and F0 is known within [`NOISE`].
pub(super) fn tells(model: &ForceModel, device: &Device) -> bool {
    let vectors = [model.position, model.velocity, model.force, model.rate];
    let finite = vectors.iter().flatten().chain(&model.stiffness).all(|x| x.is_finite());
    finite && model.force_error <= NOISE * device.max_force_n
}

/// The nearest symmetric matrix with eigenvalues within [0, most]; says whether anything but rounding changed.
fn clamp(stiffness: &Mat3, most: f64) -> (Mat3, bool) {
    let symmetric = (stiffness + stiffness.transpose()) * 0.5;
    let Some(mut eigen) = SymmetricEigen::try_new(symmetric, 1e-14, 100) else {
        return (Mat3::zeros(), true);
    };
    let slack = ROUNDING * eigen.eigenvalues.amax();
    let clamped = eigen.eigenvalues.iter().any(|&k| k < -slack || k > most + slack);
    if !clamped && eigen.eigenvalues.min() >= 0.0 {
        return (symmetric, false);
    }
    eigen.eigenvalues.apply(|k| *k = k.clamp(0.0, most));
    let limited = eigen.recompose();
    ((limited + limited.transpose()) * 0.5, clamped)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        hand::HandReport,
        math::Vec3,
        runner::{Made, Rung},
        scene::Scene,
        world::{Method, World},
    };

    #[test]
    fn a_model_begins_at_its_newest_move() {
        let scene = Scene { particles: [4, 4], ..Scene::default() };
        let world = World::new(scene.setup().unwrap()).unwrap();
        let rung = Rung { tick_hz: 100.0, method: Method::Fronts, least: 2, expense: 1.0 };
        let mut tick = Tick::first(&world, rung);
        let vector = Vec3::new(1.0, 2.0, 3.0);
        tick.report.hand = Some(HandReport {
            particle: [0, 0],
            held: true,
            position: vector,
            velocity: vector * 0.1,
            force: vector * 2.0,
            force_error: 0.0,
            rate: vector * 10.0,
            stiffness: Mat3::identity(),
            radius: 0.01,
            horizon: 0.01,
        });
        tick.newest_move = Some(Made { seq: 7, t_us: 5000, past_s: 0.002 });
        let model = model(&tick, &Device::default()).unwrap();
        assert_eq!((model.move_seq, model.move_us, model.horizon_ms), (7, 5000, 12.0));
        // Two milliseconds after the move the hand is where the state has it, and feels its force.
        let later = |a: [f64; 3], b: [f64; 3]| Vec3::from(a) + Vec3::from(b) * 0.002;
        assert!((later(model.position, model.velocity) - vector).norm() < 1e-12);
        assert!((later(model.force, model.rate) - vector * 2.0).norm() < 1e-12);
    }

    #[test]
    fn stiffness_is_symmetric_and_within_the_device() {
        let wild = Mat3::new(900.0, 20.0, 0.0, 40.0, -5.0, 3.0, 1.0, 2.0, 50.0);
        let (k, clamped) = clamp(&wild, 400.0);
        assert!(clamped);
        assert_eq!(k, k.transpose());
        let eigenvalues = k.symmetric_eigenvalues();
        assert!(eigenvalues.min() > -1e-9 && eigenvalues.max() < 400.0 + 1e-9, "{eigenvalues}");
    }

    #[test]
    fn a_model_that_knows_nothing_is_no_model() {
        let device = Device::default();
        let good = ForceModel { force: [0.0, 0.0, -1.0], force_error: 0.1, ..ForceModel::default() };
        assert!(tells(&good, &device));
        assert!(!tells(&ForceModel { force_error: 50_008.0, ..good }, &device));
        assert!(!tells(&ForceModel { force_error: f64::NAN, ..good }, &device));
        assert!(!tells(&ForceModel { rate: [f64::INFINITY, 0.0, 0.0], ..good }, &device));
    }

    #[test]
    fn stiffness_within_the_device_is_passed_on_to_the_bit() {
        let soft = Mat3::new(10.0, 1.0, 0.5, 1.0, 20.0, 0.25, 0.5, 0.25, 30.0);
        assert_eq!(clamp(&soft, 400.0), (soft, false));
    }
}
