//! What the supervisor promises: outputs are off unless armed and without fault, whatever comes; each transition and each
//! protection by what makes it.

use host_sim::board::SimulatedBoard;
use host_sim::commission_bench::Bench as MotorBench;
use host_sim::scoreboard::motors::Machine;
use proptest::prelude::*;
use quasidrive::commission::{Commission, Nameplate, Phase, Reason};
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::{DriveConfig, Limits};
use quasidrive::estimate::SpeedSource;
use quasidrive::fault::{ActiveLimit, Fault, Faults};
use quasidrive::hal::{Board, BridgeCommand, Codes, Exact, READS, Sample};
use quasidrive::motor::MotorParameters;
use quasidrive::sense::Sensors;
use quasidrive::shunts::CurrentSensors;
use quasidrive::supervisor::{
    Command, Conditions, Event, Mode, Output, Protection, Refusal, Supervisor, TRANSITIONS,
};
use quasidrive::trajectory::Shape;

const RATE: f32 = 20_000.0;

const CONFIG: DriveConfig = DriveConfig {
    motor: MotorParameters::PAPER,
    sensors: Sensors::Exact,
    control: ControlConfig::Paper(PaperConfig {
        law: Law::Qsmdo,
        gains: Gains::PAPER,
        form: Form::Implicit,
        start: Start::Zero,
        speed: SpeedSource::Exact,
    }),
    timing: Timing { rate: RATE, delay: true },
    limits: Limits {
        duty: 0.9,
        speed: 400.0,
        current: 20.0,
        current_command: 10.0,
        bus_min: 8.0,
        bus_max: 28.0,
    },
    shape: Shape::Step,
};

const PROTECTION: Protection = Protection {
    continuous_current: 4.0,
    thermal_time: 0.2,
    temperature: 80.0,
    command_timeout: 0.1,
    stop_time: 0.3,
    standstill: 2.0,
};

const GOOD: Conditions = Conditions {
    temperature: 25.0,
    current_sensors: CurrentSensors::Good,
    tripped: false,
    overrun: false,
};

const REST: Exact<f32> = Exact { speed: 0.0, advance: 0.0, current: 0.0, bus_voltage: 24.0 };

/// Periods in which every slow check was made.
const A_TURN: u32 = 64;

/// Periods after which bootstraps are charged.
const CHARGED: u32 = 600;

/// A supervisor with what it is told each period.
#[derive(Clone)]
struct Bench {
    supervisor: Supervisor<f32>,
    commission: Commission,
    sample: Exact<f32>,
    conditions: Conditions,
}

impl Bench {
    fn new() -> Self {
        let supervisor = Supervisor::new(&CONFIG, &PROTECTION).expect("valid");
        let config = Nameplate::default().config(&CONFIG).expect("complete");
        let commission = Commission::new(&config).expect("valid");
        Self { supervisor, commission, sample: REST, conditions: GOOD }
    }

    /// At the first period of a mode, or of outputs on in it.
    fn reached(mode: Mode) -> Self {
        let mut bench = Self::new();
        match mode {
            Mode::Boot => {}
            Mode::Calibrating => {
                bench.conditions.current_sensors = CurrentSensors::Learning;
                bench.play(A_TURN);
            }
            Mode::Ready => bench.play(A_TURN),
            Mode::Armed => {
                bench = Self::reached(Mode::Ready);
                bench.command(Command::Arm).expect("ready");
            }
            Mode::Running => {
                bench = Self::reached(Mode::Armed);
                bench.play(CHARGED);
            }
            Mode::Stopping => {
                bench = Self::reached(Mode::Running);
                bench.sample.speed = 10.0;
                bench.command(Command::Stop).expect("running");
            }
            Mode::Faulted => {
                bench = Self::reached(Mode::Running);
                bench.supervisor.latch(Fault::Overrun);
            }
            // Until outputs are on.
            Mode::Commissioning => {
                bench = Self::reached(Mode::Ready);
                bench.supervisor.start_commissioning().expect("ready");
                assert_eq!(bench.supervisor.mode(), Mode::Armed);
                while !matches!(bench.step(), Output::Duty(_)) {
                    let _ = bench.command(Command::KeepAlive);
                }
            }
        }
        assert_eq!(bench.supervisor.mode(), mode);
        bench
    }

    fn command(&mut self, command: Command) -> Result<(), Refusal> {
        self.supervisor.command(command)
    }

    fn step(&mut self) -> Output<f32> {
        let sample = Sample::Exact(self.sample);
        self.supervisor.step(&sample, &self.conditions);
        self.supervisor.measure(&sample, &mut self.commission)
    }

    fn play(&mut self, periods: u32) {
        for _ in 0..periods {
            self.step();
        }
    }

    /// Plays until there is a fault; gives the time that it took (s).
    fn time_to(&mut self, fault: Fault) -> f32 {
        for period in 0..200_000 {
            let output = self.step();
            if self.supervisor.faults().contains(fault) {
                assert_eq!(output, Output::Off, "{fault}");
                assert_eq!(self.supervisor.mode(), Mode::Faulted);
                return period as f32 / RATE;
            }
            if period % 1000 == 0 {
                let _ = self.command(Command::KeepAlive);
            }
        }
        unreachable!("no {fault}, but {:?}", self.supervisor.faults());
    }
}

const MODES: [Mode; 8] = [
    Mode::Boot,
    Mode::Calibrating,
    Mode::Ready,
    Mode::Armed,
    Mode::Running,
    Mode::Stopping,
    Mode::Faulted,
    Mode::Commissioning,
];

/// Makes an event happen.
fn provoke(bench: &mut Bench, event: Event) {
    let command = |bench: &mut Bench, command| bench.command(command).expect("taken");
    match event {
        Event::Period => {
            bench.conditions.current_sensors = CurrentSensors::Learning;
            bench.play(A_TURN);
        }
        Event::ZeroLearnt => {
            bench.conditions.current_sensors = CurrentSensors::Good;
            bench.play(A_TURN);
        }
        Event::Charged => bench.play(CHARGED),
        Event::Commission => bench.supervisor.start_commissioning().expect("ready"),
        Event::ChargedToMeasure => {
            *bench = Bench::reached(Mode::Ready);
            bench.supervisor.start_commissioning().expect("ready");
            bench.play(CHARGED);
        }
        Event::Measured => {
            bench.commission.abort();
            bench.play(1);
        }
        Event::Stopped => {
            bench.sample.speed = 1.0;
            bench.play(A_TURN);
        }
        Event::Fault => bench.supervisor.latch(Fault::SelfTest),
        Event::Arm => command(bench, Command::Arm),
        Event::Stop => command(bench, Command::Stop),
        Event::Off => command(bench, Command::Off),
        Event::Clear => command(bench, Command::Clear),
    }
}

#[test]
fn each_transition_happens_by_what_makes_it() {
    for (from, event, to) in TRANSITIONS {
        let mut bench = Bench::reached(from);
        provoke(&mut bench, event);
        assert_eq!(bench.supervisor.mode(), to, "{from:?} by {event:?}");
        let output = bench.step();
        // Commissioning begins with outputs off.
        let is_on = matches!(to, Mode::Armed | Mode::Running | Mode::Stopping);
        assert_eq!(output != Output::Off, is_on, "{from:?} by {event:?}: {output:?}");
    }
}

#[test]
fn commands_that_are_in_no_transition_are_refused_and_change_nothing() {
    for mode in MODES {
        for (event, command) in [
            (Event::Arm, Command::Arm),
            (Event::Stop, Command::Stop),
            (Event::Off, Command::Off),
            (Event::Clear, Command::Clear),
        ] {
            if TRANSITIONS.iter().any(|(from, by, _)| (*from, *by) == (mode, event)) {
                continue;
            }
            let mut bench = Bench::reached(mode);
            assert_eq!(bench.command(command), Err(Refusal::Mode(mode)));
            assert_eq!(bench.supervisor.mode(), mode, "by {command:?}");
        }
    }
}

#[test]
fn a_speed_is_taken_while_armed_and_within_its_limit_only() {
    for mode in MODES {
        let mut bench = Bench::reached(mode);
        let taken = bench.command(Command::Speed(10.0)).is_ok();
        assert_eq!(taken, matches!(mode, Mode::Armed | Mode::Running), "{mode:?}");
    }
    let mut bench = Bench::reached(Mode::Running);
    for speed in [f32::NAN, f32::INFINITY, 401.0, -401.0] {
        assert_eq!(bench.command(Command::Speed(speed)), Err(Refusal::SpeedOutOfRange));
    }
}

#[test]
fn a_speed_of_an_earlier_run_is_forgotten() {
    let mut bench = Bench::reached(Mode::Running);
    bench.command(Command::Speed(100.0)).expect("running");
    bench.play(1);
    bench.command(Command::Off).expect("running");
    bench.play(A_TURN);
    bench.command(Command::Arm).expect("ready");
    bench.play(CHARGED);
    assert_eq!(bench.step(), Output::Duty(0.0));
}

#[test]
fn bootstraps_are_charged_before_the_motor_is_driven() {
    let mut bench = Bench::reached(Mode::Armed);
    let charging = (0..CHARGED).take_while(|_| bench.step() == Output::Charge).count();
    // Ten times the 2 ms that 40 charges of a time constant each take.
    assert!(charging as f32 / RATE > 0.02, "{charging} periods");
    assert!(matches!(bench.step(), Output::Duty(_)));
}

#[test]
fn a_bus_or_current_beyond_its_limits_ends_the_charging_in_the_same_period() {
    for (sample, fault) in [
        (Exact { current: 21.0, ..REST }, Fault::Overcurrent),
        (Exact { bus_voltage: 7.0, ..REST }, Fault::BusUndervoltage),
        (Exact { bus_voltage: 29.0, ..REST }, Fault::BusOvervoltage),
    ] {
        let mut bench = Bench::reached(Mode::Armed);
        assert_eq!(bench.step(), Output::Charge);
        bench.sample = sample;
        assert_eq!(bench.time_to(fault), 0.0);
    }
}

#[test]
fn faults_of_the_drive_and_of_the_hardware_switch_off_in_the_same_period() {
    let nan = Exact { current: f32::NAN, ..REST };
    let samples = [
        (Exact { current: 21.0, ..REST }, Fault::Overcurrent),
        (Exact { bus_voltage: 7.0, ..REST }, Fault::BusUndervoltage),
        (Exact { bus_voltage: 29.0, ..REST }, Fault::BusOvervoltage),
        (Exact { speed: 401.0, ..REST }, Fault::Overspeed),
        (Exact { advance: 1.0, ..REST }, Fault::EncoderJump),
        (nan, Fault::BadSample),
    ];
    for mode in [Mode::Running, Mode::Stopping, Mode::Commissioning] {
        for (sample, fault) in samples {
            // Not by the drive's own limits of the shaft, but by those that commissioning has.
            if mode == Mode::Commissioning && matches!(fault, Fault::Overspeed | Fault::EncoderJump)
            {
                continue;
            }
            let mut bench = Bench::reached(mode);
            bench.sample = sample;
            assert_eq!(bench.time_to(fault), 0.0);
        }
        for (conditions, fault) in [
            (Conditions { tripped: true, ..GOOD }, Fault::HardwareTrip),
            (Conditions { overrun: true, ..GOOD }, Fault::Overrun),
            (
                Conditions { current_sensors: CurrentSensors::Disagree, ..GOOD },
                Fault::CurrentSensors,
            ),
        ] {
            let mut bench = Bench::reached(mode);
            bench.conditions = conditions;
            assert_eq!(bench.time_to(fault), 0.0);
        }
    }
}

#[test]
fn what_the_board_finds_switches_off_within_a_turn_in_every_mode() {
    for mode in MODES.into_iter().filter(|mode| *mode != Mode::Faulted) {
        for (conditions, fault) in [
            (Conditions { temperature: 80.5, ..GOOD }, Fault::Overtemperature),
            (Conditions { temperature: -46.0, ..GOOD }, Fault::TemperatureSensor),
            (Conditions { temperature: 161.0, ..GOOD }, Fault::TemperatureSensor),
            (Conditions { temperature: f32::NAN, ..GOOD }, Fault::TemperatureSensor),
            (Conditions { current_sensors: CurrentSensors::BadZero, ..GOOD }, Fault::CurrentZero),
        ] {
            let mut bench = Bench::reached(mode);
            bench.conditions = conditions;
            assert!(bench.time_to(fault) <= A_TURN as f32 / RATE);
            assert_eq!(bench.supervisor.faults().iter().count(), 1, "{fault} and others");
        }
    }
}

#[test]
fn a_current_trips_after_the_time_that_heat_takes_and_a_lesser_one_never() {
    for current in [4.2_f32, 5.0, 8.0, -8.0] {
        let mut bench = Bench::reached(Mode::Running);
        bench.sample.current = current;
        let square = current * current;
        let expected = PROTECTION.thermal_time * (square / (square - 16.0)).ln();
        // Two turns of 3.2 ms, and the step response of a first-order lag in steps of a turn: a sixtieth.
        let error = (bench.time_to(Fault::Overload) - expected).abs();
        assert!(error < 0.0064 + expected / 60.0, "{current} A: {error} s from {expected} s");
    }
    // Commissioning warms the motor as driving does.
    let mut bench = Bench::reached(Mode::Commissioning);
    bench.sample.current = 8.0;
    assert!(bench.time_to(Fault::Overload) < 0.07);
    let mut bench = Bench::reached(Mode::Running);
    bench.sample.current = 3.95;
    let mut warm = false;
    for _ in 0..40 {
        bench.play(1000);
        bench.command(Command::KeepAlive).expect("always");
        warm |= bench.supervisor.limits().contains(ActiveLimit::Heat);
    }
    assert_eq!(bench.supervisor.mode(), Mode::Running);
    assert!(warm);
}

#[test]
fn an_overload_cannot_be_cleared_away() {
    let mut bench = Bench::reached(Mode::Running);
    bench.sample.current = 10.0;
    bench.time_to(Fault::Overload);
    bench.sample.current = 0.0;
    // It comes again until the motor is just below the limit: ready, but with no reserve.
    let mut clears = 0;
    while bench.supervisor.mode() != Mode::Ready {
        let _ = bench.command(Command::Clear);
        bench.play(A_TURN);
        clears += 1;
    }
    assert!(clears > 1);
    bench.command(Command::Arm).expect("ready");
    bench.play(CHARGED);
    bench.sample.current = 10.0;
    let again = bench.time_to(Fault::Overload);
    let mut cold = Bench::reached(Mode::Running);
    cold.sample.current = 10.0;
    let first = cold.time_to(Fault::Overload);
    assert!(again < 0.8 * first, "{again} s after {first} s");
}

#[test]
fn lost_commands_stop_the_motor_and_are_a_fault() {
    let mut bench = Bench::reached(Mode::Running);
    bench.sample.speed = 50.0;
    let mut modes = vec![bench.supervisor.mode()];
    let mut last_on = 0;
    for period in 0..20_000 {
        if bench.step() != Output::Off {
            last_on = period;
        }
        if modes.last() != Some(&bench.supervisor.mode()) {
            modes.push(bench.supervisor.mode());
        }
    }
    assert_eq!(modes, [Mode::Running, Mode::Stopping, Mode::Faulted]);
    assert_eq!(bench.supervisor.faults().iter().collect::<Vec<_>>(), [Fault::CommandLost]);
    // The timeout, less what it took to get here; the time for stopping, since this shaft never stops; and a turn for each.
    let time = last_on as f32 / RATE;
    assert!((0.36..0.41).contains(&time), "{time} s");
}

#[test]
fn any_command_is_a_sign_of_life() {
    for command in [Command::KeepAlive, Command::Speed(0.0), Command::Speed(f32::NAN)] {
        let mut bench = Bench::reached(Mode::Running);
        for _ in 0..10 {
            bench.play(1200);
            let _ = bench.command(command);
        }
        assert_eq!(bench.supervisor.mode(), Mode::Running, "{command:?}");
    }
    let mut bench = Bench::reached(Mode::Armed);
    bench.play(100);
    for _ in 0..40 {
        bench.play(100);
        let _ = bench.command(Command::KeepAlive);
    }
    assert_eq!(bench.supervisor.mode(), Mode::Running);
}

#[test]
fn stopping_ends_at_a_standstill_or_when_its_time_is_over() {
    let mut bench = Bench::reached(Mode::Stopping);
    bench.play(1000);
    assert_eq!(bench.supervisor.mode(), Mode::Stopping);
    assert!(bench.supervisor.limits().contains(ActiveLimit::Stopping));
    bench.sample.speed = -1.9;
    bench.play(A_TURN);
    assert_eq!(bench.supervisor.mode(), Mode::Ready);
    let mut bench = Bench::reached(Mode::Stopping);
    bench.play((0.29 * RATE) as u32);
    assert_eq!(bench.supervisor.mode(), Mode::Stopping);
    bench.play((0.02 * RATE) as u32);
    assert_eq!(bench.supervisor.mode(), Mode::Ready);
}

#[test]
fn limits_are_shown_while_they_are_active() {
    let mut bench = Bench::reached(Mode::Running);
    bench.play(A_TURN);
    assert_eq!(bench.supervisor.limits().iter().count(), 0);
    bench.sample.current = 9.6;
    bench.conditions.temperature = 70.5;
    bench.play(A_TURN);
    let limits = bench.supervisor.limits();
    for limit in [ActiveLimit::Current, ActiveLimit::Temperature] {
        assert!(limits.contains(limit), "{limit}");
    }
    bench.sample.current = 0.0;
    bench.conditions.temperature = 69.0;
    // The back-EMF is 22.4 V, and the bus has 0.9·24 V for it.
    bench.sample.speed = 380.0;
    bench.command(Command::Speed(390.0)).expect("running");
    bench.play(A_TURN);
    assert!(bench.supervisor.limits().contains(ActiveLimit::Duty));
    assert!(!bench.supervisor.limits().contains(ActiveLimit::Temperature));
}

#[test]
fn an_overrun_with_outputs_off_is_no_fault() {
    let mut bench = Bench::reached(Mode::Ready);
    bench.conditions.overrun = true;
    bench.play(A_TURN);
    assert_eq!(bench.supervisor.mode(), Mode::Ready);
}

#[test]
fn heat_and_faults_outlive_a_change_of_parameters() {
    let mut bench = Bench::reached(Mode::Running);
    bench.sample.current = 10.0;
    bench.time_to(Fault::Overload);
    let mut next = Bench::new();
    next.supervisor.succeed(&bench.supervisor);
    assert_eq!(next.supervisor.mode(), Mode::Faulted);
    next.command(Command::Clear).expect("a fault");
    assert_eq!(next.time_to(Fault::Overload), (A_TURN - 1) as f32 / RATE);
}

#[test]
fn a_fault_from_the_start_needs_to_be_cleared() {
    for fault in [Fault::WatchdogReset, Fault::BadParameters, Fault::SelfTest] {
        let mut bench = Bench::new();
        bench.supervisor.latch(fault);
        bench.play(1000);
        assert_eq!(bench.command(Command::Arm), Err(Refusal::Mode(Mode::Faulted)));
        assert_eq!(bench.supervisor.faults().iter().collect::<Vec<_>>(), [fault]);
        bench.command(Command::Clear).expect("a fault");
        bench.play(A_TURN);
        assert_eq!(bench.supervisor.mode(), Mode::Ready);
    }
}

#[test]
fn refusals_name_the_field() {
    let nan = f32::NAN;
    let cases = [
        (Protection { continuous_current: 0.0, ..PROTECTION }, "protection.continuous_current"),
        (Protection { continuous_current: 20.1, ..PROTECTION }, "protection.continuous_current"),
        (Protection { thermal_time: 0.003, ..PROTECTION }, "protection.thermal_time"),
        (Protection { thermal_time: nan, ..PROTECTION }, "protection.thermal_time"),
        (Protection { temperature: 120.1, ..PROTECTION }, "protection.temperature"),
        (Protection { temperature: nan, ..PROTECTION }, "protection.temperature"),
        (Protection { command_timeout: 0.0, ..PROTECTION }, "protection.command_timeout"),
        (Protection { command_timeout: nan, ..PROTECTION }, "protection.command_timeout"),
        (Protection { stop_time: 61.0, ..PROTECTION }, "protection.stop_time"),
        (Protection { standstill: 0.0, ..PROTECTION }, "protection.standstill"),
    ];
    for (protection, field) in cases {
        let error = Supervisor::<f32>::new(&CONFIG, &protection).expect_err(field);
        assert_eq!(error.field, field, "{protection:?}");
    }
}

/// A supervised drive on a simulated motor, which its parameters describe wrongly.
struct Motor {
    supervisor: Supervisor<f32>,
    commission: Commission,
    board: SimulatedBoard<f32>,
    conditions: Conditions,
}

impl Motor {
    /// As commissioning starts.
    fn commissioned(bench: &MotorBench, nameplate: &Nameplate) -> Self {
        let mut parameters = bench.scenario.parameters();
        parameters.drive.motor.inertia *= 5.0;
        parameters.drive.motor.back_emf_constant *= 0.3;
        parameters.drive.motor.resistance *= 4.0;
        parameters.protection.command_timeout = 0.2;
        let config = nameplate.config(&parameters.drive).expect("complete");
        let supervisor = Supervisor::new(&parameters.drive, &parameters.protection);
        let supervisor: Supervisor<f32> = supervisor.expect("valid");
        let mut motor = Self {
            board: SimulatedBoard::new(&bench.scenario, *supervisor.drive().bases()),
            supervisor,
            commission: Commission::new(&config).expect("valid"),
            conditions: GOOD,
        };
        motor.play(2 * A_TURN);
        motor.supervisor.start_commissioning().expect("ready");
        motor
    }

    fn paper() -> Self {
        let bench = MotorBench::machine(&Machine::PAPER, 4096);
        Self::commissioned(&bench, &Nameplate::default())
    }

    fn step(&mut self) -> Output<f32> {
        let sample = self.board.sample();
        self.supervisor.step(&sample, &self.conditions);
        let output = self.supervisor.measure(&sample, &mut self.commission);
        self.board.apply(match output {
            Output::Duty(duty) => BridgeCommand::Duty(duty),
            Output::Off | Output::Charge => BridgeCommand::Off,
        });
        output
    }

    fn play(&mut self, periods: u32) {
        for _ in 0..periods {
            self.step();
        }
    }

    /// Plays, with the host there, until outputs are on in a phase (they are off in the first) or it is over.
    fn reach(&mut self, phase: Phase) {
        for period in 0..400_000 {
            let output = self.step();
            let is_on = phase == Phase::Rest || matches!(output, Output::Duty(duty) if duty != 0.0);
            let begun = self.supervisor.mode() == Mode::Commissioning;
            if self.commission.phase() == phase && (phase == Phase::Over || begun && is_on) {
                return;
            }
            if period % 1000 == 0 {
                let _ = self.supervisor.command(Command::KeepAlive);
            }
        }
        unreachable!("no {phase:?}, but {:?}", self.commission.findings());
    }

    #[track_caller]
    fn assert_off(&mut self, mode: Mode) {
        assert_eq!(self.supervisor.mode(), mode);
        for _ in 0..5000 {
            assert_eq!(self.step(), Output::Off);
        }
        assert_eq!(self.supervisor.mode(), mode);
    }
}

const PHASES: [Phase; 6] =
    [Phase::Rest, Phase::Pulses, Phase::Launch, Phase::Trial, Phase::Short, Phase::Long];

#[test]
fn a_motor_is_measured_with_a_wrong_model_in_force() {
    let mut motor = Motor::paper();
    motor.reach(Phase::Over);
    let findings = motor.commission.findings();
    assert_eq!((findings.stopped, motor.supervisor.faults()), (None, Faults::NONE));
    let truth = MotorParameters::PAPER;
    for (found, truth) in [
        (findings.resistance, truth.resistance),
        (findings.back_emf_constant, truth.back_emf_constant),
        (findings.inertia, truth.inertia),
    ] {
        let value = found.expect("seen").value;
        assert!((value / truth - 1.0).abs() < 0.02, "{value} is not {truth}");
    }
    motor.assert_off(Mode::Ready);
}

#[test]
fn aborted_in_any_phase_outputs_are_off_at_once() {
    for phase in PHASES {
        for command in [Command::Off, Command::Stop] {
            let mut motor = Motor::paper();
            motor.reach(phase);
            motor.supervisor.command(command).expect("commissioning");
            motor.assert_off(Mode::Ready);
            assert_eq!(motor.commission.phase(), phase, "goes no further");
        }
    }
    // Before it has begun.
    let mut motor = Motor::paper();
    assert_eq!(motor.step(), Output::Charge);
    motor.supervisor.command(Command::Off).expect("armed");
    motor.assert_off(Mode::Ready);
    // And an armed drive drives afterwards.
    motor.supervisor.command(Command::Arm).expect("ready");
    while motor.supervisor.mode() == Mode::Armed {
        motor.step();
    }
    assert_eq!(motor.supervisor.mode(), Mode::Running);
}

#[test]
fn faults_end_commissioning_in_any_phase() {
    type Provoke = fn(&mut Motor);
    let cases: [(Provoke, Fault); 5] = [
        (|motor| motor.conditions.tripped = true, Fault::HardwareTrip),
        (|motor| motor.conditions.temperature = 150.0, Fault::Overtemperature),
        (
            |motor| motor.conditions.current_sensors = CurrentSensors::Disagree,
            Fault::CurrentSensors,
        ),
        (|motor| motor.supervisor.latch(Fault::SelfTest), Fault::SelfTest),
        (|_| {}, Fault::CommandLost),
    ];
    for phase in PHASES {
        for (provoke, fault) in cases {
            let mut motor = Motor::paper();
            motor.reach(phase);
            provoke(&mut motor);
            // The longest is the timeout, 0.2 s.
            let mut periods = 0;
            while motor.supervisor.mode() != Mode::Faulted && periods < 5000 {
                motor.step();
                periods += 1;
            }
            assert!(motor.supervisor.faults().contains(fault), "{phase:?}, {fault}");
            let slow = if fault == Fault::CommandLost { 4200 } else { A_TURN };
            assert!(periods <= slow, "{phase:?}, {fault}: {periods}");
            motor.assert_off(Mode::Faulted);
            assert_eq!(motor.supervisor.start_commissioning(), Err(Refusal::Mode(Mode::Faulted)));
        }
    }
}

#[test]
fn without_what_measures_outputs_stay_off() {
    let mut motor = Motor::paper();
    motor.reach(Phase::Long);
    let sample = motor.board.sample();
    for _ in 0..3 {
        assert_eq!(motor.supervisor.step(&sample, &GOOD), Output::Off);
    }
    motor.supervisor.command(Command::Off).expect("commissioning");
    assert_eq!(motor.supervisor.mode(), Mode::Ready);
}

#[test]
fn a_blocked_rotor_ends_it_without_a_fault() {
    let mut bench = MotorBench::machine(&Machine::PAPER, 4096);
    bench.scenario.motor.inertia *= 1e5;
    let mut motor = Motor::commissioned(&bench, &Nameplate::default());
    motor.reach(Phase::Over);
    let findings = motor.commission.findings();
    assert_eq!(findings.inertia, Err(Reason::Blocked));
    assert!(findings.resistance.is_ok());
    motor.assert_off(Mode::Ready);
}

#[test]
fn a_nameplates_limits_hold() {
    let bench = MotorBench::machine(&Machine::PAPER, 4096);
    let [current, speed, travel, voltage] = [4.0, 120.0, 20.0, 6.0];
    let nameplate = Nameplate {
        voltage: Some(voltage),
        no_load_speed: Some(voltage / 59e-3 * 0.97),
        counts_per_turn: None,
        current: Some(current),
        speed: Some(speed),
        travel: Some(travel),
    };
    let mut motor = Motor::commissioned(&bench, &nameplate);
    let mut angle = 0.0_f64;
    let mut largest = [0.0_f64; 4];
    while motor.commission.phase() != Phase::Over {
        let output = motor.step();
        let state = motor.board.state();
        angle += state.speed / f64::from(RATE);
        let duty = if let Output::Duty(duty) = output { f64::from(duty) } else { 0.0 };
        let reached = [state.current, state.speed, angle, duty * bench.scenario.bus.voltage];
        for (largest, reached) in largest.iter_mut().zip(reached) {
            *largest = largest.max(reached.abs());
        }
        let _ = motor.supervisor.command(Command::KeepAlive);
    }
    assert_eq!(motor.commission.findings().stopped, None);
    // A code of the converter's noise on what the bus voltage is.
    for (largest, limit) in largest.into_iter().zip([current, speed, travel, 1.002 * voltage]) {
        assert!(largest <= f64::from(limit), "{largest} of {limit}");
    }
    assert!(largest[3] > 0.5 * f64::from(voltage));
    let no_voltage = Nameplate { voltage: None, ..nameplate };
    let error = no_voltage.config(&CONFIG).expect_err("half a nameplate");
    assert_eq!(error.field, "no_load.voltage");
    let counts = Nameplate { counts_per_turn: Some(-500), ..nameplate };
    let drive = bench.scenario.drive_config();
    let Sensors::Codes(calibration) = counts.config(&drive).expect("complete").sensors else {
        unreachable!("a bench has codes")
    };
    assert_eq!(calibration.counts_per_turn, -500);
    let beyond = Nameplate { current: Some(1.1 * drive.limits.current), ..nameplate };
    let error = Commission::new(&beyond.config(&drive).expect("complete")).expect_err("too much");
    assert_eq!(error.field, "limits.current_command");
}

/// What may happen to a supervisor.
#[derive(Clone, Debug)]
enum Happening {
    Command(Command),
    Commission,
    Latch(Fault),
    Periods(u32, Sample<f32>, Conditions),
}

fn any_number() -> impl Strategy<Value = f32> {
    prop_oneof![
        4 => Just(0.0_f32),
        2 => -30.0_f32..30.0,
        1 => any::<f32>(),
        1 => Just(f32::NAN),
    ]
}

fn happening() -> impl Strategy<Value = Happening> {
    let command = prop_oneof![
        4 => Just(Command::Arm),
        4 => any_number().prop_map(Command::Speed),
        1 => Just(Command::KeepAlive),
        1 => Just(Command::Stop),
        1 => Just(Command::Off),
        4 => Just(Command::Clear),
    ];
    let exact = (any_number(), any_number(), any_number()).prop_map(|(speed, current, more)| {
        let bus_voltage = 24.0 + more;
        Sample::Exact(Exact { speed, advance: speed * 5e-5, current, bus_voltage })
    });
    let codes = Sample::Codes(Codes { current: 1, bus_voltage: 2, encoder: [3; READS], shift: 4 });
    let sample = prop_oneof![8 => Just(Sample::Exact(REST)), 4 => exact, 1 => Just(codes)];
    let sensors = prop_oneof![
        1 => Just(CurrentSensors::Learning),
        8 => Just(CurrentSensors::Good),
        1 => Just(CurrentSensors::BadZero),
        1 => Just(CurrentSensors::Disagree),
    ];
    let conditions =
        (any_number(), sensors, prop::bool::weighted(0.05), prop::bool::weighted(0.05)).prop_map(
            |(temperature, current_sensors, tripped, overrun)| Conditions {
                temperature,
                current_sensors,
                tripped,
                overrun,
            },
        );
    let periods = prop_oneof![Just(1_u32), 1_u32..700];
    prop_oneof![
        4 => command.prop_map(Happening::Command),
        1 => Just(Happening::Commission),
        1 => prop::sample::select(&Fault::ALL[..]).prop_map(Happening::Latch),
        6 => (periods, sample, conditions)
            .prop_map(|(periods, sample, conditions)| Happening::Periods(periods, sample, conditions)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn outputs_are_off_unless_armed_and_without_fault(
        happenings in prop::collection::vec(happening(), 1..40),
    ) {
        let Bench { mut supervisor, commission: fresh, .. } = Bench::new();
        let mut commission = fresh.clone();
        // Kept beside it: whether it was armed since outputs last had to go off.
        let mut armed = false;
        let mut latched = Faults::NONE;
        for happening in happenings {
            match happening {
                Happening::Command(command) => {
                    let taken = supervisor.command(command).is_ok();
                    match command {
                        Command::Arm if taken => armed = true,
                        Command::Off if taken => armed = false,
                        Command::Clear if taken => latched = Faults::NONE,
                        _ => {}
                    }
                    prop_assert!(!(armed && taken && command == Command::Arm && !latched.is_empty()));
                }
                Happening::Commission => {
                    if supervisor.start_commissioning().is_ok() {
                        prop_assert!(latched.is_empty());
                        commission = fresh.clone();
                        armed = true;
                    }
                }
                Happening::Latch(fault) => {
                    supervisor.latch(fault);
                    latched.latch(fault);
                }
                Happening::Periods(periods, sample, conditions) => {
                    for _ in 0..periods {
                        let was_on = supervisor.output() != Output::Off;
                        supervisor.step(&sample, &conditions);
                        let output = supervisor.measure(&sample, &mut commission);
                        if conditions.tripped {
                            latched.latch(Fault::HardwareTrip);
                        }
                        if conditions.overrun && was_on {
                            latched.latch(Fault::Overrun);
                        }
                        let faults = supervisor.faults();
                        prop_assert_eq!(faults.0 & latched.0, latched.0, "a fault was lost");
                        latched = faults;
                        if !faults.is_empty() {
                            armed = false;
                        }
                        match output {
                            Output::Off => {}
                            Output::Charge => prop_assert!(armed),
                            Output::Duty(duty) => prop_assert!(armed && duty.abs() <= 0.9, "{duty}"),
                        }
                        if !faults.is_empty() {
                            prop_assert_eq!(supervisor.mode(), Mode::Faulted);
                        }
                    }
                }
            }
        }
    }
}
