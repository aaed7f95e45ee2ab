//! Makes a failing case smaller: fewer manipulations, steps, obstacles and particles, plainer ways, as long as the same invariant
//! is violated.

use super::{Case, Invariant, case::SYNTHETIC, run};
use crate::minimize::Method;

/// Runs that one reduction may take.
const MOST_RUNS: usize = 150;

/// The smallest case found that violates the same invariant.
pub fn reduce(case: &Case, invariant: Invariant) -> Case {
    reduce_by(case, &mut |trial| run(trial).violation.is_some_and(|v| v.invariant == invariant))
}

/// The same with any judge of a trial.
pub fn reduce_by(case: &Case, fails: &mut dyn FnMut(&Case) -> bool) -> Case {
    let mut best = case.clone();
    let mut runs = 0;
    loop {
        let trials = smaller(&best);
        let found = trials.into_iter().find(|trial| {
            runs += 1;
            runs <= MOST_RUNS && fails(trial)
        });
        match found {
            Some(trial) => best = trial,
            None => return best,
        }
    }
}

/// Cases a little smaller, the most promising first.
fn smaller(case: &Case) -> Vec<Case> {
    let mut trials = Vec::new();
    let mut with = |change: &dyn Fn(&mut Case)| {
        let mut trial = case.clone();
        change(&mut trial);
        if trial != *case {
            trials.push(trial);
        }
    };
    for keep in 0..case.acts.len() {
        with(&|c| c.acts.truncate(keep));
    }
    for n in 0..case.acts.len() {
        with(&|c| _ = c.acts.remove(n));
    }
    for n in 0..case.obstacles.len() {
        with(&|c| _ = c.obstacles.remove(n));
    }
    let [i, j] = case.mesh;
    for mesh in
        [[i.div_ceil(2), j.div_ceil(2)], [i.div_ceil(2), j], [i, j.div_ceil(2)], [i - 1, j], [i, j - 1]]
    {
        with(&|c| c.mesh = mesh.map(|n| n.max(2)));
    }
    for ticks in [case.ticks / 2, case.ticks * 3 / 4, case.ticks - 1] {
        with(&|c| c.ticks = ticks.max(1));
    }
    with(&|c| c.adaptive = false);
    with(&|c| c.solver = Method::Fronts);
    if case.fabric != SYNTHETIC {
        with(&|c| c.fabric = "denim-a".into());
    }
    trials
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stress::abuse::Kind;

    #[test]
    fn a_case_shrinks_to_what_makes_it_fail() {
        let mut seeds = (0..).map(Case::draw);
        let big = seeds.find(|c| c.acts.len() >= 3 && c.mesh[0] > 20 && c.obstacles.len() == 3).unwrap();
        let wanted = big.acts[1];
        let small = reduce_by(&big, &mut |c| c.acts.contains(&wanted) && c.mesh[0] >= 5 && c.ticks >= 3);
        assert_eq!(small.acts, [wanted]);
        assert_eq!((small.mesh, small.ticks, small.obstacles.len()), ([5, 2], 3, 0));
        assert!(!small.adaptive && small.solver == Method::Fronts);
        assert_ne!(wanted.1, Kind::Everything, "seeds are chosen without it");
    }
}
