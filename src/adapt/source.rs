//! Which elements of an old mesh those of a new one follow from.
//!
//! Where cells merge, every old element hands its share on to the new ones around it, by linear weights: what the elements pull in all
//! stays the same. Where cells are split, a new element follows from the old one that it is a part of, or from those beside it.

use crate::{
    grid::{Cell, Edge, Elements, Grid, Interpolation, Shear, Triple},
    model::Model,
};
use std::collections::HashMap;

/// Where an element's history comes from.
#[derive(Debug)]
pub enum Source {
    /// The same element of the old mesh.
    Same(u32),
    /// Old elements, with weights, which their areas multiply.
    Mean(Vec<(u32, f64)>),
}

impl Source {
    /// The only old element, where there is but one.
    pub fn only(&self) -> Option<usize> {
        match self {
            Source::Same(k) => Some(*k as usize),
            Source::Mean(merged) => merged.first().filter(|_| merged.len() == 1).map(|f| f.0 as usize),
        }
    }

    /// Mean over the area of what the old elements have.
    pub fn mean(&self, area: &dyn Fn(usize) -> f64, value: &dyn Fn(usize) -> f64) -> f64 {
        let merged = match self {
            Source::Same(k) => return value(*k as usize),
            Source::Mean(merged) => merged,
        };
        let (mut sum, mut total) = (0.0, 0.0);
        for &(k, weight) in merged {
            let k = k as usize;
            // An area of 0 (clamped) still counts a little, so that something does.
            let weight = weight * area(k).max(1e-15);
            sum += weight * value(k);
            total += weight;
        }
        sum / total
    }

    /// The range of what the old elements have.
    pub fn range(&self, value: &dyn Fn(usize) -> f64) -> [f64; 2] {
        match self {
            Source::Same(k) => [value(*k as usize); 2],
            Source::Mean(merged) => {
                let values = merged.iter().map(|(k, _)| value(*k as usize));
                values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
            }
        }
    }
}

/// Weights of old elements.
#[derive(Clone, Debug, Default)]
struct Shares(Vec<(u32, f64)>);

impl Shares {
    fn add(&mut self, k: u32, share: f64) {
        match self.0.iter_mut().find(|known| known.0 == k) {
            Some(known) => known.1 += share,
            None => self.0.push((k, share)),
        }
    }
}

/// The elements of a mesh by their places.
pub struct Sources<'a> {
    model: &'a Model,
    edges: HashMap<[u32; 2], u32>,
    /// Per direction and particle: the edge over the interval that begins there.
    over: [Vec<Option<u32>>; 2],
    /// Per direction and particle: the triple there.
    bends: [Vec<Option<u32>>; 2],
    /// The shear element of the cell whose corner nearest (0, 0) is there.
    shears: HashMap<u32, u32>,
}

/// The triple at each particle, by the direction of its line.
fn triples_at(elements: &Elements, particles: usize) -> [Vec<Option<u32>>; 2] {
    let mut at = [vec![None; particles], vec![None; particles]];
    for (t, k) in elements.triples.iter().zip(0..) {
        at[t.direction][t.site as usize] = Some(k);
    }
    at
}

impl<'a> Sources<'a> {
    /// Of an old mesh.
    pub fn new(model: &'a Model) -> Sources<'a> {
        let (grid, elements) = (&model.grid, &model.elements);
        let mut over = [vec![None; grid.particles()], vec![None; grid.particles()]];
        for (e, k) in elements.edges.iter().zip(0..) {
            let [from, to] = e.nodes.map(|n| grid.site(n as usize));
            for step in from[e.direction]..to[e.direction] {
                let mut site = from;
                site[e.direction] = step;
                over[e.direction][grid.index(site)] = Some(k);
            }
        }
        Sources {
            model,
            edges: elements.edges.iter().zip(0..).map(|(e, k)| (e.nodes, k)).collect(),
            over,
            bends: triples_at(elements, grid.particles()),
            shears: elements.shears.iter().zip(0..).map(|(s, k)| (s.nodes[0], k)).collect(),
        }
    }

    /// What the edges of a mesh follow from in which cells merged, or were split.
    pub fn of_edges(&self, new: &Model, merges: bool) -> Vec<Source> {
        let source = |e: &Edge| if merges { self.merged_edge(e, &new.grid) } else { self.split_edge(e) };
        new.elements.edges.iter().map(source).collect()
    }

    /// The same of the triples.
    pub fn of_triples(&self, new: &Model, merges: bool) -> Vec<Source> {
        let mut shares = vec![Shares::default(); new.elements.triples.len()];
        if merges {
            let at = triples_at(&new.elements, new.grid.particles());
            for (t, k) in self.model.elements.triples.iter().zip(0..) {
                let at = &at[t.direction];
                if let Some(own) = at[t.site as usize] {
                    shares[own as usize].add(k, 1.0);
                    continue;
                }
                for (n, weight) in new.grid.masters(t.site as usize, Interpolation::Linear) {
                    if let Some(other) = at[n as usize] {
                        shares[other as usize].add(k, weight);
                    }
                }
            }
        }
        let triples = new.elements.triples.iter().zip(shares);
        triples.map(|(t, shares)| self.triple(t, shares.0)).collect()
    }

    /// The same of the cells.
    pub fn of_shears(&self, new: &Model) -> Vec<Source> {
        new.elements.shears.iter().map(|s| self.shear(s)).collect()
    }

    /// The old cells in a new one that merging made or left as it was.
    fn cells_in(&self, cell: Cell) -> impl Iterator<Item = Cell> + '_ {
        let [i, j] = [0, 1].map(|k| cell.corner[k]..cell.end()[k]);
        let places = i.flat_map(move |i| j.clone().map(move |j| [i, j]));
        places.filter_map(|place| Some(self.model.grid.leaf(place)).filter(|old| old.corner == place))
    }

    /// The sides of old cells along an edge, within the cells on both of its sides that are as long as it is: each stands for its
    /// half of its cell, and the nearer to the edge it lies, the more of that is the edge's.
    fn merged_edge(&self, e: &Edge, new: &Grid) -> Source {
        let (along, across) = (e.direction, 1 - e.direction);
        let [from, to] = e.nodes.map(|n| new.site(n as usize));
        let mut shares = Shares::default();
        for beside in [from[across].checked_sub(1), Some(from[across])].into_iter().flatten() {
            let mut place = from;
            place[across] = beside;
            if beside + 1 == new.counts[across] {
                continue;
            }
            let cell = new.leaf(place);
            let (ends, size) = ([cell.corner[along], cell.end()[along]], cell.size[across]);
            if ends != [from[along], to[along]] {
                continue;
            }
            for old in self.cells_in(cell) {
                let corners = self.model.grid.corners(&old);
                for (end, forward) in [(0, along + 1), (2 - along, 3)] {
                    let nodes = [corners[end], corners[forward]];
                    let offset = new.site(nodes[0] as usize)[across].abs_diff(from[across]);
                    if let Some(&k) = self.edges.get(&nodes).filter(|_| offset < size) {
                        let own = &self.model.elements.edges[k as usize];
                        let part = (old.intervals() * (size - offset)) as f64;
                        shares.add(k, part / (own.width * own.length));
                    }
                }
            }
        }
        match shares.0[..] {
            [(k, _)] if self.model.elements.edges[k as usize].nodes == e.nodes => Source::Same(k),
            [] => self.split_edge(e),
            _ => Source::Mean(shares.0),
        }
    }

    fn split_edge(&self, e: &Edge) -> Source {
        if let Some(&k) = self.edges.get(&e.nodes) {
            return Source::Same(k);
        }
        let grid = &self.model.grid;
        let [from, to] = e.nodes.map(|n| grid.site(n as usize));
        let mut found = Vec::new();
        for step in from[e.direction]..to[e.direction] {
            let mut site = from;
            site[e.direction] = step;
            if let Some(k) = self.over[e.direction][grid.index(site)] {
                found.push((k, 1.0));
                continue;
            }
            // Inside an old cell: its two sides alongside.
            let cell = grid.leaf([0, 1].map(|k| site[k].min(grid.counts[k] - 2)));
            for side in [cell.corner, cell.end()] {
                site[1 - e.direction] = side[1 - e.direction];
                found.extend(self.over[e.direction][grid.index(site)].map(|k| (k, 0.5)));
            }
        }
        Source::Mean(found)
    }

    /// What a triple follows from that old ones handed their shares on to.
    fn triple(&self, t: &Triple, handed: Vec<(u32, f64)>) -> Source {
        let (grid, bends) = (&self.model.grid, &self.bends[t.direction]);
        if let Some(k) = bends[t.site as usize] {
            let is_alone = handed.iter().all(|share| share.0 == k);
            if is_alone && self.model.elements.triples[k as usize].lengths == t.lengths {
                return Source::Same(k);
            }
        }
        if !handed.is_empty() {
            return Source::Mean(handed);
        }
        // Old triples within half an arm of its centre, along and across.
        let site = grid.site(t.site as usize);
        let arm = [0, 1].map(|k| (t.lengths[k] / grid.spacing(t.direction)).round() as usize / 2);
        let mut found = Vec::new();
        for step in site[t.direction].saturating_sub(arm[0])..=site[t.direction] + arm[1] {
            let reach = arm[0].min(arm[1]);
            let across = site[1 - t.direction];
            for beside in across.saturating_sub(reach)..=across + reach {
                let mut place = [beside; 2];
                place[t.direction] = step;
                if grid.contains(place) {
                    found.extend(bends[grid.index(place)].map(|k| (k, 1.0)));
                }
            }
        }
        if found.is_empty() {
            let masters = grid.masters(t.site as usize, Interpolation::Linear);
            found.extend(masters.iter().filter_map(|&(n, w)| Some((bends[n as usize]?, w))));
        }
        if found.is_empty() {
            // Beside a border, where no master bends this way: whatever does, nearest along the line.
            let next = |forward: bool| {
                (1..grid.counts[t.direction]).find_map(|step| {
                    let mut place = site;
                    place[t.direction] = if forward {
                        site[t.direction] + step
                    } else {
                        site[t.direction].checked_sub(step)?
                    };
                    grid.contains(place).then(|| bends[grid.index(place)]).flatten()
                })
            };
            found.extend(next(true).or_else(|| next(false)).map(|k| (k, 1.0)));
        }
        Source::Mean(found)
    }

    fn shear(&self, s: &Shear) -> Source {
        let grid = &self.model.grid;
        let [low, high] = [s.nodes[0], s.nodes[3]].map(|n| grid.site(n as usize));
        let mut found = Shares::default();
        let places = (low[0]..high[0]).flat_map(|i| (low[1]..high[1]).map(move |j| [i, j]));
        for place in places {
            let cell = grid.leaf(place);
            if let Some(&k) = self.shears.get(&(grid.index(cell.corner) as u32)) {
                if [cell.corner, cell.end()] == [low, high] {
                    return Source::Same(k);
                }
                // A share per interval of the new cell; the old cell's own area must not count again.
                found.add(k, 1.0 / self.model.elements.shears[k as usize].area);
            }
        }
        Source::Mean(found.0)
    }
}
