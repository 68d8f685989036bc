//! Robust speed control for brushed DC motor drives.
//!
//! The speed loop runs backstepping with a quasi-sliding-mode disturbance observer (BS-QSMDO) or its
//! integral-sliding twin (BS-QISMC) once per PWM period, after Hameed, Al-Samarraie, Humaidi and Saeed,
//! *World Electr. Veh. J.* 2024, 15, 419 — called *the paper* below; equation numbers are the paper's.
//!
//! This library holds everything that decides. Nothing in it knows a peripheral: a real board or the simulated
//! motor of `host-sim` plugs in through [`hal::Board`]. Modules, from the leaves up (imports point up this list only):
//!
//! - [`math`]: the [`Scalar`](math::Scalar) that the loop computes in, and the only door to transcendental functions.
//! - [`config`]: the error that every refused configuration ends in.
//! - [`schema`]: configurations as trees of named values.
//! - [`motor`]: nameplate parameters to the coefficients a1…a4.
//! - [`per_unit`]: what full scale is in fixed point.
//! - [`trajectory`]: reference shaping, from a commanded speed to a reference with its derivatives.
//! - [`hal`]: one exchange per PWM period between the drive and a board.
//! - [`sense`]: from a board's codes and counts to SI units; [`estimate`]: from the shaft's angle to its speed.
//! - [`control`]: the controllers, the quasi-sliding injection and the ultimate bounds.
//! - [`drive`]: the composer: arming, faults, and [`Drive::step`](drive::Drive::step).
//! - [`fault`]: everything that stops or limits a drive, in one list.
//! - [`commission`]: the drive measures its own motor.
//! - [`supervisor`]: when outputs may be on.
//! - [`modulation`], [`shunts`], [`thermistor`]: what boards have in common.
//! - [`parameters`]: all that a user may set, by name, and how it is kept in flash.
//! - [`link`]: messages between a drive and a host that commands and watches it.
//! - [`protocol`]: messages to a host that plays the motor.
//! - `board`: the boards, for targets without an operating system only.
//!
//! All quantities are in SI units.
//!
//! # A drive on a board
//!
//! ```
//! use quasidrive::control::drive_form::{DriveFormConfig, bandwidth_for_ripple};
//! use quasidrive::control::{ControlConfig, Timing};
//! use quasidrive::drive::{Drive, DriveConfig, Limits};
//! use quasidrive::hal::{Board, BridgeCommand, Codes, READS, Sample};
//! use quasidrive::motor::MotorParameters;
//! use quasidrive::sense::{Calibration, Reads, Sensors};
//! use quasidrive::trajectory::Shape;
//!
//! /// Stands for a board's ADC, encoder and PWM timer.
//! struct Bench {
//!     duty: f32,
//! }
//!
//! impl Board<f32> for Bench {
//!     fn sample(&mut self) -> Sample<f32> {
//!         Sample::Codes(Codes { current: 2048, bus_voltage: 3200, encoder: [0; READS], shift: 0 })
//!     }
//!
//!     fn apply(&mut self, command: BridgeCommand<f32>) {
//!         self.duty = match command {
//!             BridgeCommand::Off => 0.0,
//!             BridgeCommand::Duty(duty) => duty,
//!         };
//!     }
//! }
//!
//! let motor = MotorParameters::PAPER;
//! let timing = Timing { rate: 20_000.0, delay: true };
//! let calibration = Calibration {
//!     current_per_code: 0.01,
//!     current_zero: 2048.0,
//!     bus_voltage_per_code: 0.0075,
//!     counts_per_turn: 4096,
//!     highest_code: 4095,
//!     reads: Reads::All,
//! };
//! // A ripple of 20 mV is accepted, loads of 0.3 N·m are to be held, and the model may lack 2.5 V.
//! let bandwidth = bandwidth_for_ripple(&motor, &timing, &calibration, 0.02);
//! let mut board = Bench { duty: 0.0 };
//! let mut drive = Drive::<f32>::new(&DriveConfig {
//!     motor,
//!     sensors: Sensors::Codes(calibration),
//!     control: ControlConfig::Drive(DriveFormConfig::new(bandwidth, 0.3, 2.5)),
//!     timing,
//!     limits: Limits {
//!         duty: 0.92,
//!         speed: 400.0,
//!         current: 20.0,
//!         current_command: 15.0,
//!         bus_min: 8.0,
//!         bus_max: 28.0,
//!     },
//!     shape: Shape::SecondOrder { bandwidth: 60.0 },
//! })?;
//! drive.set_speed(104.72).expect("within the limits");
//! drive.arm().expect("no fault");
//! for _ in 0..20 {
//!     drive.run_period(&mut board); // once a PWM period, in its interrupt
//! }
//! // The shaft of this bench does not turn: the voltage rises after the reference.
//! assert!(board.duty > 0.0 && board.duty < 0.92);
//! # Ok::<(), quasidrive::config::ConfigError>(())
//! ```
#![no_std]

#[cfg(target_os = "none")]
pub mod board;
mod checksum;
pub mod commission;
pub mod config;
pub mod control;
pub mod drive;
pub mod estimate;
pub mod fault;
pub mod hal;
mod limits;
pub mod link;
pub mod math;
pub mod modulation;
pub mod motor;
pub mod parameters;
pub mod per_unit;
pub mod protocol;
pub mod schema;
pub mod sense;
pub mod shunts;
pub mod supervisor;
pub mod thermistor;
pub mod trajectory;
