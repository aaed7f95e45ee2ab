//! What a session does only where somebody asks for it: pictures for viewers, recordings.

use super::{Row, at_rest, compare, hang, in_turn_with};
use crate::{
    runner::{Painter, Rung, Tick},
    world::{Method, World},
};
use std::error::Error;

/// Whatever a frame says of the rate.
const RUNG: Rung = Rung { tick_hz: 1000.0, method: Method::Fronts, least: 1, expense: 1.0 };

/// Without a viewer no state is encoded; with one as many as it takes, here every one.
pub fn no_viewers(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    let [mut unseen, mut seen] = [at_rest(hang(n)?)?, at_rest(hang(n)?)?];
    let mut painter = Painter::default();
    let mut paint = |world: &mut World| {
        painter.paint(world, &Tick::first(world, RUNG));
    };
    let [skipping, working] = in_turn_with([&mut unseen, &mut seen], 5 * ticks, [&mut |_| (), &mut paint]);
    Ok(compare("no viewers", skipping, working, 0.0))
}

/// A recording takes copies out of the tick; what encodes and writes them is another thread.
#[cfg(feature = "recording")]
pub fn no_recording(n: usize, ticks: usize) -> Result<Row, Box<dyn Error>> {
    use crate::recording::{Options, Recordings};

    let [mut silent, mut recorded] = [at_rest(hang(n)?)?, at_rest(hang(n)?)?];
    let folder = tempfile::tempdir()?;
    let options = Options { dir: folder.path().to_owned(), ..Options::default() };
    let mut recorder = Recordings::open(options)?.start("skip", &recorded)?;
    let mut record = |world: &mut World| recorder.record(world, 1.0);
    let [skipping, working] =
        in_turn_with([&mut silent, &mut recorded], 5 * ticks, [&mut |_| (), &mut record]);
    Ok(compare("no recording", skipping, working, 0.0))
}
