//! What must hold, and how it fared.

named! {
    /// What must hold.
    Invariant {
        /// No panic.
        Panic = "no panic",
        /// Every number of state and report is finite.
        Finite = "finite",
        /// Masses sum to areal density times area.
        Mass = "mass",
        /// The mesh is valid, and ghosts are where their masters put them.
        Mesh = "mesh valid",
        /// Slip states and forces of all elements lie in their envelopes.
        History = "history in envelope",
        /// Friction is within Coulomb's limit.
        Friction = "friction in limit",
        /// Dissipation only grows.
        Dissipation = "dissipation grows",
        /// The surface stays apart from obstacles.
        Gap = "gap > 0",
        /// The hand's stiffness is symmetric, and so is the derivative of all forces.
        Symmetry = "K symmetric",
        /// The force out of balance, from positions and velocities, is the one reported.
        Motion = "balance of momentum",
        /// The stored energy, summed by scalar laws, is the one reported.
        Energy = "energy as reported",
        /// While nothing is moved the energy does not grow, beyond the work of what a step leaves out of balance.
        Growth = "no energy from nothing",
        /// While something is moved it grows by no more than the work of hand, clamps and obstacles, and of what is out of balance.
        Work = "no energy beyond work",
        /// A change of the mesh keeps mass and momentum.
        Transfer = "momentum at a change of mesh",
        /// Refused commands change nothing.
        Refusal = "nonsense refused",
        /// The same snapshot and commands give the same bits.
        Repeat = "same bits again",
        /// It comes to rest when the abuse stops, or loses energy until the case ends.
        Rest = "rest after abuse",
        /// Woken at rest and left alone, it rests at the same energy.
        Wake = "rest energy after waking",
        /// Its rest energy is that of a twin from the same snapshot.
        Twin = "rest energy of a twin",
    }
}

/// How an invariant fared.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// How often it was measured.
    pub checks: u64,
    /// How often it was violated.
    pub violations: u64,
    /// Largest ratio to its allowance.
    pub worst: f64,
}

/// The first violation of a case.
#[derive(Clone, Debug, PartialEq)]
pub struct Violation {
    /// What did not hold.
    pub invariant: Invariant,
    /// Ratio to its allowance.
    pub ratio: f64,
    /// Step of the case.
    pub step: u64,
    /// Place of the manipulation that was going on.
    pub act: usize,
    /// What explains it.
    pub note: String,
}
