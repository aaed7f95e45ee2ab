//! Coarser and coarser particles of a mesh, and how the finer ones follow them.
//!
//! A level keeps every second line of the one before, and the last; a graded mesh so loses its finest cells first. What is dropped follows its
//! neighbours on kept lines linearly.

use crate::grid::Site;
use std::collections::HashMap;

/// Masters of a particle on the next coarser level, with their weights.
pub type Masters = Vec<(u32, f32)>;

/// Levels are added until no more particles than these are left.
const FEWEST: usize = 25;

/// Part of a level's particles that the next one may keep: one that drops only the few finest cells of a graded mesh would cost as
/// much again and bring little.
const MOST_KEPT: f64 = 0.6;

/// For every level but the coarsest: masters of each of its particles. `sites` are those of the finest level.
pub fn coarsen(mut sites: Vec<Site>) -> Vec<Vec<Masters>> {
    let mut levels = Vec::new();
    let mut lines = [0, 1].map(|k| {
        let last = sites.iter().map(|s| s[k]).max().unwrap_or(0);
        (0..=last).collect::<Vec<usize>>()
    });
    while sites.len() > FEWEST {
        lines = lines.map(|lines| every_second(&lines));
        let is_kept = |s: &Site| [0, 1].iter().all(|&k| lines[k].binary_search(&s[k]).is_ok());
        let kept: Vec<Site> = sites.iter().copied().filter(is_kept).collect();
        let is_last = lines.iter().all(|lines| lines.len() <= 2) || kept.len() <= FEWEST;
        let most = if is_last { sites.len() - 1 } else { (MOST_KEPT * sites.len() as f64) as usize };
        if kept.len() <= most {
            let numbers = kept.iter().zip(0..).map(|(site, n)| (*site, n)).collect();
            let follow = Follow { lines: &lines, numbers };
            levels.push(sites.iter().map(|&site| follow.masters(site)).collect());
            sites = kept;
        }
        if lines.iter().all(|lines| lines.len() <= 2) {
            break;
        }
    }
    levels
}

fn every_second(lines: &[usize]) -> Vec<usize> {
    let mut kept: Vec<usize> = lines.iter().copied().step_by(2).collect();
    if kept.last() != lines.last() {
        kept.extend(lines.last());
    }
    kept
}

struct Follow<'a> {
    lines: &'a [Vec<usize>; 2],
    numbers: HashMap<Site, u32>,
}

impl Follow<'_> {
    fn masters(&self, site: Site) -> Masters {
        let mut masters: Masters = Vec::new();
        self.add(site, 1.0, self.lines, &mut masters);
        // Parts that fall where no particle is (cut away) are left to the others.
        let sum: f32 = masters.iter().map(|m| m.1).sum();
        masters.iter_mut().for_each(|m| m.1 /= sum);
        masters
    }

    fn add(&self, site: Site, weight: f32, lines: &[Vec<usize>; 2], masters: &mut Masters) {
        if let Some(&number) = self.numbers.get(&site) {
            match masters.iter_mut().find(|m| m.0 == number) {
                Some(master) => master.1 += weight,
                None => masters.push((number, weight)),
            }
            return;
        }
        let [along, across] = [0, 1].map(|k| between(&lines[k], site[k]));
        if along.len() == 1 && across.len() == 1 {
            // On kept lines, yet no particle: it hangs on coarser cells, or is cut away.
            if lines.iter().all(|lines| lines.len() <= 2) {
                return;
            }
            let coarser = [0, 1].map(|k| every_second(&lines[k]));
            return self.add(site, weight, &coarser, masters);
        }
        for &(i, u) in &along {
            for &(j, v) in &across {
                self.add([i, j], weight * u * v, lines, masters);
            }
        }
    }
}

/// The lines around a place and their linear weights.
fn between(lines: &[usize], at: usize) -> Vec<(usize, f32)> {
    match lines.binary_search(&at) {
        Ok(_) => vec![(at, 1.0)],
        Err(after) => {
            let (low, high) = (lines[after - 1], lines[after]);
            let share = (at - low) as f32 / (high - low) as f32;
            vec![(low, 1.0 - share), (high, share)]
        }
    }
}
