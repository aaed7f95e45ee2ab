//! The cloth's surface as contact meets it: triangles, their edges (cell diagonals included), and the area each stands for.

use crate::grid::Grid;
use std::collections::BTreeMap;

/// Triangles and edges of a mesh with their areas at rest.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    /// Particle indices, counter-clockwise seen from warp × weft.
    pub triangles: Vec<[u32; 3]>,
    /// The edges of each triangle, as indices into `edges`: from its first to its second particle, second to third, third to first.
    pub sides: Vec<[u32; 3]>,
    /// Particle indices, the smaller first.
    pub edges: Vec<[u32; 2]>,
    /// Rest length of each edge [m].
    pub edge_lengths: Vec<f64>,
    /// Area of each particle of the lattice: a third of that of its triangles [m²].
    pub areas: Vec<f64>,
    /// Area of each triangle [m²].
    pub triangle_areas: Vec<f64>,
    /// Area of each edge: a third of that of its triangles [m²].
    pub edge_areas: Vec<f64>,
}

impl Surface {
    /// The surface of a mesh.
    pub fn new(grid: &Grid) -> Surface {
        let areas = vec![0.0; grid.particles()];
        let mut surface = Surface { triangles: grid.triangles(), areas, ..Surface::default() };
        let place = |n: u32| {
            let [i, j] = grid.site(n as usize);
            [i as f64 * grid.spacing(0), j as f64 * grid.spacing(1)]
        };
        let mut known = BTreeMap::new();
        for &[a, b, c] in &surface.triangles {
            let [p, q, r] = [a, b, c].map(place);
            let area = 0.5 * ((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])).abs();
            let sides = [[a, b], [b, c], [c, a]].map(|[from, to]| {
                let ends = [from.min(to), from.max(to)];
                let edge = *known.entry(ends).or_insert_with(|| {
                    surface.edges.push(ends);
                    surface.edge_areas.push(0.0);
                    let [p, q] = ends.map(place);
                    surface.edge_lengths.push((q[0] - p[0]).hypot(q[1] - p[1]));
                    surface.edges.len() - 1
                });
                surface.edge_areas[edge] += area / 3.0;
                edge as u32
            });
            [a, b, c].iter().for_each(|&n| surface.areas[n as usize] += area / 3.0);
            surface.sides.push(sides);
            surface.triangle_areas.push(area);
        }
        surface
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_of_triangles_and_of_edges_both_sum_to_the_sheet() {
        let surface = Surface::new(&Grid::uniform([5, 9], [0.3, 0.2]));
        assert_eq!((surface.triangles.len(), surface.edges.len()), (64, 4 * 9 + 5 * 8 + 32));
        for areas in [&surface.areas, &surface.triangle_areas, &surface.edge_areas] {
            assert!((areas.iter().sum::<f64>() / 0.06 - 1.0).abs() < 1e-12);
        }
    }
}
