//! A simulated motor board behind quasidrive's HAL trait, and what is played on it.
//!
//! - [`plant`]: motor, friction, and their integration;
//! - [`profile`]: quantities that change over time;
//! - [`sensors`]: what converters and counters make of the truth;
//! - [`board`]: the simulated board, which implements [`quasidrive::hal::Board`];
//! - [`flash`]: a microcontroller's flash, whose power can fail;
//! - [`commission_bench`]: motors for a drive to measure;
//! - [`double`]: a double-precision scalar, to run the same laws without rounding in the way;
//! - [`scenario`]: what to play, read from TOML and checked;
//! - [`link`]: where the drive runs, here or in [`qemu`];
//! - [`simulation`]: plays a scenario, period by period;
//! - [`frame`]: what is recorded of a period; [`metrics`]: figures of merit of a run;
//! - [`interruption`]: whether the process is asked to end;
//! - [`reproduction`]: the runs that reproduce the paper;
//! - [`scoreboard`]: every controller on the same sensors, and the search for the best of its kind;
//! - [`virtual_drive`]: a drive on the simulated board that speaks the firmware's link; [`serve`] puts it behind a socket;
//! - [`client`]: the host's end of the link; [`connect`], [`commission`] and [`watch`] are its commands, [`assignment`] its names of
//!   parameters;
//! - [`wired`]: motor, power stage and sensors behind the pins of an emulated board, switch by switch;
//! - [`emulated`]: the firmware's image on an emulated board, with that motor: scenarios, faults, agreement;
//! - [`report`]: what they show, as HTML and in the terminal; [`plot`] and [`terminal`] draw its plots and tables.

pub mod assignment;
pub mod board;
pub mod client;
pub mod commission;
pub mod commission_bench;
pub mod connect;
pub mod double;
pub mod emulated;
pub mod flash;
pub mod frame;
pub mod interruption;
pub mod link;
pub mod metrics;
pub mod plant;
pub mod plot;
pub mod profile;
pub mod qemu;
pub mod report;
pub mod reproduction;
mod rule;
pub mod scenario;
pub mod scoreboard;
pub mod sensors;
pub mod serve;
pub mod simulation;
pub mod terminal;
pub mod virtual_drive;
pub mod watch;
pub mod wired;
