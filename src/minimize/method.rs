//! Who solves the linear systems of live steps, and how accurately.

/// How the linear systems of live steps are solved. Rest, and the stiffness there, always come from a factor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Cholesky by dense fronts on the dissection tree: ours.
    #[default]
    Fronts,
    /// Cholesky by faer, the reference.
    Faer,
    /// Conjugate gradients with a multigrid preconditioner, to the accuracy that the hand feels.
    Multigrid,
    /// The same to the accuracy of a factor, for up to twice the time in ticks of 1 ms.
    Precise,
}

/// Where conjugate gradients end, and whether they may use what is of a moment ago. All are relative [1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Accuracy {
    /// Error of the hand's force at which a solve ends, relative to the force: in a step that is told what the last ones left, and in others.
    pub force: [f64; 2],
    /// Residual, relative to the right-hand side, above which no solve ends: of a step's first one, and of those that follow, whose
    /// right-hand side is what the last one left.
    pub residual: [f64; 2],
    /// Error of the hand's stiffness along an axis, relative to it, at which the response to it is good enough; and residuals above which
    /// none is, relative to the hand's coupling: of one that is not known at all, and of one that is renewed.
    pub stiffness: f64,
    pub column: [f64; 2],
    /// Whether soft elements' blocks may be those of the last step.
    pub may_lag: bool,
    /// Iterations of a solve up to which the next one no longer counts as hard, and beyond which it does.
    pub hard: [u32; 2],
}

impl Method {
    /// Its name on the command line.
    pub fn name(self) -> String {
        let value = clap::ValueEnum::to_possible_value(&self);
        value.map_or(String::new(), |value| value.get_name().to_owned())
    }

    /// The accuracy of conjugate gradients, where they solve; none of a factor.
    pub fn accuracy(self) -> Option<Accuracy> {
        let felt = Accuracy {
            force: [1e-3, 5e-4],
            residual: [2e-2, 1e-1],
            stiffness: 2e-2,
            column: [1e-3, 1e-1],
            may_lag: true,
            hard: [3, 6],
        };
        match self {
            Method::Fronts | Method::Faer => None,
            Method::Multigrid => Some(felt),
            Method::Precise => Some(Accuracy {
                force: [1e-6; 2],
                residual: [1e-5, 1e-1],
                may_lag: false,
                // It takes some two and a half times as many.
                hard: [8, 15],
                ..felt
            }),
        }
    }
}
