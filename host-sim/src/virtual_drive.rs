//! A drive on the simulated board that speaks the link: what a user without a board connects to.
//!
//! The supervisor, the parameters' store and the link's session are the firmware's own. Here they share a thread; on a board the
//! supervisor belongs to the control interrupt.

use crate::board::SimulatedBoard;
use crate::flash::SimulatedFlash;
use crate::scenario::Scenario;
use quasidrive::commission::{Commission, Evidence, Nameplate, Progress};
use quasidrive::config::ConfigError;
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::DriveConfig;
use quasidrive::fault::Fault;
use quasidrive::hal::{Board, BridgeCommand};
use quasidrive::link::message::{Identity, Refusal, Status, Telemetry, VERSION};
use quasidrive::link::session::Device;
use quasidrive::parameters::Parameters;
use quasidrive::parameters::store::{Loaded, Origin, ParameterStore, RegionError};
use quasidrive::shunts::CurrentSensors;
use quasidrive::supervisor::{Command, Conditions, Mode, Output, Supervisor};
use std::collections::VecDeque;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Where the flash keeps parameters: its last two pages.
pub const REGION: Range<u32> = 0x1_f000..0x2_0000;

/// Telemetry that may wait.
const WAITING: usize = 64;

/// What the board finds: all well, at room temperature.
const CONDITIONS: Conditions = Conditions {
    temperature: 25.0,
    current_sensors: CurrentSensors::Good,
    tripped: false,
    overrun: false,
};

/// A supervised drive on the simulated board of a scenario.
pub struct VirtualDrive {
    supervisor: Supervisor<f32>,
    /// What measures the motor, or has measured it.
    commission: Option<Commission>,
    board: SimulatedBoard<f32>,
    parameters: Parameters,
    flash: SimulatedFlash,
    period: u32,
    decimation: u32,
    telemetry: VecDeque<Telemetry>,
    interrupt_time: Duration,
    longest_interrupt_time: Duration,
}

impl VirtualDrive {
    /// The drive of a scenario, with the parameters that a flash holds, or else the scenario's.
    pub fn new(scenario: &Scenario, mut flash: SimulatedFlash) -> Result<Self, ConfigError> {
        let defaults = scenario.parameters();
        let loaded = store(&mut flash)
            .map(|mut store| store.load(&defaults))
            .unwrap_or(Loaded { parameters: defaults, origin: Origin::Unreadable });
        let built = build(&loaded.parameters, &defaults.drive.timing);
        let (parameters, supervisor) = match (loaded.origin, built) {
            (Origin::Saved | Origin::NeverSaved, Ok(supervisor)) => (loaded.parameters, supervisor),
            _ => {
                let mut supervisor = build(&defaults, &defaults.drive.timing)?;
                supervisor.latch(Fault::BadParameters);
                (defaults, supervisor)
            }
        };
        Ok(Self {
            board: SimulatedBoard::new(scenario, *supervisor.drive().bases()),
            supervisor,
            commission: None,
            parameters,
            flash,
            period: 0,
            decimation: 0,
            telemetry: VecDeque::with_capacity(WAITING),
            interrupt_time: Duration::ZERO,
            longest_interrupt_time: Duration::ZERO,
        })
    }

    /// One PWM period: sample, step, apply.
    pub fn run_period(&mut self) {
        let sample = self.board.sample();
        let start = Instant::now();
        let mut output = self.supervisor.step(&sample, &CONDITIONS);
        if let Some(commission) = &mut self.commission {
            output = self.supervisor.measure(&sample, commission);
        }
        self.interrupt_time = start.elapsed();
        self.longest_interrupt_time = self.longest_interrupt_time.max(self.interrupt_time);
        self.board.apply(match output {
            Output::Duty(duty) => BridgeCommand::Duty(duty),
            // Charging moves no motor.
            Output::Off | Output::Charge => BridgeCommand::Off,
        });
        self.period = self.period.wrapping_add(1);
        if self.decimation > 0
            && self.period.is_multiple_of(self.decimation)
            && self.telemetry.len() < WAITING
        {
            self.telemetry.push_back(self.observe(output));
        }
    }

    /// What telemetry tells of a period.
    fn observe(&self, output: Output<f32>) -> Telemetry {
        let drive = self.supervisor.drive();
        let [current, bus_voltage] = drive.current_and_bus();
        let nanoseconds = |time: Duration| u32::try_from(time.as_nanos()).unwrap_or(u32::MAX);
        let idle = Telemetry {
            period: self.period,
            reference: 0.0,
            speed: drive.speed(),
            current,
            voltage: 0.0,
            bus_voltage,
            load_torque: 0.0,
            temperature: CONDITIONS.temperature,
            interrupt_time: nanoseconds(self.interrupt_time),
            longest_interrupt_time: nanoseconds(self.longest_interrupt_time),
        };
        match (output, drive.telemetry()) {
            // The drive does not drive.
            (Output::Duty(duty), _) if self.supervisor.mode() == Mode::Commissioning => {
                Telemetry { voltage: duty * bus_voltage, ..idle }
            }
            (Output::Duty(_), Some(driven)) => Telemetry {
                reference: driven.reference.speed,
                voltage: driven.voltage,
                load_torque: driven.load_torque,
                ..idle
            },
            _ => idle,
        }
    }

    /// The flash.
    pub fn flash(&self) -> &SimulatedFlash {
        &self.flash
    }
}

fn store(flash: &mut SimulatedFlash) -> Result<ParameterStore<&mut SimulatedFlash>, RegionError> {
    ParameterStore::new(flash, REGION)
}

/// The supervisor of a set of parameters, for a board that samples with `timing`.
fn build(parameters: &Parameters, timing: &Timing) -> Result<Supervisor<f32>, ConfigError> {
    let Parameters { drive, protection } = parameters;
    if drive.timing != *timing {
        return Err(ConfigError {
            field: "timing.rate",
            rule: "and timing.delay must be as in the scenario that is served",
            value: drive.timing.rate,
        });
    }
    Supervisor::new(drive, protection)
}

impl Device for VirtualDrive {
    fn identity(&self) -> Identity<'static> {
        Identity {
            version: VERSION,
            board: "simulated",
            firmware: env!("CARGO_PKG_VERSION"),
            build: quasidrive::link::BUILD,
        }
    }

    fn status(&self) -> Status {
        Status {
            mode: self.supervisor.mode(),
            faults: self.supervisor.faults(),
            limits: self.supervisor.limits(),
        }
    }

    fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    fn command(&mut self, command: Command) -> Result<(), Refusal<'static>> {
        Ok(self.supervisor.command(command)?)
    }

    fn change_controller(&mut self, control: &ControlConfig) -> Result<(), Refusal<'static>> {
        let drive = DriveConfig { control: *control, ..self.parameters.drive };
        let parameters = Parameters { drive, ..self.parameters };
        let mut other = build(&parameters, &self.parameters.drive.timing)?;
        self.supervisor.take_controller(&mut other);
        self.parameters = parameters;
        Ok(())
    }

    fn change_parameters(&mut self, parameters: &Parameters) -> Result<(), Refusal<'static>> {
        let mut supervisor = build(parameters, &self.parameters.drive.timing)?;
        supervisor.succeed(&self.supervisor);
        self.supervisor = supervisor;
        self.parameters = *parameters;
        Ok(())
    }

    fn save_parameters(&mut self) -> Result<(), Refusal<'static>> {
        let saved = store(&mut self.flash).map(|mut store| store.save(&self.parameters));
        if matches!(saved, Ok(Ok(()))) { Ok(()) } else { Err(Refusal::NotSaved) }
    }

    fn commission(&mut self, nameplate: &Nameplate) -> Result<(), Refusal<'static>> {
        let commission = Commission::new(&nameplate.config(&self.parameters.drive)?)?;
        self.supervisor.start_commissioning()?;
        self.commission = Some(commission);
        Ok(())
    }

    fn progress(&self) -> Progress {
        match (self.supervisor.mode(), &self.commission) {
            (Mode::Armed | Mode::Commissioning, Some(commission)) => commission.progress(),
            _ => Progress::OVER,
        }
    }

    fn evidence(&mut self) -> Option<Evidence> {
        let commission = self.commission.as_mut()?;
        // Whatever ended it.
        commission.abort();
        Some(commission.evidence())
    }

    fn set_telemetry(&mut self, decimation: u32) {
        self.decimation = decimation;
        self.telemetry.clear();
    }

    fn next_telemetry(&mut self) -> Option<Telemetry> {
        self.telemetry.pop_front()
    }
}
