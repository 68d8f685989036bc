//! From what commissioning found to a drive.
//!
//! | what | from |
//! |---|---|
//! | bandwidth of the observer, and with it all the others | the voltage ripple that counts make (a thousandth of the bus) and that noise of the current makes (a hundredth) |
//! | authority over load torques | the torque of the largest current |
//! | voltage reserve | what brushes and dead time take, and a tenth of the bus for a winding that warms up |
//! | the reference's bandwidth | half the torque of the largest current, for a step to the highest speed |

use super::{CommissionConfig, Findings, Reason};
use crate::control::ControlConfig;
use crate::control::drive_form::{DriveFormConfig, bandwidth_for_ripple};
use crate::drive::DriveConfig;
use crate::math::{exp_m1, sqrt};
use crate::motor::MotorParameters;
use crate::sense::Sensors;
use crate::trajectory::Shape;

/// Ripple of the voltage that counts may make, and that noise of the current may make, over the bus voltage (rms).
const COUNTS_RIPPLE: f32 = 1e-3;
const NOISE_RIPPLE: f32 = 1e-2;

/// Voltage in reserve over the bus voltage, besides what is lost.
const RESERVE: f32 = 0.1;

/// Share of the largest torque for a step of the reference to the highest speed, and of the speed loop's bandwidth for the reference's.
const REFERENCE_TORQUE: f32 = 0.5;
const REFERENCE_BANDWIDTH: f32 = 0.25;

/// All that a drive is tuned from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Known {
    /// The motor.
    pub motor: MotorParameters,
    /// Voltage that brushes and dead time take (V).
    pub voltage_drop: f32,
    /// Noise of the current (A rms).
    pub current_noise: f32,
    /// Bus voltage (V).
    pub bus_voltage: f32,
    /// The sensors, with the right signs and zero.
    pub sensors: Sensors,
}

impl Known {
    /// From what was found, or why something that is needed was not. Without friction found there is none.
    pub fn new(findings: &Findings, config: &CommissionConfig) -> Result<Self, Reason> {
        let encoder_reversed = findings.encoder_reversed?;
        let mut sensors = config.sensors;
        if let Sensors::Codes(calibration) = &mut sensors {
            // Within the noise it is none: a board that learns its zero by itself wants it kept.
            if findings.current_offset.abs() > findings.current_noise {
                calibration.current_zero += findings.current_offset / calibration.current_per_code;
            }
            if findings.current_reversed {
                calibration.current_per_code = -calibration.current_per_code;
            }
            if encoder_reversed {
                calibration.counts_per_turn = -calibration.counts_per_turn;
            }
        }
        let or_none =
            |value: Result<super::Value, Reason>| value.map_or(0.0, |it| it.value.max(0.0));
        Ok(Self {
            motor: MotorParameters {
                inertia: findings.inertia?.value,
                inductance: findings.inductance?.value,
                resistance: findings.resistance?.value,
                viscous_friction: or_none(findings.viscous_friction),
                back_emf_constant: findings.back_emf_constant?.value,
            },
            voltage_drop: or_none(findings.voltage_drop),
            current_noise: findings.current_noise,
            bus_voltage: findings.bus_voltage,
            sensors,
        })
    }

    /// A drive with the drive form of BS-QSMDO within the limits that commissioning had.
    pub fn tuned(&self, config: &CommissionConfig) -> DriveConfig {
        let &Self { motor, voltage_drop, current_noise, bus_voltage, sensors } = self;
        let CommissionConfig { timing, mut limits, voltage, .. } = *config;
        limits.duty = limits.duty.min(voltage / bus_voltage);
        let by_counts = match &sensors {
            Sensors::Exact => 0.1 * timing.rate,
            Sensors::Codes(calibration) => {
                bandwidth_for_ripple(&motor, &timing, calibration, COUNTS_RIPPLE * bus_voltage)
            }
        };
        let ripple = self.ripple_of_noise(by_counts, timing.period()) * current_noise;
        // It grows faster than the bandwidth.
        let share = (NOISE_RIPPLE * bus_voltage / ripple).min(1.0);
        let bandwidth = (share * by_counts).max(0.03 * timing.rate);
        let torque = motor.back_emf_constant * limits.current_command;
        let reserve = RESERVE * bus_voltage + voltage_drop;
        let control = DriveFormConfig::new(bandwidth, torque, reserve);
        // A critically damped second order accelerates most by the step times its bandwidth over e.
        let by_torque =
            REFERENCE_TORQUE * core::f32::consts::E * torque / (motor.inertia * limits.speed);
        let by_loop = REFERENCE_BANDWIDTH * control.speed_bandwidth;
        DriveConfig {
            motor,
            sensors,
            control: ControlConfig::Drive(control),
            timing,
            limits,
            shape: Shape::SecondOrder { bandwidth: by_torque.min(by_loop) },
        }
    }

    /// Voltage that a noise of the current makes by way of the current's controller (V/A): its gain, through the filter ahead
    /// of the bridge.
    fn ripple_of_noise(&self, bandwidth: f32, period: f32) -> f32 {
        let MotorParameters { resistance, inductance, .. } = self.motor;
        let DriveFormConfig { current_bandwidth, output_bandwidth, .. } =
            DriveFormConfig::new(bandwidth, 0.0, 0.0);
        let lost = -exp_m1(-period * resistance / inductance);
        let gain = -exp_m1(-current_bandwidth * period) * (1.0 - lost) * resistance / lost;
        let share = -exp_m1(-output_bandwidth * period);
        gain * sqrt(share / (2.0 - share))
    }
}
