//! Requests of a tick as commands to the world: who holds the hand, and which poses are its path.

use super::{
    mailbox::{ClientId, Granted, Pose, Refusal, Request},
    path::Path,
};
use crate::{
    grid::Site,
    math::Vec3,
    protocol::haptic::{At, Denied},
    recording::Recorder,
    world::{Command, World},
};
use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Fewest poses that tell how often they come, and about how many it is averaged over.
const FEW: u32 = 20;
const MANY: u32 = 100;

/// The newest move of a hand that a state includes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Made {
    /// Its number.
    pub seq: u32,
    /// The client's time of it [µs].
    pub t_us: u64,
    /// How long before the state the hand was there, if it is on its way to the next [s].
    pub past_s: f64,
}

/// The hand of a session, as its thread sees it.
#[derive(Debug, Default)]
pub(super) struct Hand {
    holder: Option<ClientId>,
    path: Path,
    beat: Beat,
}

/// How often poses come.
#[derive(Debug, Default)]
struct Beat {
    poses: u32,
    /// Mean time between poses [s].
    interval: f64,
}

impl Beat {
    fn pose(&mut self, gap: Duration) {
        self.poses = (self.poses + 1).min(MANY);
        self.interval += (gap.as_secs_f64() - self.interval) / f64::from(self.poses);
    }
}

impl Hand {
    /// The client whose hand it is.
    pub(super) fn holder(&self) -> Option<ClientId> {
        self.holder
    }
    /// The newest of its moves that it has made.
    pub(super) fn newest_move(&self) -> Option<Made> {
        let past_s = self.path.past().as_secs_f64();
        self.path.newest().map(|pose| Made { seq: pose.seq, t_us: pose.t_us, past_s })
    }
    /// Whether it is on its way to where the newest pose leads it.
    pub(super) fn goes_on(&self) -> bool {
        self.path.goes_on()
    }
    /// Poses per second while it moves [Hz], once that is known.
    pub(super) fn poses_hz(&self) -> Option<f64> {
        (self.beat.poses >= FEW).then(|| 1.0 / self.beat.interval)
    }

    /// The commands of requests, in order; poses become part of the path.
    pub(super) fn commands(
        &mut self,
        world: &World,
        requests: VecDeque<Request>,
        mut recorder: Option<&mut Recorder>,
    ) -> Vec<Command> {
        let mut commands = Vec::new();
        for request in requests {
            let event = match request {
                Request::Move(pose) => {
                    if self.holder == Some(pose.client) {
                        self.take(pose, &mut commands);
                    }
                    None
                }
                Request::Grab { client, at, reply } => {
                    let answer = self.grab(world, client, at, &mut commands);
                    let event = match &answer {
                        Ok(g) => format!("grab of particle ({}, {})", g.particle[0], g.particle[1]),
                        Err(refusal) => format!("grab refused: {}", refusal.message),
                    };
                    let _ = reply.send(answer);
                    Some(event)
                }
                Request::Push { obstacle, pose, duration, reply } => {
                    let command = Command::Push { obstacle, pose, duration };
                    let answer = world.check(&command).map_err(|e| e.to_string());
                    let event = answer.as_ref().ok().map(|()| {
                        commands.push(command);
                        format!("obstacle {:?} sent off", world.setup().obstacles[obstacle].name)
                    });
                    let _ = reply.send(answer);
                    event
                }
                Request::Release { client, let_go, why } => self.release(client, let_go, why, &mut commands),
            };
            if let (Some(text), Some(recorder)) = (event, recorder.as_deref_mut()) {
                recorder.event(&text);
            }
        }
        commands
    }

    fn take(&mut self, pose: Pose, commands: &mut Vec<Command>) {
        if let Some(gap) = self.path.take(pose, go(commands)) {
            self.beat.pose(gap);
        }
    }

    /// Adds the commands that take it along its path to where it is at `now`, in a step of `dt` [s].
    pub(super) fn follow(&mut self, now: Instant, dt: f64, commands: &mut Vec<Command>) {
        self.path.follow(now, dt, go(commands));
    }

    fn grab(
        &mut self,
        world: &World,
        client: ClientId,
        at: At,
        commands: &mut Vec<Command>,
    ) -> Result<Granted, Refusal> {
        let particle =
            resolve(world, at).map_err(|message| Refusal { code: Denied::NoSuchParticle, message })?;
        let command = Command::Grab { particle };
        world.check(&command).map_err(|e| Refusal { code: Denied::Refused, message: e.to_string() })?;
        self.path.restart(go(commands));
        commands.push(command);
        if self.holder != Some(client) {
            (self.path, self.beat) = (Path::default(), Beat::default());
        }
        self.holder = Some(client);
        Ok(Granted { particle, position: world.positions()[world.grid().index(particle)].into() })
    }

    fn release(
        &mut self,
        client: ClientId,
        let_go: bool,
        why: &str,
        commands: &mut Vec<Command>,
    ) -> Option<String> {
        if self.holder != Some(client) {
            return None;
        }
        self.path.finish(go(commands));
        commands.push(Command::Release { let_go });
        (self.holder, self.path, self.beat) = (None, Path::default(), Beat::default());
        Some(format!("release ({why}): the particle {}", if let_go { "is free" } else { "stays pinned" }))
    }
}

/// Turns positions on the hand's path into commands.
fn go(commands: &mut Vec<Command>) -> impl FnMut([f64; 3]) {
    |position| commands.push(Command::Move { position: Vec3::from(position) })
}

/// The particle that a grab means.
fn resolve(world: &World, at: At) -> Result<Site, String> {
    let counts = world.grid().counts;
    match at {
        At::Corner(corner) => Ok(corner.site(counts)),
        At::Particle(site) => {
            let site = site.map(|k| k as usize);
            if site[0] < counts[0] && site[1] < counts[1] {
                return Ok(site);
            }
            let [i, j] = site;
            Err(format!("at.particle is [{i}, {j}], allowed: below [{}, {}]", counts[0], counts[1]))
        }
        At::NearestM(point) => {
            let point = Vec3::from(point);
            let distance = |p: &Vec3| (p - point).norm_squared();
            let nearest = world
                .positions()
                .iter()
                .map(distance)
                .enumerate()
                .filter(|(_, d)| d.is_finite())
                .min_by(|a, b| a.1.total_cmp(&b.1));
            let (k, _) =
                nearest.ok_or_else(|| format!("at.nearest_m is {:?}, allowed: finite", point.as_slice()))?;
            Ok(world.grid().site(k))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_that_pauses_beats_as_it_did() {
        let mut hand = Hand::default();
        let (mut now, ms) = (Instant::now(), Duration::from_millis(1));
        for k in 0..100 {
            assert_eq!(hand.poses_hz().is_some(), k > 20, "{k} poses");
            now += if k == 50 { 3000 * ms } else { ms * (1 + k % 2) };
            let (client, position, interval) = (ClientId(1), [0.0; 3], ms);
            let pose = Pose { client, seq: k, t_us: 0, position, received: now, interval };
            hand.take(pose, &mut Vec::new());
        }
        let rate = hand.poses_hz().unwrap();
        assert!((rate - 1000.0 / 1.5).abs() < 10.0, "{rate} Hz");
    }
}
