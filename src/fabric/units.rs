//! KES units in SI: one factor each. Beside the readers of KES files nobody needs them.

/// Standard gravity [m/s²] times 1 g over 1 cm: 1 gf/cm in N/m. Tensions, 2HG and 2HG5.
pub const GF_PER_CM: f64 = 0.980665;
/// 1 gf·cm/cm² in J/m²: WT.
pub const GF_CM_PER_CM2: f64 = 0.980665;
/// 1 gf·cm²/cm in N·m: B.
pub const GF_CM2_PER_CM: f64 = 9.80665e-5;
/// 1 gf·cm/cm in N: bending moments per width and 2HB.
pub const GF_CM_PER_CM: f64 = 9.80665e-3;
/// 1 1/cm in 1/m: curvatures.
pub const PER_CM: f64 = 100.0;
/// 1° in rad.
pub const DEGREE: f64 = std::f64::consts::PI / 180.0;
/// 1 gf/(cm·deg) in N/(m·rad): G.
pub const GF_PER_CM_DEGREE: f64 = GF_PER_CM / DEGREE;
/// 1 mg/cm² in kg/m²: W.
pub const MG_PER_CM2: f64 = 0.01;
/// 1 mm in m: T.
pub const MM: f64 = 1e-3;
/// 1 % as a fraction: EMT and RT.
pub const PERCENT: f64 = 0.01;
