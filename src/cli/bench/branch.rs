//! Whether an adaptive sheet is on the same branch of equilibria as the dense one beside it: whether both would come to rest in the same
//! place, on the same mesh.

use super::adapt::Pace;
use crate::{compare::shape_error, grid::Cell, world::World};
use std::{error::Error, thread};

/// Rests of one branch differ by less than this part of the sheet's shorter side: 1 mm of 30 cm. Adaptive drapes that rest in the dense one's
/// folds are off by half of that where cells turn by 0.1 to 0.2 rad; those that snapped elsewhere, by 1 to 6 mm.
const OTHER_REST: f64 = 1.0 / 300.0;

/// In ticks of 20 ms, as long as it takes.
const PACE: Pace = Pace { tick_s: 0.02, solves: 40, every: 5 };

/// Lets copies of both come to rest on the dense mesh, with the hand held where it is; true where a particle then lies elsewhere. `None` where
/// the adaptive sheet cannot be carried to that mesh: it sleeps, or would cut into an obstacle there.
pub(super) fn is_another(sheet: &World, dense: &World) -> Result<Option<bool>, Box<dyn Error>> {
    let Some(mut fine) = on_finest_mesh(sheet)? else { return Ok(None) };
    let mut copy = copy_of(dense)?;
    thread::scope(|scope| {
        let other = scope.spawn(|| PACE.settle(&mut copy).map_err(|e| e.to_string()));
        PACE.settle(&mut fine)?;
        Ok::<_, Box<dyn Error>>(other.join().expect("settling does not panic")?)
    })?;
    let [_, farthest] = shape_error(fine.positions(), copy.positions());
    let [i, j] = dense.grid().size;
    Ok(Some(farthest > OTHER_REST * i.min(j)))
}

/// Another world in the same state.
pub(super) fn copy_of(world: &World) -> Result<World, Box<dyn Error>> {
    let mut copy = World::with_method(world.setup().clone(), world.method())?;
    copy.restore(&world.snapshot());
    Ok(copy)
}

/// A copy whose coarse cells are split until none is left, and whose mesh then stays.
fn on_finest_mesh(sheet: &World) -> Result<Option<World>, Box<dyn Error>> {
    let mut fine = copy_of(sheet)?;
    loop {
        let coarse: Vec<Cell> = fine.grid().cells().iter().filter(|c| c.is_coarse()).copied().collect();
        if coarse.is_empty() {
            fine.set_adaptive(None);
            return Ok(Some(fine));
        }
        let edits = fine.grid().clone().refine(coarse);
        let Some(prepared) = fine.probe().and_then(|probe| probe.change_to(edits)) else { return Ok(None) };
        match fine.fork().on(prepared) {
            Ok(finer) => fine = finer,
            Err(_) => return Ok(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        adapt::Settings,
        cli::bench::live,
        math::Vec3,
        scene::Scene,
        world::{Budget, Command},
    };

    fn sheet(name: &str) -> World {
        let scene = Scene { particles: [21, 21], ..Scene::named(name).unwrap() };
        live::at_rest(&scene).unwrap()
    }

    fn move_hand(world: &mut World, up: f64, ticks: usize) {
        let hand = world.report().hand.unwrap().position;
        let to = [Command::Move { position: hand + Vec3::z() * up }];
        for _ in 0..ticks {
            world.step(&to, PACE.tick_s, Budget::solves(PACE.solves));
        }
    }

    #[test]
    fn a_sheet_that_merged_is_on_the_branch_of_the_dense_one() {
        let mut dense = sheet("hang");
        move_hand(&mut dense, 0.01, 5);
        let mut coarse = copy_of(&dense).unwrap();
        coarse.set_adaptive(Some(Settings::default()));
        assert!(coarse.adapt());
        assert!(coarse.report().particles_active < 21 * 21);
        assert_eq!(on_finest_mesh(&coarse).unwrap().unwrap().report().particles_active, 21 * 21);
        assert_eq!(is_another(&coarse, &dense).unwrap(), Some(false));
    }

    #[test]
    fn a_drape_that_came_back_in_other_folds_is_on_another_branch() {
        let dense = sheet("drape");
        let mut other = copy_of(&dense).unwrap();
        move_hand(&mut other, 0.1, 20);
        move_hand(&mut other, -0.1, 20);
        assert_eq!(is_another(&other, &dense).unwrap(), Some(true));
    }
}
