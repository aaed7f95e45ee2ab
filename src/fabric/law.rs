//! Hysteretic laws (placeholder of the skeleton).

/// Force, tangent stiffness and stored energy of a law at a strain.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Response {
    /// Conjugate force.
    pub force: f64,
    /// Tangent stiffness, d force / d strain.
    pub stiffness: f64,
    /// Incremental potential: the integral of the force over the strain, at the given internal variable.
    pub energy: f64,
}

/// Force over strain with rate-independent hysteresis held by one scalar `p`.
#[derive(Clone, Debug)]
pub struct Law {
    slope: f64,
}

impl Law {
    /// A linear law without hysteresis.
    pub fn linear(slope: f64) -> Law {
        Law { slope }
    }
    /// Internal variable of a virgin element.
    pub fn virgin(&self) -> f64 {
        0.0
    }
    /// Response at strain `x` with the internal variable at `p`.
    pub fn evaluate(&self, x: f64, _p: f64) -> Response {
        Response { force: self.slope * x, stiffness: self.slope, energy: 0.5 * self.slope * x * x }
    }
    /// Internal variable after the step that ended at strain `x`.
    pub fn commit(&self, _x: f64, p: f64) -> f64 {
        p
    }
    /// Force on the loading branch.
    pub fn loading(&self, x: f64) -> f64 {
        self.slope * x
    }
    /// Force on the unloading branch.
    pub fn unloading(&self, x: f64) -> f64 {
        self.slope * x
    }
}
