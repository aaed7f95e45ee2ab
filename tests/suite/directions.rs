//! Where folds and tips of cones are sharper than a mesh, sides and normals have no direction: what elements measure fades there.

use crate::{
    cloth,
    derivatives::{assert_taylor, random},
};
use kesi::{
    grid::Triple,
    model::Model,
    potential::{Potential, Pull, contact::candidates::Candidates, fade::Fade, shear, triple, twist},
    state::State,
};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Tips of cones and folds sharper than a cell leave no direction to measure by: there a thousandth of a side pulled with newtons.
#[test]
fn what_has_no_direction_does_not_pull_hard() {
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let triple = Triple {
        nodes: [0, 1, 2, 3, 4],
        site: 1,
        direction: 0,
        lengths: [0.005; 2],
        span: 0.01,
        reach: 0.005,
        area: 1.0,
        rest: 0.0,
    };
    let weights = triple::Weights::new(&triple);
    for _ in 0..2000 {
        let near = [0.3, 0.1, 0.01, 1e-3, 1e-5][rng.random_range(0..5)];
        let (small, b) = (random(&mut rng) * near, random(&mut rng).normalize());
        let turn = random(&mut rng).normalize();
        // The tangent along the line is beside the one across it, or there is none of these.
        for [e1, e2, b] in [[b + turn * 0.9 + small, b - turn * 0.9, b], [b + small, turn, small]] {
            if (e1 + e2).norm() > 0.5 && e1.norm().min(e2.norm()) > 0.5 {
                let steepest = weights.curvature([e1, e2, b]).gradient.map(|g| g.norm() * triple.reach);
                assert!(steepest.iter().all(|g| *g < 25.0), "{e1} {e2} {b}: {steepest:?}");
            }
        }
        let steepest = shear::angle([b, small]).gradient.map(|g| g.norm());
        assert!(steepest.iter().all(|g| *g < 5.0), "{b} {small}: {steepest:?}");
        for a in [small, b + small] {
            let steepest = twist::twist([a, b, turn]).gradient.map(|g| g.norm());
            assert!(steepest.iter().all(|g| *g < 10.0), "{a} {b}: {steepest:?}");
        }
    }
}

/// A sheet crumpled into a ball, so that many of its normals fade, by kernels.
#[test]
fn kernels_of_what_fades_pass_the_taylor_test() {
    let mut setup = cloth::sheet("denim-a", [9, 8], [0.08, 0.07]);
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    setup.positions.iter_mut().for_each(|p| *p = random(&mut rng) * 0.012);
    let model = Model::new(&setup).unwrap();
    let x = setup.positions;
    let (state, candidates, pull) =
        (State::new(&model, x.clone()), Candidates::new(&model), Pull::none(&model));
    let potential = Potential { model: &model, state: &state, candidates: &candidates, pull: &pull };
    let fading = |t: &&Triple| {
        let [e1, e2, b] = triple::Weights::new(t).vectors(t.nodes.map(|n| x[n as usize]));
        (0.1..0.9).contains(&Fade::new((e1 + e2) * 0.5, b).value)
    };
    let count = model.elements.triples.iter().filter(fading).count();
    assert!(count >= 10, "{count} of {}", model.elements.triples.len());
    assert_taylor(&potential, &x, &mut rng, 1e-6);
}
