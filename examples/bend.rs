use kesi::{fabric, math::Vec3, model::Setup, potential::*, world::*};
use std::sync::Arc;
fn main() {
    let (n, gauge, width) = (10usize, 0.01, 0.01);
    let sp = gauge / n as f64;
    let rows = n + 3;
    let positions: Vec<Vec3> =
        (0..rows * 2).map(|k| Vec3::new((k / 2) as f64 * sp, (k % 2) as f64 * width, 0.0)).collect();
    let cl = [0, 1, rows - 2, rows - 1];
    let setup = Setup {
        fabric: Arc::new(fabric::load("cotton-broad").unwrap()),
        particles: [rows, 2],
        size: [sp * (rows - 1) as f64, width],
        positions,
        pins: cl.iter().flat_map(|&i| [[i, 0], [i, 1]]).collect(),
        hand: None,
        obstacles: vec![],
        gravity: 0.0,
        drag: 0.0,
    };
    let mut w = World::new(setup).unwrap();
    for s in 1..=60 {
        let kappa = s as f64 * 2.5;
        let turn = kappa * gauge;
        let c = turn / n as f64;
        let end: Vec3 = (0..n)
            .map(|k| {
                let h = c * (k as f64 + 0.5);
                Vec3::new(h.cos(), 0.0, h.sin()) * sp
            })
            .sum();
        let mut cmds = vec![];
        for i in [rows - 2, rows - 1] {
            for j in 0..2 {
                let out = if i == rows - 1 { sp } else { 0.0 };
                cmds.push(Command::Drive {
                    particle: [i, j],
                    position: Vec3::new(sp, j as f64 * width, 0.0)
                        + end
                        + Vec3::new(turn.cos(), 0.0, turn.sin()) * out,
                });
            }
        }
        let r = w.step(&cmds, 1e4, Budget::solves(60)).clone();
        if s % 10 == 0 {
            let pivot = w.positions()[(rows - 2) * 2];
            let m: Vec3 = [rows - 2, rows - 1]
                .iter()
                .flat_map(|&i| [[i, 0], [i, 1]])
                .map(|s| (w.positions()[s[0] * 2 + s[1]] - pivot).cross(&w.reaction(s).unwrap()))
                .sum();
            let f: Vec3 = [rows - 2, rows - 1]
                .iter()
                .flat_map(|&i| [[i, 0], [i, 1]])
                .map(|s| w.reaction(s).unwrap())
                .sum();
            let pull = Pull::none(w.model());
            let pot = Potential { model: w.model(), state: w.state(), pull: &pull };
            let ks: Vec<f64> = w
                .model()
                .elements
                .triples
                .iter()
                .filter(|t| t.nodes[1] % 2 == 0)
                .map(|t| pot.bend(t, &triple::Weights::new(t), w.positions()).value.round())
                .collect();
            let es: Vec<f64> = w
                .model()
                .elements
                .edges
                .iter()
                .filter(|e| e.direction == 0 && e.nodes[0] % 2 == 0)
                .map(|e| pot.strain(e, w.positions()).value)
                .map(|v| (v * 1e7).round())
                .collect();
            println!(
                "kappa {kappa} {:?} solves {} res {:.1e} M {:.5} law {:.5} F {:.2e}\n {:?}\n {:?}",
                r.outcome,
                r.solves,
                r.residual,
                m.y / width / 9.80665e-3,
                w.model().fabric.bending[0].loading(kappa) / 9.80665e-3,
                f.norm(),
                ks,
                es
            );
        }
    }
}
