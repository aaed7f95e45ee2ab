//! Recordings, read back as the viewer would read them: what is in them, what a kill leaves, what a stalled or full disk costs.

use kesi::{
    adapt::Settings,
    fabric::{Fabric, law::Law},
    math::Vec3,
    model::Setup,
    obstacle::{Obstacle, Shape},
    recording::{Options, RecordingError, Recordings},
    world::{Budget, Command, World},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rerun::{
    ChunkStore, ChunkStoreConfig, Mesh3D, Scalars, StoreKind, TextLog, Transform3D,
    external::re_log_encoding::Decoder,
    log::{Chunk, LogMsg},
};
use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, BufRead, BufReader, Write},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{self, Stdio},
    sync::{Arc, Condvar, Mutex, mpsc},
    thread,
    time::{Duration, Instant, SystemTime},
};

/// Step of these tests [s]; at 1000 mesh frames per second every step gives one.
const DT: f64 = 0.004;

fn every_step(dir: &Path) -> Options {
    Options {
        dir: dir.to_owned(),
        mesh_hz: 1000.0,
        finish_within: Duration::from_secs(60),
        ..Options::default()
    }
}

/// A sheet with a hand and one obstacle of each shape.
fn small_world(particles: [usize; 2]) -> World {
    let size = [0.1, 0.08];
    let law = || Law::linear(1.0);
    let fabric = Fabric {
        name: "test cloth".into(),
        areal_density: 0.4,
        thickness: 0.001,
        tensile: [law(), law()],
        bending: [law(), law()],
        shear: law(),
        twist: 2.0,
        friction: 0.3,
    };
    let at = |k: usize, n: usize, length: f64| length * k as f64 / (n - 1) as f64;
    let [warps, wefts] = particles;
    let positions = (0..warps * wefts)
        .map(|k| Vec3::new(at(k / wefts, warps, size[0]), at(k % wefts, wefts, size[1]), 0.3))
        .collect();
    let obstacle = |name: &str, shape, z| Obstacle {
        name: name.into(),
        shape,
        pose: Isometry3::translation(0.05, 0.04, z),
        friction: None,
    };
    World::new(Setup {
        fabric: Arc::new(fabric),
        particles,
        size,
        positions,
        pins: vec![],
        hand: Some([0, 0]),
        obstacles: vec![
            obstacle("box", Shape::Cuboid { half: [0.02, 0.02, 0.02] }, 0.1),
            obstacle("ball", Shape::Sphere { radius: 0.02 }, 0.2),
            obstacle("floor", Shape::Plane, 0.0),
        ],
        gravity: 9.81,
        drag: 0.1,
        cut: None,
        particles_only: false,
    })
    .unwrap()
}

fn step(world: &mut World, commands: &[Command]) {
    world.step(commands, DT, Budget::solves(1));
}

/// What one entity says in a store, over all chunks.
fn chunks<'a>(store: &'a ChunkStore, entity: &str) -> Vec<&'a Chunk> {
    let entity = rerun::EntityPath::from(entity);
    store.iter_physical_chunks().filter(|c| *c.entity_path() == entity).map(|c| &**c).collect()
}

/// Values on a timeline of an entity's rows, in order.
fn times(store: &ChunkStore, entity: &str, timeline: &'static str) -> Vec<i64> {
    let timeline = rerun::TimelineName::from(timeline);
    let mut times: Vec<i64> = chunks(store, entity)
        .iter()
        .flat_map(|c| c.timelines().get(&timeline).map_or(Vec::new(), |t| t.times_raw().to_vec()))
        .collect();
    times.sort_unstable();
    times
}

/// The newest mesh positions.
fn last_positions(store: &ChunkStore) -> Vec<[f32; 3]> {
    let component = Mesh3D::descriptor_vertex_positions().component;
    let step = rerun::TimelineName::from("step");
    chunks(store, "cloth")
        .iter()
        .filter(|c| c.components().get_array(component).is_some())
        .flat_map(|c| {
            let steps = c.timelines()[&step].times_raw().to_vec();
            steps.into_iter().zip(c.iter_slices::<[f32; 3]>(component).map(<[_]>::to_vec).collect::<Vec<_>>())
        })
        .max_by_key(|(step, _)| *step)
        .expect("a mesh frame")
        .1
}

/// Every message up to where the file ends or is cut off, by store.
fn stores(path: &Path) -> BTreeMap<rerun::StoreId, ChunkStore> {
    let messages = Decoder::decode_eager(BufReader::new(File::open(path).unwrap()))
        .unwrap()
        .map_while(Result::ok)
        .collect::<Vec<LogMsg>>();
    ChunkStore::from_log_msgs(&ChunkStoreConfig::ALL_DISABLED, messages).unwrap()
}

fn of_kind(stores: BTreeMap<rerun::StoreId, ChunkStore>, kind: StoreKind) -> ChunkStore {
    stores.into_iter().find(|(id, _)| id.kind() == kind).expect("a store of this kind").1
}

fn recordings_in(dir: &Path) -> Vec<PathBuf> {
    let files = fs::read_dir(dir).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<_> = files.filter(|p| p.extension().is_some_and(|e| e == "rrd")).collect();
    files.sort();
    files
}

#[test]
fn a_recording_reads_back_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let mut world = small_world([9, 7]);
    let mut recorder = Recordings::open(every_step(dir.path())).unwrap().start("default", &world).unwrap();
    let status = recorder.status();
    for k in 0..20 {
        let position = world.positions()[0] + Vec3::new(0.0, 0.0, 1e-4 * f64::from(k));
        step(&mut world, &[Command::Move { position }]);
        recorder.record(&world, 1.5);
    }
    recorder.event("granted: corner 00");
    recorder.finish();
    assert_eq!((status.error(), status.dropped()), (None, 0));

    let path = status.path().unwrap();
    assert!(path.file_name().unwrap().to_str().unwrap().starts_with("default-20"));
    // The viewer's own way in, which refuses a file that is cut off.
    let stores =
        ChunkStore::from_rrd_reader(&ChunkStoreConfig::ALL_DISABLED, &mut File::open(path).unwrap()).unwrap();
    let blueprint = stores.iter().find(|(id, _)| id.kind() == StoreKind::Blueprint);
    assert!(blueprint.expect("a blueprint").1.num_physical_chunks() > 5);
    let store = of_kind(stores, StoreKind::Recording);

    let exact: Vec<[f32; 3]> = world.positions().iter().map(|p| p.cast::<f32>().into()).collect();
    assert_eq!(last_positions(&store), exact);
    assert_eq!(times(&store, "cloth", "step"), (0..=20).collect::<Vec<_>>(), "the start and every step");

    let indices = Mesh3D::descriptor_triangle_indices().component;
    let triangles: Vec<[u32; 3]> = chunks(&store, "cloth")
        .iter()
        .filter(|c| c.is_static())
        .flat_map(|c| c.iter_slices::<[u32; 3]>(indices).flatten().copied().collect::<Vec<_>>())
        .collect();
    assert_eq!(triangles, world.grid().triangles());

    for entity in ["force/x", "force/magnitude", "cost/total", "residual", "particles_active", "tick_ms"] {
        assert_eq!(times(&store, entity, "step"), (1..=20).collect::<Vec<_>>(), "{entity}");
    }
    let nanoseconds: Vec<i64> = (1..=20).map(|k| k * 4_000_000).collect();
    assert_eq!(times(&store, "tick_ms", "time"), nanoseconds);
    let scalars = Scalars::descriptor_scalars().component;
    let ticks: Vec<f64> = chunks(&store, "tick_ms")
        .iter()
        .flat_map(|c| c.iter_slices::<f64>(scalars).flatten().copied().collect::<Vec<_>>())
        .collect();
    assert_eq!(ticks, vec![1.5; 20]);

    let text = TextLog::descriptor_text().component;
    let events: Vec<String> = chunks(&store, "events")
        .iter()
        .flat_map(|c| c.iter_slices::<String>(text).flatten().map(|s| s.to_string()).collect::<Vec<_>>())
        .collect();
    assert_eq!(events, ["granted: corner 00"]);
    assert_eq!(chunks(&store, "obstacles/box").iter().filter(|c| c.is_static()).count(), 1);
}

#[test]
fn a_mesh_that_adapts_is_recorded_with_its_triangles_and_coloured_by_level() {
    let dir = tempfile::tempdir().unwrap();
    let mut world = small_world([17, 17]);
    world.set_adaptive(Some(Settings { rings: 1, ..Settings::default() }));
    let mut recorder = Recordings::open(every_step(dir.path())).unwrap().start("adapts", &world).unwrap();
    let status = recorder.status();
    step(&mut world, &[]);
    recorder.record(&world, 1.0);
    assert!(world.adapt(), "a flat sheet merges cells");
    step(&mut world, &[]);
    recorder.record(&world, 1.0);
    recorder.finish();
    assert_eq!((status.error(), status.dropped()), (None, 0));

    let store = of_kind(stores(&status.path().unwrap()), StoreKind::Recording);
    assert_eq!(times(&store, "cloth/remeshed", "step"), [2]);
    let remeshed = chunks(&store, "cloth/remeshed");
    let indices = Mesh3D::descriptor_triangle_indices().component;
    let triangles: Vec<[u32; 3]> = remeshed
        .iter()
        .flat_map(|c| c.iter_slices::<[u32; 3]>(indices).flatten().copied().collect::<Vec<_>>())
        .collect();
    assert_eq!(triangles, world.grid().triangles());
    let component = Mesh3D::descriptor_vertex_colors().component;
    let colors: Vec<u32> = remeshed
        .iter()
        .flat_map(|c| c.iter_slices::<u32>(component).flatten().copied().collect::<Vec<_>>())
        .collect();
    let levels: Vec<u8> = (0..world.grid().particles()).map(|n| world.grid().level(n)).collect();
    assert_eq!(colors.len(), levels.len(), "one per particle");
    assert!(levels.contains(&0) && levels.contains(&1), "{levels:?}");
    let by_level: BTreeMap<u8, u32> = levels.iter().copied().zip(colors.iter().copied()).collect();
    assert!(levels.iter().zip(&colors).all(|(level, color)| by_level[level] == *color));
    assert_ne!(by_level[&0], by_level[&1]);
}

#[test]
fn obstacles_that_move_are_where_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let mut world = small_world([5, 5]);
    let mut recorder = Recordings::open(every_step(dir.path())).unwrap().start("pushed", &world).unwrap();
    let status = recorder.status();
    let turn = UnitQuaternion::from_euler_angles(0.3, 0.0, 0.7);
    let pose = Isometry3::from_parts(Translation3::new(0.3, 0.04, 0.2), turn);
    let single = |pose: &Isometry3<f64>| {
        let position: [f32; 3] = pose.translation.vector.cast::<f32>().into();
        (position, <[f32; 4]>::from(pose.rotation.coords.cast::<f32>()))
    };
    let mut ball = vec![single(&world.state().poses[1])];
    let mut commands = vec![Command::Push { obstacle: 1, pose, duration: 0.1 }];
    for _ in 0..80 {
        step(&mut world, &commands);
        commands.clear();
        recorder.record(&world, 0.1);
        ball.push(single(&world.state().poses[1]));
    }
    assert_eq!(world.state().poses[1], pose, "it arrived");
    recorder.finish();
    let store = of_kind(stores(&status.path().unwrap()), StoreKind::Recording);
    let [position, rotation] =
        [Transform3D::descriptor_translation(), Transform3D::descriptor_quaternion()].map(|d| d.component);
    let mut recorded = BTreeMap::new();
    for chunk in chunks(&store, "obstacles/ball").iter().filter(|c| !c.is_static()) {
        let steps = chunk.timelines()[&rerun::TimelineName::from("step")].times_raw().to_vec();
        let positions = chunk.iter_slices::<[f32; 3]>(position).map(|p| p[0]);
        let rotations = chunk.iter_slices::<[f32; 4]>(rotation).map(|r| r[0]);
        recorded.extend(steps.into_iter().zip(positions.zip(rotations)));
    }
    assert_eq!(recorded.into_values().collect::<Vec<_>>(), ball, "at the start and after every step");
}

/// Not a test of its own: the process that `a_killed_process_leaves_a_recording_that_opens` kills.
#[test]
#[ignore = "run by another test, in a process of its own"]
fn child_that_records_until_killed() {
    let Some(dir) = std::env::var_os("KESI_TEST_RECORDINGS") else { return };
    let mut world = small_world([20, 20]);
    let options = Options { dir: dir.into(), ..Options::default() };
    let mut recorder = Recordings::open(options).unwrap().start("killed", &world).unwrap();
    let begin = Instant::now();
    for k in 1..60_000 {
        step(&mut world, &[]);
        recorder.record(&world, 0.1);
        println!("step {} {}", world.report().step, begin.elapsed().as_millis());
        // The tick clock of this process, not a wait for something to happen.
        thread::sleep(
            (begin + Duration::from_secs_f64(DT * f64::from(k))).saturating_duration_since(Instant::now()),
        );
    }
}

#[test]
fn a_killed_process_leaves_a_recording_that_opens() {
    let dir = tempfile::tempdir().unwrap();
    let mut child = process::Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "recording::child_that_records_until_killed", "--ignored", "--nocapture"])
        .env("KESI_TEST_RECORDINGS", dir.path())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // When each step was recorded, on the child's clock [ms].
    let mut recorded_at = BTreeMap::new();
    for line in BufReader::new(child.stdout.take().unwrap()).lines() {
        let line = line.unwrap();
        let mut words = line.split_whitespace().skip_while(|w| *w != "step").skip(1);
        let Some((step, ms)) = words.next().zip(words.next()) else { continue };
        let ms: i64 = ms.parse().unwrap();
        recorded_at.insert(step.parse::<i64>().unwrap(), ms);
        if ms > 2500 {
            break;
        }
    }
    child.kill().unwrap();
    child.wait().unwrap();

    let store = of_kind(stores(&recordings_in(dir.path())[0]), StoreKind::Recording);
    let killed_at = *recorded_at.values().last().expect("the child recorded");
    let newest = *times(&store, "tick_ms", "step").last().unwrap();
    assert!(killed_at - recorded_at[&newest] < 1000, "step {newest} of {:?}", recorded_at.last_key_value());
    let frame = *times(&store, "cloth", "step").last().unwrap();
    assert!(killed_at - recorded_at[&frame] < 1000, "mesh frame {frame}");
    assert_eq!(last_positions(&store).len(), 400);
}

/// A disk that stands still until the gate opens.
#[derive(Clone, Default)]
struct Stalled(Arc<(Mutex<bool>, Condvar)>);

impl Stalled {
    fn open(&self) {
        *self.0.0.lock().unwrap() = true;
        self.0.1.notify_all();
    }
}

impl Write for Stalled {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let _open = self.0.1.wait_while(self.0.0.lock().unwrap(), |open| !*open).unwrap();
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Step `k` of a hand that shakes, so that the cloth never rests: of a resting one no mesh is recorded.
fn keep_moving(world: &mut World, k: u32) {
    let site = world.report().hand.map_or([0, 0], |hand| hand.particle);
    let position = world.positions()[world.grid().index(site)];
    let shake = Vec3::z() * [1e-3, -1e-3][k as usize % 2];
    step(world, &[Command::Grab { particle: site }, Command::Move { position: position + shake }]);
}

#[test]
fn a_stalled_disk_never_blocks_the_tick() {
    let dir = tempfile::tempdir().unwrap();
    let (done, ended) = mpsc::channel();
    let disk = Stalled::default();
    let stalled = disk.clone();
    let options = Options {
        queue_cap_bytes: 1 << 20,
        finish_within: Duration::from_millis(20),
        ..every_step(dir.path())
    };
    // On a thread of its own: should it block after all, the test fails instead of hanging.
    thread::spawn(move || {
        let mut world = small_world([8, 8]);
        let recordings = Recordings::open(options).unwrap();
        let mut recorder = recordings.start_into("stalled", &world, Box::new(stalled)).unwrap();
        for k in 0..2000 {
            keep_moving(&mut world, k);
            recorder.record(&world, 0.1);
        }
        recorder.event("still here");
        let status = recorder.status();
        let dropped = status.dropped();
        recorder.finish();
        done.send((dropped, status.error())).unwrap();
    });
    let (dropped, error) = ended.recv_timeout(Duration::from_secs(120)).expect("recording blocked");
    disk.open();
    assert!(dropped > 500, "2000 steps of 1.1 kB do not fit 1 MiB, dropped {dropped}");
    assert!(error.expect("said at the end").contains("within 20ms"));
}

/// A disk that is full from the start.
struct Full;

impl Write for Full {
    fn write(&mut self, _: &[u8]) -> io::Result<usize> {
        Err(io::ErrorKind::StorageFull.into())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_is_said_once_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let mut world = small_world([5, 5]);
    let recordings = Recordings::open(every_step(dir.path())).unwrap();
    let mut recorder = recordings.start_into("full", &world, Box::new(Full)).unwrap();
    step(&mut world, &[]);
    recorder.record(&world, 0.1);
    let status = recorder.status();
    recorder.finish();
    assert!(status.error().expect("an error").contains("no storage space"), "{:?}", status.error());
    assert!(status.dropped() > 0);
    assert_eq!(status.written_bytes(), 0);
}

#[test]
fn the_disk_cap_takes_the_oldest_recordings() {
    let dir = tempfile::tempdir().unwrap();
    for (name, age_s) in [("a.rrd", 10), ("b.rrd", 30), ("c.rrd", 20), ("keep.txt", 40)] {
        let mut file = File::create(dir.path().join(name)).unwrap();
        file.write_all(&[0; 400_000]).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(age_s)).unwrap();
    }
    let options = Options { disk_cap_bytes: 1 << 20, ..every_step(dir.path()) };
    Recordings::open(options).unwrap();
    let left: Vec<_> = recordings_in(dir.path()).iter().map(|p| p.file_name().unwrap().to_owned()).collect();
    assert_eq!(left, ["a.rrd"], "at most six eighths of the cap stay before a session starts");
    assert!(dir.path().join("keep.txt").exists());
}

#[test]
fn a_long_session_goes_on_in_new_files_under_the_cap() {
    let dir = tempfile::tempdir().unwrap();
    let cap = 1 << 20;
    let mut world = small_world([8, 8]);
    let options = Options { disk_cap_bytes: cap, ..every_step(dir.path()) };
    let mut recorder = Recordings::open(options).unwrap().start("long", &world).unwrap();
    let status = recorder.status();
    let first = status.path().unwrap();
    for k in 0..2000 {
        keep_moving(&mut world, k);
        recorder.record(&world, 0.1);
    }
    recorder.finish();
    assert_eq!((status.error(), status.dropped()), (None, 0));
    assert!(status.written_bytes() > 2 * cap, "{} bytes: too short to say anything", status.written_bytes());
    let files = recordings_in(dir.path());
    let total: u64 = files.iter().map(|f| fs::metadata(f).unwrap().len()).sum();
    assert!(total <= cap, "{total} bytes in {} files", files.len());
    assert!(!first.exists(), "the session's own first file is the oldest");
    assert!(files.contains(&status.path().unwrap()));
    let mut newest = 0;
    for file in files {
        let store = of_kind(stores(&file), StoreKind::Recording);
        assert!(
            chunks(&store, "cloth").iter().any(|c| c.is_static()),
            "every file begins with what is said once"
        );
        newest = times(&store, "cloth", "step").into_iter().fold(newest, i64::max);
    }
    assert_eq!(newest, 2000);
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("occupied");
    File::create(&file).unwrap();
    let error = Recordings::open(every_step(&file.join("recordings"))).unwrap_err();
    assert!(matches!(error, RecordingError::Folder { .. }));
    assert!(error.to_string().contains("occupied/recordings: "), "{error}");
}

#[test]
fn options_out_of_range_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let error = Recordings::open(Options { mesh_hz: 0.0, ..every_step(dir.path()) }).unwrap_err();
    assert_eq!(error.to_string(), "mesh_hz = 0: must be above 0 and at most 1000");
}

#[test]
fn live_viewers_find_a_port_or_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let options = Options { serve: Some(taken.local_addr().unwrap()), ..every_step(dir.path()) };
    let error = Recordings::open(options).unwrap_err();
    assert!(matches!(error, RecordingError::Serve { .. }), "{error}");

    let options = Options { serve: Some("127.0.0.1:0".parse().unwrap()), ..every_step(dir.path()) };
    let recordings = Recordings::open(options).unwrap();
    let mut world = small_world([5, 5]);
    let mut recorder = recordings.start("live", &world).unwrap();
    step(&mut world, &[]);
    recorder.record(&world, 0.1);
    assert_ne!(recordings.serving().unwrap().port(), 0);
    let status = recorder.status();
    recorder.finish();
    assert_eq!((status.error(), status.dropped()), (None, 0));
}
