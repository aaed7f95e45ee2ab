//! What does not change in a step: fabric, mesh, obstacles, coefficients.

use crate::{
    batch::Batches,
    cut::Cut,
    fabric::Fabric,
    grid::{Direction, Edit, Elements, Grid, Site, Unfit},
    math::Vec3,
    obstacle::{Obstacle, barrier::Barrier},
    surface::Surface,
};
use std::sync::Arc;

/// Everything a world is made from. Scenes build it; `World::new` takes it.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The cloth's fabric.
    pub fabric: Arc<Fabric>,
    /// Particles along warp and weft, `[I, J]`, each at least 2.
    pub particles: [usize; 2],
    /// Rest lengths along warp and weft [m].
    pub size: [f64; 2],
    /// Positions at the start [m], I·J of them, particle (i, j) at i·J + j.
    pub positions: Vec<Vec3>,
    /// Particles that are pinned at the start. An edge between two of them is clamped: it cannot bend.
    pub pins: Vec<Site>,
    /// Particle that the scene gives to the hand: pinned until somebody grabs it, felt and reported from the start.
    pub hand: Option<Site>,
    /// Rigid obstacles.
    pub obstacles: Vec<Obstacle>,
    /// Gravity along -z [m/s²].
    pub gravity: f64,
    /// Air drag per area [kg/(m² s)].
    pub drag: f64,
    /// What is cut from the sheet; all of it without.
    pub cut: Option<Cut>,
    /// Lets edges and triangles pass obstacles, as contact of particles alone does: for comparison.
    pub particles_only: bool,
}

/// Why a setup or a command was refused.
#[derive(Clone, Debug, thiserror::Error, PartialEq)]
#[error("{0}")]
pub struct Refused(pub String);

/// Coefficients of contact. All are `chosen`: no KES test fixes them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// What presses: it begins at a gap of the fabric's thickness, and 50 gf/cm² bring that down to 70 %.
    pub barrier: Barrier,
    /// Friction traction per slip before it slides [Pa/m].
    pub tangential: f64,
    /// Coulomb friction coefficient [1], where an obstacle has none of its own.
    pub friction: f64,
    /// Only particles meet obstacles, edges and triangles do not.
    pub particles_only: bool,
}

/// Largest pressure of a KES compression test [Pa]: 50 gf/cm².
const KES_PRESSURE: f64 = 4903.0;
/// Force on the hand, over the weight on earth, below which errors are not felt as relative ones.
const FELT: f64 = 0.1;

/// Relative error of a force [1] that a mesh of this coarseness, the distance of particles over the bending length, brings about at
/// the most: 1 % at a quarter, 0.1 % at a twelfth. Measured with `kesi validate convergence` on strips of nine fabrics, five to
/// seventeen bending lengths long: 0.03 to 0.12 times the square. Sheets that hang from their corners stay far below; one that is
/// pulled taut by a corner (the scene `flag`) has some 3 % whatever the mesh.
pub fn force_error(coarseness: f64) -> f64 {
    0.13 * coarseness * coarseness
}

/// Coarseness that keeps forces within 1 % by `force_error` [1].
pub const FINE: f64 = 0.25;

/// Coarseness above which a mesh is too coarse for its fabric [1]: `force_error` is 3 % there; above, errors no longer fall with the
/// square, and strips may buckle another way.
pub const TOO_COARSE: f64 = 0.5;

/// The constants of a cloth.
#[derive(Clone, Debug)]
pub struct Model {
    /// Laws and areal density.
    pub fabric: Arc<Fabric>,
    /// Lattice and cells.
    pub grid: Grid,
    /// Elements made from the cells.
    pub elements: Elements,
    /// Area of the sheet [m²].
    pub area: f64,
    /// Particles of the finest lattice that the cut leaves something of.
    pub present: usize,
    /// The elements in batches, for the kernels.
    pub batches: Arc<Batches>,
    /// The cloth's surface.
    pub surface: Surface,
    /// Rigid obstacles.
    pub obstacles: Vec<Obstacle>,
    /// Contact coefficients.
    pub contact: Contact,
    /// Gravity along -z [m/s²].
    pub gravity: f64,
    /// Air drag per area [kg/(m² s)].
    pub drag: f64,
    /// Particles that the scene pins: edges between two of them are clamped.
    pinned: Vec<bool>,
}

impl Model {
    /// The constants of a setup; refuses what makes no cloth.
    pub fn new(setup: &Setup) -> Result<Model, Refused> {
        check(setup)?;
        let grid = Grid::new(setup.particles, setup.size, setup.cut);
        let hand = setup.hand.map(|site| grid.index(site));
        let mut pinned = vec![false; grid.particles()];
        for &site in &setup.pins {
            pinned[grid.index(site)] = true;
        }
        let thickness = setup.fabric.thickness;
        let stiffness = KES_PRESSURE / (0.3 * thickness);
        let contact = Contact {
            barrier: Barrier { activation: thickness, stiffness },
            tangential: stiffness,
            friction: setup.fabric.friction,
            particles_only: setup.particles_only,
        };
        let elements = grid.elements(|n| pinned[n]);
        if let Some(n) = (0..pinned.len()).find(|&n| grid.is_cut_away(n) && (pinned[n] || hand == Some(n))) {
            return Err(Refused(format!("particle: got {:?}, which is cut away", grid.site(n))));
        }
        Ok(Model {
            fabric: setup.fabric.clone(),
            area: elements.areas.iter().sum(),
            present: (0..grid.particles()).filter(|&n| !grid.is_cut_away(n)).count(),
            batches: Arc::new(Batches::new(&elements)),
            elements,
            surface: Surface::new(&grid),
            grid,
            obstacles: setup.obstacles.clone(),
            contact,
            gravity: setup.gravity,
            drag: setup.drag,
            pinned,
        })
    }

    /// Edits the mesh and makes its elements anew. States and solvers of the old mesh do not fit the new one.
    pub fn remesh(&mut self, edits: &[Edit]) -> Result<(), Unfit> {
        self.grid.edit(edits)?;
        self.elements = self.grid.elements(|n| self.pinned[n]);
        self.batches = Arc::new(Batches::new(&self.elements));
        self.surface = Surface::new(&self.grid);
        Ok(())
    }

    /// Lets edges, triples and cells measure from other strains than 0.
    pub fn set_rests(&mut self, [edges, triples, shears]: [Vec<f64>; 3]) {
        self.elements.edges.iter_mut().zip(edges).for_each(|(e, rest)| e.rest = rest);
        self.elements.triples.iter_mut().zip(triples).for_each(|(t, rest)| t.rest = rest);
        self.elements.shears.iter_mut().zip(shears).for_each(|(s, rest)| s.rest = rest);
        self.batches = Arc::new(Batches::new(&self.elements));
    }

    /// Coulomb friction coefficient against an obstacle [1].
    pub fn friction(&self, obstacle: u32) -> f64 {
        self.obstacles[obstacle as usize].friction.unwrap_or(self.contact.friction)
    }

    /// Mass of a particle [kg].
    pub fn mass(&self, particle: usize) -> f64 {
        self.fabric.areal_density * self.elements.areas[particle]
    }

    /// Weight of the whole sheet [N].
    pub fn weight(&self) -> f64 {
        self.fabric.areal_density * self.area * self.gravity
    }

    /// Mass of the whole sheet times 9.81 [N]: a scale of forces that does not vanish with gravity.
    pub fn weight_on_earth(&self) -> f64 {
        self.fabric.areal_density * self.area * 9.81
    }

    /// What errors of a force on the hand are felt relative to [N].
    pub fn felt_scale(&self, force: f64) -> f64 {
        force.max(FELT * self.weight_on_earth())
    }

    /// How coarse the lattice is for its fabric: distance of particles over the bending length ℓ [1], the larger of both directions.
    pub fn coarseness(&self) -> f64 {
        (0..2).map(|k| self.grid.spacing(k) / self.bending_length(k)).fold(0.0, f64::max)
    }

    /// The fewest particles along warp and weft whose lattice is no coarser than `coarseness` [1].
    pub fn particles_for(&self, coarseness: f64) -> [usize; 2] {
        [0, 1].map(|k| {
            (self.grid.size[k] / (coarseness * self.bending_length(k)) - 1e-9).ceil().max(1.0) as usize + 1
        })
    }

    /// The bending length ℓ = (B/w)^(1/3) [m] along a direction: the length over which weight bends the cloth.
    pub fn bending_length(&self, direction: Direction) -> f64 {
        (self.fabric.rigidity(direction) / (self.fabric.areal_density * self.gravity.max(1e-3))).cbrt()
    }
}

fn check(setup: &Setup) -> Result<(), Refused> {
    let refuse = |text: String| Err(Refused(text));
    let [i, j] = setup.particles;
    if i < 2 || j < 2 || i * j > 1_000_000 {
        return refuse(format!(
            "particles: got [{i}, {j}], allowed: at least 2 each, at most 1000000 in all"
        ));
    }
    if setup.size.iter().any(|l| !(l.is_finite() && *l > 0.0)) {
        return refuse(format!("size: got {:?} m, allowed: finite, above 0", setup.size));
    }
    if setup.positions.len() != i * j {
        return refuse(format!(
            "positions: got {}, allowed: {}, one per particle",
            setup.positions.len(),
            i * j
        ));
    }
    if let Some(n) = setup.positions.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
        return refuse(format!("positions: particle [{}, {}] is not finite", n / j, n % j));
    }
    for site in setup.pins.iter().chain(&setup.hand) {
        if site[0] >= i || site[1] >= j {
            return refuse(format!("particle: got {site:?}, allowed: below [{i}, {j}]"));
        }
    }
    if let Some(cut) = &setup.cut {
        let numbers = [cut.center[0], cut.center[1], cut.radius];
        let crosses = cut.covered([0.0; 2], setup.size) > 0.0;
        if !(numbers.iter().all(|v| v.is_finite()) && cut.radius > 0.0 && crosses) {
            return refuse(format!(
                "cut: got {cut:?}, allowed: a disc that covers some of {:?} m",
                setup.size
            ));
        }
    }
    for (name, value) in [("gravity", setup.gravity), ("drag", setup.drag)] {
        if !(value.is_finite() && value >= 0.0) {
            return refuse(format!("{name}: got {value}, allowed: finite, at least 0"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fabric::law::Law;

    fn setup() -> Setup {
        let law = Law::linear(1.0);
        let fabric = Fabric {
            name: "test".into(),
            areal_density: 0.324,
            thickness: 1e-3,
            tensile: [law.clone(), law.clone()],
            bending: [law.clone(), law.clone()],
            shear: law,
            twist: 2.0,
            friction: 0.3,
        };
        Setup {
            fabric: Arc::new(fabric),
            particles: [77, 31],
            size: [0.3, 0.17],
            positions: vec![Vec3::zeros(); 77 * 31],
            pins: vec![],
            hand: None,
            obstacles: vec![],
            gravity: 9.81,
            drag: 0.0,
            cut: None,
            particles_only: false,
        }
    }

    #[test]
    fn a_mesh_is_as_fine_as_asked_for_and_no_finer() {
        let setup = setup();
        let length = (1.0_f64 / (0.324 * 9.81)).cbrt();
        let coarseness = Model::new(&setup).unwrap().coarseness();
        assert!((coarseness - 0.17 / 30.0 / length).abs() < 1e-12, "the coarser direction counts");
        for wanted in [0.01, 0.003, 0.17 / 9.0 / length] {
            let with = |particles: [usize; 2]| {
                let positions = vec![Vec3::zeros(); particles[0] * particles[1]];
                let model = Model::new(&Setup { particles, positions, ..setup.clone() }).unwrap();
                [0, 1].map(|k| model.grid.spacing(k) / model.bending_length(k))
            };
            let enough = Model::new(&setup).unwrap().particles_for(wanted);
            assert!(with(enough).iter().all(|c| *c <= wanted * (1.0 + 1e-9)), "{enough:?}");
            assert!(with(enough.map(|n| n - 1)).iter().all(|c| *c > wanted), "{enough:?}");
        }
        assert!(force_error(FINE) <= 0.01 && force_error(1.0 / 12.0) <= 1e-3);
    }

    #[test]
    fn masses_sum_to_areal_density_times_area() {
        let setup = setup();
        let model = Model::new(&setup).unwrap();
        let mass: f64 = (0..77 * 31).map(|n| model.mass(n)).sum();
        assert!((mass / (0.324 * 0.3 * 0.17) - 1.0).abs() < 1e-12);
    }
}
