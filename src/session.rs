//! Sessions: live cloths with an id, and whose hand is on each. Knows nothing of sockets.

use crate::{
    config::{Pace, Settings, Solver},
    fabric::{Library, document::Faults},
    metrics::Metrics,
    model::{self, Model, Refused, Setup},
    protocol::{self, haptic, http, view},
    recording::{Recordings, Status as RecordingStatus},
    runner::{self, ClientId, End, Ladder, Refusal, Request, Rung, Shared, Tick},
    scene::Scene,
    world::{Budget, Method, World},
};
use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

/// Silence after which a grab is lost.
pub const LEASE: Duration = Duration::from_millis(125);
/// Id of the session that exists from the start.
pub const DEFAULT: &str = "default";

/// A scene made ready: what a session is built from and how it is called.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Name of the scene.
    pub scene: String,
    /// How the fabric's curves are known.
    pub fabric_kind: String,
    /// Ticks per second [Hz]; none: as many as can be kept.
    pub tick_hz: Option<f64>,
    /// What the world is made from.
    pub setup: Setup,
}

impl Plan {
    /// The plan of a scene, or the sentences that say what is wrong with it.
    pub fn of(scene: &Scene) -> Result<Plan, String> {
        let setup = scene.setup().map_err(|faults| Faults(faults).to_string())?;
        let fabric_kind = Library::default().read(&scene.fabric).map_err(|e| e.to_string())?.kind;
        Ok(Plan { scene: scene.name.clone(), fabric_kind, tick_hz: scene.tick_hz, setup })
    }
}

/// Why no session was made.
#[derive(Debug, thiserror::Error)]
pub enum CreateError {
    /// As many as the server takes.
    #[error("{0} sessions are live, allowed: {0}; end one first")]
    TooMany(usize),
    /// The world refused the scene.
    #[error("scene {scene}: {why}")]
    Refused {
        /// Its name.
        scene: String,
        /// What the world said.
        why: String,
    },
    /// The system gave no thread.
    #[error("no thread for the session: {0}")]
    Thread(std::io::Error),
}

/// A live cloth with an id.
#[derive(Debug)]
pub struct Session {
    /// Id, as in the paths.
    pub id: String,
    /// What its thread shares.
    pub shared: Arc<Shared>,
    /// The recording's progress, where there is one.
    pub recording: Option<RecordingStatus>,
    /// What viewers are told first, but for the present rate.
    pub hello: view::Hello,
    /// When it was made.
    pub opened: Instant,
    /// What is doubtful about its scene.
    pub warnings: Vec<String>,
    particles: usize,
    hand: Mutex<Option<ClientId>>,
    next_client: AtomicU64,
    sockets: AtomicUsize,
}

/// Which kind of socket a seat is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A hand.
    Haptic,
    /// An eye.
    View,
}

/// A client's place in a session; counted until dropped.
#[derive(Debug)]
pub struct Seat {
    /// The session.
    pub session: Arc<Session>,
    /// The client's number in it.
    pub client: ClientId,
    kind: Kind,
}

impl Seat {
    /// Takes a place, if fewer than `most` are taken.
    pub fn take(session: &Arc<Session>, kind: Kind, most: usize) -> Option<Seat> {
        if session.sockets.fetch_add(1, Ordering::Relaxed) >= most {
            session.sockets.fetch_sub(1, Ordering::Relaxed);
            return None;
        }
        let client = ClientId(session.next_client.fetch_add(1, Ordering::Relaxed));
        let seat = Seat { session: Arc::clone(session), client, kind };
        seat.gauge().inc();
        Some(seat)
    }

    fn gauge(&self) -> &prometheus_client::metrics::gauge::Gauge {
        let metrics = &self.session.shared.metrics;
        match self.kind {
            Kind::Haptic => &metrics.haptic_clients,
            Kind::View => &metrics.viewers,
        }
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.gauge().dec();
        self.session.sockets.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Session {
    fn hand(&self) -> MutexGuard<'_, Option<ClientId>> {
        self.hand.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reserves the hand for a client; refuses while another has it.
    pub fn reserve_hand(&self, client: ClientId) -> Result<(), Refusal> {
        let mut hand = self.hand();
        if hand.is_some_and(|holder| holder != client) {
            let message = "another client holds a particle of this session; wait until it lets go".into();
            return Err(Refusal { code: haptic::Denied::HeldByAnother, message });
        }
        *hand = Some(client);
        Ok(())
    }

    /// Gives the reservation back without a word to the cloth.
    pub fn cancel_hand(&self, client: ClientId) {
        self.hand().take_if(|holder| *holder == client);
    }

    /// Opens a client's hand. The lock is held while the request is left, so that the next grab comes after it.
    pub fn release_hand(&self, client: ClientId, let_go: bool, why: &'static str) {
        let mut hand = self.hand();
        if hand.take_if(|holder| *holder == client).is_some() {
            let _ = self.shared.mailbox.post(Request::Release { client, let_go, why });
        }
    }

    /// The newest state.
    pub fn tick(&self) -> Arc<Tick> {
        Arc::clone(&self.shared.ticks.borrow())
    }

    /// What viewers are told first.
    pub fn view_hello(&self) -> view::Hello {
        view::Hello { tick_hz: self.tick().rung.tick_hz, ..self.hello.clone() }
    }

    /// Why it ended, if it did.
    pub fn ended(&self) -> Option<End> {
        self.shared.end.borrow().clone()
    }

    /// One line of the list of sessions.
    pub fn summary(&self) -> http::SessionSummary {
        let (tick, hello) = (self.tick(), &self.hello);
        http::SessionSummary {
            id: self.id.clone(),
            scene: hello.scene.name.clone(),
            fabric: hello.fabric.name.clone(),
            particles: hello.scene.particles,
            tick_hz: tick.rung.tick_hz,
            time_s: tick.report.time,
            resting: tick.report.resting,
            held: tick.holder.is_some(),
            haptic_clients: self.shared.metrics.haptic_clients.get().max(0) as usize,
            viewers: self.shared.metrics.viewers.get().max(0) as usize,
            warnings: self.warnings.clone(),
        }
    }

    /// The newest state as one JSON snapshot.
    pub fn state(&self) -> http::State {
        let tick = self.tick();
        let report = &tick.report;
        let cost = report.cost;
        http::State {
            time_s: report.time,
            step: report.step,
            resting: report.resting,
            particles_total: self.particles,
            particles_active: report.particles_active,
            particles_ghost: report.particles_ghost,
            particles_by_level: report.remeshing.by_level.to_vec(),
            mesh_changes: report.remeshing.changes,
            cost: http::Cost {
                total: cost.total(),
                newton: cost.newton,
                stretch: cost.stretch,
                bend: cost.bend,
                shear: cost.shear,
            },
            residual_n: report.residual,
            energy_j: report.energy,
            hand: report.hand.as_ref().map(|h| http::Hand {
                particle: h.particle,
                held: tick.holder.is_some(),
                position_m: h.position.into(),
                force_n: h.force.into(),
                force_error_n: h.force_error,
                stiffness_n_per_m: std::array::from_fn(|r| std::array::from_fn(|c| h.stiffness[(r, c)])),
            }),
            max_penetration_m: report.max_penetration,
            solve_ms: tick.solve_ms,
            tick_hz: tick.rung.tick_hz,
            solver: format!("{:?}", tick.rung.method).to_lowercase(),
            warnings: self.warnings.clone(),
        }
    }
}

/// Says that a scene's mesh is too coarse for its fabric, by how much, and which one would do.
fn too_coarse(scene: &str, model: &Model) -> Option<String> {
    let coarseness = model.coarseness();
    if coarseness <= model::TOO_COARSE {
        return None;
    }
    let direction = usize::from(model.grid.spacing(1) / model.bending_length(1) == coarseness);
    let [spacing, length] = [model.grid.spacing(direction), model.bending_length(direction)].map(|l| l * 1e3);
    Some(format!(
        "scene {scene}: particles {:?} lie {spacing:.1} mm apart, {coarseness:.2} of the bending length {length:.1} mm of {}; forces may \
         be off by {:.0} % and folds go astray; {:?} would keep forces within 1 %",
        model.grid.counts,
        model.fabric.name,
        100.0 * model::force_error(coarseness),
        model.particles_for(model::FINE),
    ))
}

/// Ticks per second among which a session chooses [Hz], the slowest first.
const RATES: [f64; 5] = [50.0, 100.0, 250.0, 500.0, 1000.0];
/// Steps that a solver is tried for; the quickest counts.
const TRIAL: usize = 3;
/// Longest tick that does with half as many solves [s].
const SHORT_TICK: f64 = 0.005;
/// Steps of short and of long ticks at a trial [s]: conjugate gradients need more iterations in longer ones.
const TRIAL_STEPS: [f64; 2] = [1e-3, 2e-2];
/// Share of the factor's time that makes conjugate gradients worth their tolerance.
const WORTH: f64 = 0.8;

/// A world with its ladder of rates: those that the plan and the longest step allow, each with the solver that is asked for, or with the
/// one that was measured to be faster.
fn world_of(setup: Setup, pace: &Pace, tick_hz: Option<f64>) -> Result<(World, Ladder), Refused> {
    let rates = tick_hz.map_or(RATES.to_vec(), |hz| vec![hz]);
    // Times of a step per solve, short and long [s]: a long one that meets an obstacle may need more than it is given.
    let times = |method| -> Result<[f64; 2], Refused> {
        let mut trial = World::with_method(setup.clone(), method)?;
        let mut time = |dt| {
            let times = (0..TRIAL).map(|_| {
                let start = Instant::now();
                let solves = trial.step(&[], dt, Budget::solves(1)).solves;
                start.elapsed().as_secs_f64() / f64::from(solves.max(1))
            });
            times.fold(f64::INFINITY, f64::min)
        };
        let short = time(TRIAL_STEPS[0]);
        // A factor takes as long whatever the step.
        Ok([short, if method == Method::Multigrid { time(TRIAL_STEPS[1]) } else { short }])
    };
    let asked = match pace.solver {
        Solver::Fronts | Solver::Auto => Method::Fronts,
        Solver::Faer => Method::Faer,
        Solver::Multigrid => Method::Multigrid,
    };
    let mut quickest = times(asked)?.map(|time| (asked, time));
    if pace.solver == Solver::Auto {
        let iterated = times(Method::Multigrid)?;
        tracing::info!(
            "a solve takes {:.2} ms by fronts, {:.2?} ms by multigrid in steps of {:?} ms",
            quickest[0].1 * 1e3,
            iterated.map(|time| time * 1e3),
            TRIAL_STEPS.map(|dt| dt * 1e3)
        );
        for (quickest, iterated) in quickest.iter_mut().zip(iterated) {
            if iterated < WORTH * quickest.1 {
                *quickest = (Method::Multigrid, iterated);
            }
        }
    }
    let rung = |tick_hz: f64| {
        let is_short = tick_hz * SHORT_TICK >= 1.0;
        let (method, time) = quickest[usize::from(!is_short)];
        let least = if is_short { pace.least_solves.div_ceil(2) } else { pace.least_solves };
        Rung { tick_hz, method, least, expense: f64::from(least) * time }
    };
    let allowed = |hz: &f64| tick_hz.is_some() || hz * pace.longest_step_s >= 1.0 - 1e-9;
    let ladder = Ladder::new(rates.into_iter().filter(allowed).map(rung).collect());
    Ok((World::with_method(setup, ladder.rung().method)?, ladder))
}

/// Every session of a server.
#[derive(Debug)]
pub struct Sessions {
    settings: Settings,
    metrics: Arc<Metrics>,
    recordings: Option<Recordings>,
    live: Mutex<BTreeMap<String, Arc<Session>>>,
    next: AtomicU64,
}

impl Sessions {
    /// No session yet.
    pub fn new(settings: Settings, metrics: Arc<Metrics>, recordings: Option<Recordings>) -> Sessions {
        Sessions { settings, metrics, recordings, live: Mutex::default(), next: AtomicU64::new(1) }
    }

    fn live(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Session>>> {
        self.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes a session with the next free id. Builds the world: may take a while, so not for an async task.
    pub fn create(&self, plan: Plan) -> Result<Arc<Session>, CreateError> {
        let id = format!("s{}", self.next.fetch_add(1, Ordering::Relaxed));
        self.create_as(&id, plan)
    }

    /// Makes a session with this id, as [`Sessions::create`].
    pub fn create_as(&self, id: &str, plan: Plan) -> Result<Arc<Session>, CreateError> {
        let most = self.settings.config.limits.sessions;
        if self.live().len() >= most {
            return Err(CreateError::TooMany(most));
        }
        let hello = self.hello(id, &plan);
        let pace = self.settings.config.session.clone();
        let (world, ladder) = world_of(plan.setup, &pace, plan.tick_hz)
            .map_err(|why| CreateError::Refused { scene: plan.scene, why: why.to_string() })?;
        let mut live = self.live();
        if live.len() >= most {
            return Err(CreateError::TooMany(most));
        }
        let recorder = self.recordings.as_ref().and_then(|r| {
            r.start(id, &world).inspect_err(|e| tracing::error!("session {id} is not recorded: {e}")).ok()
        });
        let shared = Arc::new(Shared::new(&world, ladder.rung(), self.metrics.session(id)));
        let session = Arc::new(Session {
            id: id.into(),
            shared: Arc::clone(&shared),
            recording: recorder.as_ref().map(|r| r.status()),
            warnings: too_coarse(&hello.scene.name, world.model()).into_iter().collect(),
            hello,
            opened: Instant::now(),
            particles: world.grid().particles(),
            hand: Mutex::new(None),
            next_client: AtomicU64::new(1),
            sockets: AtomicUsize::new(0),
        });
        let rung = ladder.rung();
        runner::spawn(id, world, recorder, pace, ladder, shared).map_err(CreateError::Thread)?;
        live.insert(id.into(), Arc::clone(&session));
        let scene = &session.hello.scene.name;
        tracing::info!("session {id}: scene {scene}, {} ticks per second by {:?}", rung.tick_hz, rung.method);
        session.warnings.iter().for_each(|warning| tracing::warn!("session {id}: {warning}"));
        Ok(session)
    }

    fn hello(&self, id: &str, plan: &Plan) -> view::Hello {
        let setup = &plan.setup;
        view::Hello {
            protocol: protocol::VIEW.into(),
            server: protocol::SERVER.into(),
            session: id.into(),
            scene: view::SceneBrief {
                name: plan.scene.clone(),
                particles: setup.particles,
                size_m: setup.size,
            },
            fabric: view::FabricBrief { name: setup.fabric.name.clone(), kind: plan.fabric_kind.clone() },
            obstacles: setup.obstacles.iter().map(obstacle).collect(),
            tick_hz: plan.tick_hz.unwrap_or_default(),
            view_hz_max: self.settings.config.limits.view_hz,
        }
    }

    /// The session with this id.
    pub fn get(&self, id: &str) -> Option<Arc<Session>> {
        self.live().get(id).cloned()
    }

    /// All sessions, by id.
    pub fn all(&self) -> Vec<Arc<Session>> {
        self.live().values().cloned().collect()
    }

    /// Ends a session and forgets it; `None` when there is none.
    pub fn delete(&self, id: &str) -> Option<Arc<Session>> {
        let session = self.live().remove(id)?;
        session.shared.finish(End::Deleted);
        self.metrics.forget(id);
        tracing::info!("session {id}: deleted");
        Some(session)
    }
}

fn obstacle(o: &crate::obstacle::Obstacle) -> view::ObstacleBrief {
    use crate::obstacle::Shape;
    let mut brief = view::ObstacleBrief {
        name: o.name.clone(),
        shape: view::ShapeKind::Plane,
        half_m: None,
        radius_m: None,
        half_length_m: None,
        points_m: Vec::new(),
        triangles: Vec::new(),
        position_m: o.pose.translation.vector.into(),
        rotation_xyzw: o.pose.rotation.coords.into(),
    };
    match &o.shape {
        Shape::Cuboid { half } => (brief.shape, brief.half_m) = (view::ShapeKind::Box, Some(*half)),
        Shape::Sphere { radius } => {
            (brief.shape, brief.radius_m) = (view::ShapeKind::Sphere, Some(*radius));
        }
        Shape::Capsule { half, radius } => {
            brief.shape = view::ShapeKind::Capsule;
            (brief.half_length_m, brief.radius_m) = (Some(*half), Some(*radius));
        }
        Shape::Plane => {}
        Shape::Polyhedron(solid) => {
            brief.shape = view::ShapeKind::Mesh;
            brief.points_m = solid.points().iter().map(|p| (*p).into()).collect();
            brief.triangles = solid.faces().to_vec();
        }
    }
    brief
}
