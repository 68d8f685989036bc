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
//!
//! All quantities are in SI units.
#![no_std]

pub mod config;
pub mod control;
pub mod drive;
pub mod hal;
pub mod math;
pub mod motor;
pub mod trajectory;
