//! The paper's cost: how much a state violates Newton's law and the KES envelopes, over positions *and* element forces.
//!
//! E = Cn En + Cs Es + Cb Eb + Csh Esh, each an area average of squared, dimensionless violations, so that meshes compare:
//!
//! - newton: force out of balance on a free particle over its weight;
//! - stretch: distance of the strain from the strains that the envelope allows at the edge's tension (force → shape);
//! - bend, shear: distance of the moment or shear force from those the envelope allows at the shape (shape → force).
//!
//! Zero exactly where every force balances and every element lies within its envelope. The cost measures quality; the
//! potential is what is minimized. Minimizing this one directly, as the paper does, is for comparison only.

use crate::{
    batch::Measures,
    fabric::law::{Law, ROUNDING},
    math::{Vec3, pack::dispatch},
    model::Model,
    potential::{
        Curvature, Potential,
        kernels::laws::{self, Account},
        shear, triple, twist,
    },
};

/// The cost, term by term.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostReport {
    /// Violation of Newton's law.
    pub newton: f64,
    /// Violation of the tensile envelope.
    pub stretch: f64,
    /// Violation of the bending envelope.
    pub bend: f64,
    /// Violation of the shear envelope.
    pub shear: f64,
}

impl CostReport {
    /// Sum of the terms, which carry their coefficients.
    pub fn total(&self) -> f64 {
        self.newton + self.stretch + self.bend + self.shear
    }
}

/// Weights of the terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coefficients {
    /// Cn.
    pub newton: f64,
    /// Cs.
    pub stretch: f64,
    /// Cb.
    pub bend: f64,
    /// Csh.
    pub shear: f64,
}

impl Default for Coefficients {
    fn default() -> Coefficients {
        Coefficients { newton: 1.0, stretch: 1.0, bend: 1.0, shear: 1.0 }
    }
}

/// Forces of the elements, independent of the shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Forces {
    /// Tension per width of each edge [N/m].
    pub tensions: Vec<f64>,
    /// Bending moment per width of each triple [N].
    pub moments: Vec<f64>,
    /// Shear force per width of each cell [N/m].
    pub shears: Vec<f64>,
}

/// Strain that counts as a violation of 1.
const UNIT_STRAIN: f64 = 0.01;
/// What is added to the slope of a tensile branch where strains follow from tensions, relative to its secant to that strain.
const FLOOR: f64 = 0.03;
/// Angle [rad] whose shear force counts as 1: one degree.
const UNIT_ANGLE: f64 = std::f64::consts::PI / 180.0;

/// Force units that make the violations dimensionless.
struct Units {
    /// Weight per area [N/m²].
    weight: f64,
    /// Moment per width that weight raises over one bending length [N], per direction.
    moment: [f64; 2],
    /// Shear force per width [N/m].
    shear: f64,
}

impl Units {
    fn new(model: &Model) -> Units {
        let gravity = if model.gravity > 0.0 { model.gravity } else { 9.81 };
        let weight = model.fabric.areal_density * gravity;
        let moment = [0, 1].map(|d| weight * model.bending_length(d).powi(2));
        Units { weight, moment, shear: model.fabric.shear.loading(UNIT_ANGLE) }
    }
}

/// Forces that the laws give at the shape `x`.
pub fn forces(potential: &Potential, x: &[Vec3]) -> Forces {
    let (elements, history) = (&potential.model.elements, &potential.state.history);
    let fabric = &potential.model.fabric;
    let tensions = elements.edges.iter().zip(&history.edges);
    let moments = elements.triples.iter().zip(&history.triples);
    let shears = elements.shears.iter().zip(&history.shears);
    Forces {
        tensions: tensions
            .map(|(e, &p)| fabric.tensile[e.direction].evaluate(potential.strain(e, x).value, p).force)
            .collect(),
        moments: moments
            .map(|(t, &p)| {
                let kappa = potential.bend(t, &triple::Weights::new(t), x);
                fabric.bending[t.direction].evaluate(kappa.value, p).force
            })
            .collect(),
        shears: shears
            .map(|(s, &p)| {
                fabric.shear.evaluate(potential.angle(s, &shear::Weights::new(s), x).value, p).force
            })
            .collect(),
    }
}

/// Cost of a live state, whose element forces are those of the laws, and the energy stored in it [J]: one pass over the laws, as
/// this is measured in every tick. `residuals` [N] and `measures` are those of the state.
pub fn of_state(
    potential: &Potential,
    x: &[Vec3],
    residuals: &[Vec3],
    fixed: &[bool],
    measures: &Measures,
) -> (CostReport, f64) {
    let (model, history) = (potential.model, &potential.state.history);
    let (batches, fabric, units) = (&model.batches, &model.fabric, Units::new(model));
    let mut energy = potential.weighed(x);
    let mut cost = CostReport::default();
    let mut add =
        |(stored, outside): (f64, Vec<(u32, f64)>), to: &mut f64, violation: &dyn Fn(u32) -> f64| {
            energy += stored;
            *to = outside.iter().map(|(k, size)| size * violation(*k).powi(2)).sum::<f64>() / model.area;
        };
    let of = dispatch(Account {
        lots: laws::edges(batches, fabric),
        measures: &measures.edges,
        history: &history.edges,
    });
    add(of, &mut cost.stretch, &|k| {
        let [strain, tension] = measures.edges[k as usize];
        let law = &fabric.tensile[model.elements.edges[k as usize].direction];
        strain_violation(law, strain, tension) / UNIT_STRAIN
    });
    let of = dispatch(Account {
        lots: laws::triples(batches, fabric),
        measures: &measures.triples,
        history: &history.triples,
    });
    add(of, &mut cost.bend, &|k| {
        let ([kappa, moment], d) =
            (measures.triples[k as usize], model.elements.triples[k as usize].direction);
        force_violation(&fabric.bending[d], kappa, moment) / units.moment[d]
    });
    let of = dispatch(Account {
        lots: laws::shears(batches, fabric),
        measures: &measures.shears,
        history: &history.shears,
    });
    add(of, &mut cost.shear, &|k| {
        let [phi, force] = measures.shears[k as usize];
        force_violation(&fabric.shear, phi, force) / units.shear
    });
    let twisted = model.elements.shears.iter().zip(&measures.twists).map(|(s, tau)| s.area * tau * tau);
    energy += 0.5 * fabric.twist * twisted.sum::<f64>();
    cost.newton = newton(model, residuals, fixed);
    (cost, energy)
}

fn newton(model: &Model, residuals: &[Vec3], fixed: &[bool]) -> f64 {
    let weight = Units::new(model).weight;
    let areas = &model.elements.areas;
    let terms = model.grid.active().filter(|&n| !fixed[n]);
    terms.map(|n| residuals[n].norm_squared() / areas[n]).sum::<f64>() / (weight * weight * model.area)
}

/// Cost of positions and forces; `fixed` particles owe nothing to Newton.
pub fn evaluate(
    potential: &Potential,
    x: &[Vec3],
    forces: &Forces,
    fixed: &[bool],
    coefficients: &Coefficients,
) -> CostReport {
    let mut report = violations(potential, x, forces, coefficients);
    let residuals = residuals(potential, x, forces);
    report.newton = coefficients.newton * newton(potential.model, &residuals, fixed);
    report
}

/// Distance of `value` from the interval, signed: positive above, negative below, 0 inside.
fn outside(value: f64, [low, high]: [f64; 2]) -> f64 {
    if value > high {
        value - high
    } else if value < low {
        value - low
    } else {
        0.0
    }
}

/// Violation of the strains that the envelope allows at a tension: how far the strain must go back, both branches being a little
/// steeper than they are. Where a branch is flat, the strains that it allows would jump with the tension, and no descent gets over
/// a jump.
fn strain_violation(law: &Law, strain: f64, tension: f64) -> f64 {
    if fits(law, strain, tension) {
        return 0.0;
    }
    let (floor, misfit) = (floor(law), outside(tension, law.envelope(strain)));
    // Too small a tension means too large a strain.
    let sign = -misfit.signum();
    let [mut least, mut most] = [0.0, misfit.abs() / floor];
    let mut size = 0.0;
    for _ in 0..60 {
        let [force, slope] = branch(law, strain - sign * size, sign);
        let left = sign * (force - tension) - floor * size;
        if left > 0.0 {
            least = size;
        } else {
            most = size;
        }
        let newton = size + left / (slope + floor);
        let next = if newton > least && newton < most { newton } else { 0.5 * (least + most) };
        let done = (next - size).abs() <= 1e-15 * (1.0 + size);
        size = next;
        if done {
            break;
        }
    }
    sign * size
}

/// How the violation of a strain changes with the strain [1] and with the tension [m/N].
fn strain_slopes(law: &Law, strain: f64, violation: f64) -> [f64; 2] {
    if violation == 0.0 {
        return [1.0, 0.0];
    }
    let [_, slope] = branch(law, strain - violation, violation);
    let steep = slope + floor(law);
    [slope / steep, -1.0 / steep]
}

/// Force and slope of the branch that bounds strains from above (`side` positive: unloading) or from below.
fn branch(law: &Law, strain: f64, side: f64) -> [f64; 2] {
    let branches = law.branches(strain);
    let [force, slope] = if side > 0.0 { branches.unloading } else { branches.loading };
    [force, slope.max(0.0)]
}

/// Slope that is added to a branch before it is inverted [N/m].
fn floor(law: &Law) -> f64 {
    FLOOR * law.loading(UNIT_STRAIN).abs() / UNIT_STRAIN
}

/// Whether a force lies within the envelope, up to the rounding of the law itself.
fn fits(law: &Law, strain: f64, force: f64) -> bool {
    let [low, high] = law.envelope(strain);
    let hair = ROUNDING * (low.abs() + high.abs());
    force >= low - hair && force <= high + hair
}

/// Violation of the forces that the envelope allows at a strain.
fn force_violation(law: &Law, strain: f64, force: f64) -> f64 {
    if fits(law, strain, force) { 0.0 } else { outside(force, law.envelope(strain)) }
}

fn violations(potential: &Potential, x: &[Vec3], forces: &Forces, coefficients: &Coefficients) -> CostReport {
    let (model, elements) = (potential.model, &potential.model.elements);
    let units = Units::new(model);
    let mut report = CostReport::default();
    for (e, &tension) in elements.edges.iter().zip(&forces.tensions) {
        let violation =
            strain_violation(&model.fabric.tensile[e.direction], potential.strain(e, x).value, tension);
        report.stretch += e.width * e.length * (violation / UNIT_STRAIN).powi(2);
    }
    for (t, &moment) in elements.triples.iter().zip(&forces.moments) {
        let kappa = potential.bend(t, &triple::Weights::new(t), x).value;
        let violation = force_violation(&model.fabric.bending[t.direction], kappa, moment);
        report.bend += t.area * (violation / units.moment[t.direction]).powi(2);
    }
    for (s, &force) in elements.shears.iter().zip(&forces.shears) {
        let phi = potential.angle(s, &shear::Weights::new(s), x).value;
        let violation = force_violation(&model.fabric.shear, phi, force);
        report.shear += s.area * (violation / units.shear).powi(2);
    }
    let area = model.area;
    report.stretch *= coefficients.stretch / area;
    report.bend *= coefficients.bend / area;
    report.shear *= coefficients.shear / area;
    report
}

/// Force out of balance on each particle [N] (minus sign: gradient-like) for element forces independent of the shape.
pub fn residuals(potential: &Potential, x: &[Vec3], forces: &Forces) -> Vec<Vec3> {
    let model = potential.model;
    let mut out = vec![Vec3::zeros(); x.len()];
    for n in model.grid.active() {
        let weight = Vec3::z() * (model.mass(n) * model.gravity);
        let pull = (x[n] - potential.pull.targets[n]) * potential.pull.weights[n];
        out[n] = weight + pull - potential.pull.loads[n];
    }
    potential.contact().add_gradient(x, &mut out);
    for (e, &tension) in model.elements.edges.iter().zip(&forces.tensions) {
        let pull = potential.strain(e, x).gradient * (tension * e.width * e.length);
        out[e.nodes[0] as usize] -= pull;
        out[e.nodes[1] as usize] += pull;
    }
    for (t, &moment) in model.elements.triples.iter().zip(&forces.moments) {
        let weights = triple::Weights::new(t);
        let gradient = weights.spread(&potential.bend(t, &weights, x).gradient);
        t.nodes.iter().zip(gradient).for_each(|(n, g)| out[*n as usize] += g * (moment * t.area));
    }
    for (s, &force) in model.elements.shears.iter().zip(&forces.shears) {
        let weights = shear::Weights::new(s);
        let gradient = weights.spread(&potential.angle(s, &weights, x).gradient);
        let area = s.area;
        s.nodes.iter().zip(gradient).for_each(|(n, g)| out[*n as usize] += g * (force * area));
        // Twist has no envelope: its moment is what the shape gives.
        let weights = twist::Weights::new(s);
        let tau = potential.turn(s, &weights, x);
        let moment = area * model.fabric.twist * tau.value;
        let gradient = weights.spread(&tau.gradient);
        s.bent.iter().zip(gradient).for_each(|(n, g)| out[*n as usize] += g * moment);
    }
    model.elements.gather(&mut out);
    out
}

/// Gradient of the cost in the positions [1/m] and in the element forces (one number per force, in its inverse unit).
pub fn gradient(
    potential: &Potential,
    x: &[Vec3],
    forces: &Forces,
    fixed: &[bool],
    coefficients: &Coefficients,
) -> (Vec<Vec3>, Forces) {
    let (model, elements) = (potential.model, &potential.model.elements);
    let (units, area) = (Units::new(model), model.area);
    // y = ∂En/∂residual; the chain rule then needs ∂residual/∂x · y, one Hessian–vector product per element.
    let scale = 2.0 * coefficients.newton / (area * units.weight * units.weight);
    let mut y = residuals(potential, x, forces);
    for n in model.grid.active() {
        y[n] = if fixed[n] { Vec3::zeros() } else { y[n] * (scale / elements.areas[n]) };
    }
    elements.fill(&mut y);
    let mut by_x = vec![Vec3::zeros(); x.len()];
    for n in model.grid.active() {
        by_x[n] = y[n] * potential.pull.weights[n];
    }
    let contact = potential.contact();
    contact.hessian(&contact.touches(x), x, Curvature::Exact, &mut |row, column, block| {
        let [row, column] = [row, column].map(|n| n as usize);
        by_x[row] += block * y[column];
        if row != column {
            by_x[column] += block.tr_mul(&y[row]);
        }
    });
    let mut by_force = forces.clone();
    for (k, e) in elements.edges.iter().enumerate() {
        let (law, strain) = (&model.fabric.tensile[e.direction], potential.strain(e, x));
        let (tension, size) = (forces.tensions[k], e.width * e.length);
        let [a, b] = e.nodes.map(|n| n as usize);
        let along = y[b] - y[a];
        let violation = strain_violation(law, strain.value, tension);
        let slope = 2.0 * coefficients.stretch * size * violation / (area * UNIT_STRAIN * UNIT_STRAIN);
        let [by_strain, by_tension] = strain_slopes(law, strain.value, violation);
        let pull = strain.hessian() * along * (size * tension) + strain.gradient * (slope * by_strain);
        by_x[a] -= pull;
        by_x[b] += pull;
        by_force.tensions[k] = size * strain.gradient.dot(&along) + slope * by_tension;
    }
    for (k, t) in elements.triples.iter().enumerate() {
        let (law, weights) = (&model.fabric.bending[t.direction], triple::Weights::new(t));
        let kappa = potential.bend(t, &weights, x);
        let along = weights.vectors(t.nodes.map(|n| y[n as usize]));
        let violation = force_violation(law, kappa.value, forces.moments[k]);
        let unit = units.moment[t.direction];
        let slope = 2.0 * coefficients.bend * t.area * violation / (area * unit * unit);
        let second = kappa.hessian_times(along);
        let outward = branch_slope(law, kappa.value, violation);
        let vectors: [Vec3; 3] = std::array::from_fn(|v| {
            second[v] * (t.area * forces.moments[k]) - kappa.gradient[v] * (slope * outward)
        });
        t.nodes.iter().zip(weights.spread(&vectors)).for_each(|(n, g)| by_x[*n as usize] += g);
        let turning: f64 = kappa.gradient.iter().zip(&along).map(|(g, v)| g.dot(v)).sum();
        by_force.moments[k] = t.area * turning + slope;
    }
    for (k, s) in elements.shears.iter().enumerate() {
        let (law, weights) = (&model.fabric.shear, shear::Weights::new(s));
        let phi = potential.angle(s, &weights, x);
        let [a, b] = weights.vectors(s.nodes.map(|n| y[n as usize]));
        let violation = force_violation(law, phi.value, forces.shears[k]);
        let size = s.area;
        let slope = 2.0 * coefficients.shear * size * violation / (area * units.shear * units.shear);
        let [aa, ab, bb] = phi.hessian();
        let second = [aa * a + ab * b, ab.tr_mul(&a) + bb * b];
        let outward = branch_slope(law, phi.value, violation);
        let vectors: [Vec3; 2] = std::array::from_fn(|v| {
            second[v] * (size * forces.shears[k]) - phi.gradient[v] * (slope * outward)
        });
        s.nodes.iter().zip(weights.spread(&vectors)).for_each(|(n, g)| by_x[*n as usize] += g);
        by_force.shears[k] = size * (phi.gradient[0].dot(&a) + phi.gradient[1].dot(&b)) + slope;
        let weights = twist::Weights::new(s);
        let tau = potential.turn(s, &weights, x);
        let along = weights.vectors(s.bent.map(|n| y[n as usize]));
        let turning: f64 = tau.gradient.iter().zip(&along).map(|(g, v)| g.dot(v)).sum();
        let second = tau.hessian_times(along);
        let stiffness = size * model.fabric.twist;
        let vectors: [Vec3; 3] =
            std::array::from_fn(|v| (second[v] * tau.value + tau.gradient[v] * turning) * stiffness);
        s.bent.iter().zip(weights.spread(&vectors)).for_each(|(n, g)| by_x[*n as usize] += g);
    }
    elements.gather(&mut by_x);
    (by_x, by_force)
}

/// Slope of the branch that a force violates at a strain: the upper one when it is too large, the lower when too small.
fn branch_slope(law: &Law, strain: f64, violation: f64) -> f64 {
    let branches = law.branches(strain);
    if violation > 0.0 { branches.loading[1] } else { branches.unloading[1] }
}
