//! Halves of the elements: what two threads add to the Hessian at a time.

use super::{
    pattern::{Slot, Slots},
    values::Values,
};
use crate::{cores::Team, math::pack::WIDTH};

/// Particles from which on two threads share a solve: handing a half over takes what it saves on smaller meshes.
pub const FEWEST_IN_HALVES: usize = 3000;
/// Those from which on they share an assembly of more than edges.
pub const FEWEST_ASSEMBLED_IN_HALVES: usize = 800;

/// Has a helper come for half of an assembly of more than edges, where so many particles are enough for two.
pub fn call_for_assembly(team: &Team, particles: usize) {
    if particles >= FEWEST_ASSEMBLED_IN_HALVES {
        team.call(particles);
    }
}

/// Has all parts added, each with its own of three: both halves at a time, then what is across. `add` must add to the batches of the part it is
/// told and to no others.
pub(super) fn add_parts<T: Send>(
    values: &mut Values,
    team: &Team,
    [low, high, across]: [T; 3],
    add: impl Fn(Part, T, &mut Values) + Sync,
) {
    // SAFETY: batches of `Low` add to no place that batches of `High` add to.
    let [mut one, mut other] = unsafe { values.halves() };
    team.both(|| add(Part::Low, low, &mut one), || add(Part::High, high, &mut other));
    add(Part::Across, across, values);
}

/// Which thread adds a batch of elements to the Hessian: what two do at a time touches no place of both.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Batches of particles in the first half of the order.
    Low,
    /// Those of particles in the second.
    High,
    /// What is added once both are done.
    Across,
}

impl Part {
    /// That of a batch; those beyond the list name ghosts, whose masters may be anywhere.
    #[inline(always)]
    pub fn of(parts: &[Part], batch: usize) -> Part {
        parts.get(batch).copied().unwrap_or(Part::Across)
    }

    /// That of the batch with these slots, where it is told whose each place is: of one half only if all is that it adds to.
    pub(super) fn of_slots(slots: &[Slots], lanes: &[[Slot; WIDTH]], whose: &[Part]) -> Part {
        let mut all = slots.iter().flat_map(|slots| places(slots, lanes)).map(|place| whose[place]);
        let first = all.next().expect("an element has particles");
        if all.all(|part| part == first) { first } else { Part::Across }
    }

    /// That of a pair of places.
    pub(super) fn of_pair(low: usize, high: usize, middle: usize) -> Part {
        if high < middle {
            Part::Low
        } else if low >= middle {
            Part::High
        } else {
            Part::Across
        }
    }
}

/// Places that a batch's lanes add to, those that do not count as well.
fn places(slots: &Slots, lanes: &[[Slot; WIDTH]]) -> [usize; WIDTH] {
    let at = slots.at as usize;
    std::array::from_fn(|l| if slots.is_run { at + l } else { lanes[at][l].at as usize })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{grid::Grid, potential::pattern::Pattern};
    use std::collections::HashSet;

    /// The places that each half's batches add to, and how many batches each part has.
    fn halves(particles: [usize; 2]) -> ([HashSet<usize>; 2], [usize; 3]) {
        let grid = Grid::uniform(particles, [0.3, 0.3]);
        let pattern = Pattern::new(&grid, &grid.elements(|_| false));
        let (mut touched, mut counts) = ([HashSet::new(), HashSet::new()], [0; 3]);
        let mut note = |part: Part, slots: &[Slots]| {
            counts[part as usize] += 1;
            if let Some(touched) = touched.get_mut(part as usize) {
                touched.extend(slots.iter().flat_map(|slots| places(slots, &pattern.lanes)));
            }
        };
        pattern.triples.iter().zip(&pattern.parts[0]).for_each(|(slots, part)| note(*part, slots));
        pattern.shears.iter().zip(&pattern.parts[1]).for_each(|(slots, part)| note(*part, slots));
        (touched, counts)
    }

    #[test]
    fn halves_meet_in_no_place_and_leave_little_to_be_added_later() {
        for particles in [[57, 57], [153, 21], [21, 153]] {
            let ([low, high], [first, second, across]) = halves(particles);
            assert!(low.is_disjoint(&high), "{particles:?}");
            assert!(first.abs_diff(second) < first / 4, "{particles:?}: {first} and {second}");
            assert!(across < first / 4, "{particles:?}: {across} of {first}");
        }
        assert_eq!(halves([20, 20]).1[1], 0, "small meshes stay whole");
    }
}
