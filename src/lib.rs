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
//! - [`motor`]: nameplate parameters to the coefficients a1…a4.
//! - [`trajectory`]: reference shaping, from a commanded speed to a reference with its derivatives.
//! - [`control`]: the laws, the estimators and their ultimate bounds.
//! - [`hal`]: one exchange per PWM period between the drive and a board.
//! - [`drive`]: the composer: arming, faults, and [`Drive::step`](drive::Drive::step).
//! - [`protocol`]: messages to a host that plays the motor.
//! - `board`: the boards, for targets without an operating system only.
//!
//! All quantities are in SI units.
//!
//! # A drive on a board
//!
//! ```
//! use quasidrive::control::{ControlConfig, Form, Gains, Law, Start, Timing};
//! use quasidrive::drive::{Drive, DriveConfig, Limits};
//! use quasidrive::hal::{Board, BridgeCommand, Sample};
//! use quasidrive::motor::MotorParameters;
//! use quasidrive::trajectory::Shape;
//!
//! /// Stands for a board's ADC, encoder and PWM timer.
//! struct Bench {
//!     duty: f32,
//! }
//!
//! impl Board<f32> for Bench {
//!     fn sample(&mut self) -> Sample<f32> {
//!         Sample { speed: 0.0, current: 0.0, bus_voltage: 24.0 }
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
//! let mut board = Bench { duty: 0.0 };
//! let mut drive = Drive::<f32>::new(&DriveConfig {
//!     motor: MotorParameters::PAPER,
//!     control: ControlConfig {
//!         law: Law::Qsmdo,
//!         gains: Gains::PAPER,
//!         form: Form::Implicit,
//!         start: Start::Matched,
//!     },
//!     timing: Timing { rate: 20_000.0, delay: true },
//!     limits: Limits { duty: 0.92, speed: 400.0, current: 40.0, bus_min: 8.0, bus_max: 28.0 },
//!     shape: Shape::Step,
//! })?;
//! drive.set_speed(104.72).expect("within the limits");
//! drive.arm().expect("no fault");
//! drive.run_period(&mut board); // once a PWM period, in its interrupt
//! // Standstill: (La/a2)·(1 + c²)·ω_d = 0.593 V of 24 V.
//! assert!((board.duty - 0.0247).abs() < 1e-4);
//! # Ok::<(), quasidrive::config::ConfigError>(())
//! ```
#![no_std]

#[cfg(target_os = "none")]
pub mod board;
pub mod config;
pub mod control;
pub mod drive;
pub mod hal;
pub mod math;
pub mod motor;
pub mod protocol;
pub mod trajectory;
