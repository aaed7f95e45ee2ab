//! Obstacles that move: from pose to pose in a time, and how far a point can go among obstacles.

use super::Obstacle;
use crate::math::Vec3;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};

/// What rounding leaves of the squared length of a unit quaternion, less 1: of its four numbers, of their squares and of the sum.
const ROUNDING: f64 = 8.0 * f64::EPSILON;

/// A motion from one pose to another at constant speed and turn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Pose at its start.
    pub from: Isometry3<f64>,
    /// Pose at its end.
    pub to: Isometry3<f64>,
    /// How long it takes [s]; 0: as fast as the cloth allows.
    pub duration: f64,
    /// How much of it is done, from 0 to 1.
    pub done: f64,
}

impl Motion {
    /// The pose when `done` of it is done.
    pub fn pose(&self, done: f64) -> Isometry3<f64> {
        if done >= 1.0 {
            return self.to;
        }
        let [from, to] = [self.from.translation.vector, self.to.translation.vector];
        // Half a turn has no shortest way; any way will do.
        let rotation = self.from.rotation.try_slerp(&self.to.rotation, done, 1e-9).unwrap_or(if done < 0.5 {
            self.from.rotation
        } else {
            self.to.rotation
        });
        // 1 − cos², from which the interpolation takes its sine, cancels in small turns: of 1e-3 rad, the quaternion is off its length by 1e-9.
        with_unit_rotation(&Isometry3::from_parts(Translation3::from(from + (to - from) * done), rotation))
    }

    /// The part done after `time` more [s], no more than moves any point within `reach` of the origin by `travel` [m].
    pub fn after(&self, time: f64, reach: f64, travel: f64) -> f64 {
        let turn = self.from.rotation.angle_to(&self.to.rotation);
        let way = (self.to.translation.vector - self.from.translation.vector).norm() + turn * reach;
        let most = if way > travel { travel / way } else { 1.0 };
        let part = if self.duration > 0.0 { (time / self.duration).min(most) } else { most };
        (self.done + part).min(1.0)
    }
}

/// A pose with a quaternion of unit length; one that is off by rounding alone stays as it is.
///
/// A quaternion that is too long or short scales what it turns. Friction's anchors go into the obstacle's frame in every commit and back in the next
/// step: places that stand still would slip a little farther each time, and the cloth gain energy from nothing.
pub fn with_unit_rotation(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let off = (pose.rotation.coords.norm_squared() - 1.0).abs();
    if off <= ROUNDING {
        return *pose;
    }
    let rotation = UnitQuaternion::new_normalize(pose.rotation.into_inner());
    Isometry3::from_parts(pose.translation, rotation)
}

/// Where a point comes from `from` towards `to`, keeping `clearance` [m] from all obstacles: straight on while nothing is in the way,
/// then along the surface.
pub fn slide(obstacles: &[Obstacle], poses: &[Isometry3<f64>], from: Vec3, to: Vec3, clearance: f64) -> Vec3 {
    let touching = 0.01 * clearance;
    let mut at = from;
    for _ in 0..200 {
        let mut way = to - at;
        let mut room = f64::INFINITY;
        let mut walls = Vec::new();
        for (obstacle, pose) in obstacles.iter().zip(poses) {
            let gap = obstacle.gap_at(pose, at);
            let own = gap.value - clearance;
            if own <= touching {
                // Where it came too near, it first goes back.
                walls.push((gap.normal, own.min(0.0)));
            } else {
                room = room.min(own);
            }
        }
        for _ in 0..walls.len() {
            for (normal, below) in &walls {
                way -= normal * (normal.dot(&way) + below).min(0.0);
            }
        }
        // Curved walls bend away or come nearer: look again after a short way.
        let most = if walls.is_empty() { room } else { room.min(1e-3) };
        let length = way.norm();
        if length <= 1e-7 {
            if walls.is_empty() {
                at = to;
            }
            break;
        }
        at += way * (most / length).min(1.0);
        if length <= most && walls.is_empty() {
            break;
        }
    }
    let clear = obstacles.iter().zip(poses).all(|(o, pose)| o.distance_at(pose, at) >= 0.5 * clearance);
    if clear { at } else { from }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_on_the_way_has_a_rotation_of_unit_length_however_small_the_turn() {
        let from = UnitQuaternion::from_euler_angles(0.3, -1.1, 0.7);
        for turn in (0..80).map(|k| 0.8_f64.powi(k)) {
            let to = UnitQuaternion::from_scaled_axis(Vec3::new(0.6, 0.0, 0.8) * turn) * from;
            let [from, to] = [from, to].map(|r| Isometry3::from_parts(Translation3::identity(), r));
            let motion = Motion { from, to, duration: 1.0, done: 0.0 };
            for done in [0.1, 0.3, 0.5, 0.9] {
                let rotation = motion.pose(done).rotation;
                let off = rotation.coords.norm_squared() - 1.0;
                assert!(off.abs() <= ROUNDING, "{off:e} after {done} of {turn} rad");
                let gone = from.rotation.rotation_to(&rotation).scaled_axis().norm();
                assert!(
                    (gone - done * turn).abs() < 1e-7 * turn + 1e-15,
                    "{gone} rad after {done} of {turn}"
                );
            }
        }
    }

    #[test]
    fn a_rotation_that_is_made_one_is_left_alone_from_then_on() {
        for part in [1.0 - 1e-6, 1.0 - 1e-12, 1.0, 1.0 + 1e-9, 1.0 + 1e-6] {
            let long = UnitQuaternion::from_euler_angles(0.2, 0.3, 0.4).into_inner() * part;
            let pose = Isometry3::from_parts(Translation3::identity(), UnitQuaternion::new_unchecked(long));
            let once = with_unit_rotation(&pose);
            assert!((once.rotation.coords.norm_squared() - 1.0).abs() <= ROUNDING);
            assert_eq!(with_unit_rotation(&once), once);
        }
    }
}
