//! Obstacles that move: from pose to pose in a time, and how far a point can go among obstacles.

use super::Obstacle;
use crate::math::Vec3;
use nalgebra::{Isometry3, Translation3};

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
        Isometry3::from_parts(Translation3::from(from + (to - from) * done), rotation)
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
