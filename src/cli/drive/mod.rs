//! `kesi drive`: a hand that follows a path on a running server, and what it felt, as numbers and as a CSV trace.

mod path;
mod trace;

use super::{Done, positive};
use crate::{
    client::{Event, Haptic},
    protocol::{
        haptic::{At, Corner, Device, ServerMessage},
        pose::Move,
    },
};
use path::Path;
use std::{path::PathBuf, time::Duration};
use tokio::{
    runtime,
    time::{Instant, MissedTickBehavior, interval, sleep_until},
};
use trace::Trace;

/// Flags of `kesi drive`.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Server, or haptic socket: ws://HOST:PORT or http://HOST:PORT.
    #[arg(long, default_value = "ws://127.0.0.1:8080")]
    url: String,
    /// Session, where the URL does not name one.
    #[arg(long, default_value = "default")]
    session: String,
    /// Particle: a corner `00`, `I0`, `0J`, `IJ`, or `I,J` by number.
    #[arg(long, default_value = "00", value_parser = particle)]
    at: At,
    /// Path: `circle` through the particle, `pull` up and back, or a CSV file with columns t_s,x_m,y_m,z_m.
    #[arg(long, default_value = "circle", value_name = "circle|pull|FILE.csv")]
    path: String,
    /// Duration [s].
    #[arg(long, default_value_t = 5.0, value_parser = positive, allow_negative_numbers = true)]
    seconds: f64,
    /// Poses per second [Hz].
    #[arg(long, default_value_t = 500.0, value_parser = positive, allow_negative_numbers = true)]
    rate_hz: f64,
    /// Radius of the circle, length of the pull [m].
    #[arg(long, default_value_t = 0.02, value_parser = positive, allow_negative_numbers = true)]
    radius: f64,
    /// Speed along the circle or the pull [m/s].
    #[arg(long, default_value_t = 0.1, value_parser = positive, allow_negative_numbers = true)]
    speed: f64,
    /// Trace of every pose and force model.
    #[arg(long, value_name = "FILE.csv")]
    out: Option<PathBuf>,
}

fn particle(text: &str) -> Result<At, String> {
    let number = |s: &str| s.trim().parse::<u32>().ok();
    match text {
        "00" => Ok(At::Corner(Corner::Origin)),
        "I0" => Ok(At::Corner(Corner::Warp)),
        "0J" => Ok(At::Corner(Corner::Weft)),
        "IJ" => Ok(At::Corner(Corner::Opposite)),
        _ => text
            .split_once(',')
            .and_then(|(i, j)| Some(At::Particle([number(i)?, number(j)?])))
            .ok_or_else(|| "allowed: 00, I0, 0J, IJ, or two numbers as 3,17".into()),
    }
}

/// Drives the hand; bounded by `--seconds` and the client's own patience.
pub(super) fn run(args: &Args) -> Done {
    let path = Path::parse(&args.path, args.radius, args.speed)?;
    let trace = Trace::create(args.out.as_deref())?;
    let runtime = runtime::Builder::new_current_thread().enable_all().build()?;
    let trace = runtime.block_on(drive(args, &path, trace))?;
    println!("{}", trace.finish()?);
    Ok(())
}

async fn drive(args: &Args, path: &Path, mut trace: Trace) -> Result<Trace, Box<dyn std::error::Error>> {
    let mut hand = Haptic::connect(&args.url, &args.session).await?;
    let device = Device { rate_hz: args.rate_hz, ..Device::default() };
    let (particle, home) = hand.grab("kesi drive", device, args.at).await?;
    println!("holding particle ({}, {}) at {home:?} m", particle[0], particle[1]);

    let begin = Instant::now();
    let end = begin + Duration::from_secs_f64(args.seconds);
    let mut beat = interval(Duration::from_secs_f64(1.0 / args.rate_hz));
    beat.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut seq = 0;
    loop {
        tokio::select! {
            () = sleep_until(end) => break,
            _ = beat.tick() => {
                let gone = begin.elapsed();
                seq += 1;
                let position = path.at(gone.as_secs_f64(), home);
                let pose = Move { seq, t_us: gone.as_micros() as u64, position };
                trace.moved(&pose)?;
                hand.follow(&pose).await?;
            }
            event = hand.hear() => match event? {
                Event::Model(model) => trace.felt(&model, begin.elapsed())?,
                Event::Message(ServerMessage::Released { message, .. }) => {
                    return Err(format!("the hand was lost after {:.1} s: {message}", begin.elapsed().as_secs_f64()).into());
                }
                Event::Message(ServerMessage::Error { message, .. }) => return Err(message.into()),
                Event::Message(ServerMessage::Status(status)) => eprintln!("server: {}", status.message),
                Event::Message(_) => {}
            },
        }
    }
    hand.leave(false).await?;
    Ok(trace)
}
