//! What is recorded of a period.

use serde::Serialize;

/// One period of a run, at its sampling instant, in SI units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Frame {
    /// Time (s).
    pub time: f64,
    /// Reference speed ω_d (rad/s).
    pub reference: f64,
    /// Shaft speed ω (rad/s).
    pub speed: f64,
    /// Armature current i (A).
    pub current: f64,
    /// Armature voltage u that was commanded of the bridge (V).
    pub voltage: f64,
    /// z1 = ω − ω_d (rad/s).
    pub z1: f64,
    /// z2 (rad/s²).
    pub z2: f64,
    /// ω − x̂1 (BS-QISMC: s1) (rad/s).
    pub sliding1: f64,
    /// z2 − ẑ2 (BS-QISMC: s2) (rad/s²).
    pub sliding2: f64,
    /// Load torque T_l, with Coulomb friction (N·m).
    pub load_torque: f64,
    /// Its estimate T̂_l (N·m).
    pub load_torque_estimate: f64,
}
