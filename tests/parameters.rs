//! Parameters in a flash: what survives a power failure, damage, and other versions of the firmware.

use host_sim::flash::{FlashError, SimulatedFlash, Tear};
use quasidrive::control::drive_form::DriveFormConfig;
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::pi::PiConfig;
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::{DriveConfig, Limits};
use quasidrive::estimate::SpeedSource;
use quasidrive::motor::MotorParameters;
use quasidrive::parameters::Parameters;
use quasidrive::parameters::store::{Loaded, Origin, ParameterStore, SaveError};
use quasidrive::sense::{Calibration, Reads, Sensors};
use quasidrive::supervisor::Protection;
use quasidrive::trajectory::Shape;
use std::ops::Range;

/// The last four pages.
const REGION: Range<u32> = 0x1_e000..0x2_0000;

fn parameters() -> Parameters {
    let calibration = Calibration {
        current_per_code: -0.029,
        current_zero: 2047.5,
        bus_voltage_per_code: 0.008,
        counts_per_turn: -4096,
        highest_code: 4095,
        reads: Reads::Shifted,
    };
    Parameters {
        drive: DriveConfig {
            motor: MotorParameters::PAPER,
            sensors: Sensors::Codes(calibration),
            control: ControlConfig::Drive(DriveFormConfig::new(1170.0, 0.3, 2.5)),
            timing: Timing { rate: 20_000.0, delay: true },
            limits: Limits {
                duty: 0.9,
                speed: 400.0,
                current: 30.0,
                current_command: 20.0,
                bus_min: 9.0,
                bus_max: 27.0,
            },
            shape: Shape::SecondOrder { bandwidth: 60.0 },
        },
        protection: Protection {
            continuous_current: 10.0,
            thermal_time: 20.0,
            temperature: 85.0,
            command_timeout: 1.0,
            stop_time: 3.0,
            standstill: 2.0,
        },
    }
}

/// A set that differs from the others in every number that changes with `number`.
fn numbered(number: u16) -> Parameters {
    let mut set = parameters();
    let value = f32::from(number);
    set.drive.motor.inertia = value;
    set.drive.limits.speed = value;
    set.protection.command_timeout = value;
    set
}

fn store(flash: &mut SimulatedFlash) -> ParameterStore<&mut SimulatedFlash> {
    ParameterStore::new(flash, REGION).expect("a good region")
}

fn load(flash: &mut SimulatedFlash) -> Loaded {
    store(flash).load(&parameters())
}

#[test]
fn a_set_is_loaded_as_it_was_saved() {
    let mut flash = SimulatedFlash::new();
    assert_eq!(load(&mut flash).origin, Origin::NeverSaved);
    assert_eq!(load(&mut flash).parameters, parameters());
    // Often enough to use every page several times.
    for number in 1..40 {
        store(&mut flash).save(&numbered(number)).expect("saved");
        let expected = Loaded { parameters: numbered(number), origin: Origin::Saved };
        assert_eq!(load(&mut flash), expected);
    }
    let (before, after) = flash.memory().split_at(REGION.start as usize);
    assert!(before.iter().all(|byte| *byte == 0xff), "only the region is used");
    assert!(after.iter().any(|byte| *byte != 0xff));
}

#[test]
fn every_controller_and_shape_survives() {
    let timing = Timing { rate: 20_000.0, delay: true };
    let pi = PiConfig::magnitude_and_symmetrical_optimum(&timing, SpeedSource::Exact);
    let ladrc = LadrcConfig::by_bandwidth(150.0, &timing, SpeedSource::Exact);
    let controls = [
        ControlConfig::Paper(PaperConfig {
            law: Law::Qismc,
            gains: Gains::PAPER,
            form: Form::Explicit,
            start: Start::Matched,
            speed: SpeedSource::Pll { bandwidth: 1e3, fed: true },
        }),
        ControlConfig::Pi(PiConfig { disturbance: Some(300.0), ..pi }),
        ControlConfig::Pi(PiConfig { disturbance: None, ..pi }),
        ControlConfig::Ladrc(ladrc),
        ControlConfig::Ladrc(LadrcConfig {
            speed: SpeedSource::Difference { bandwidth: 9.0 },
            ..ladrc
        }),
    ];
    let shapes = [Shape::Step, Shape::SCurve { acceleration: 1e3, jerk: 1e5 }];
    for control in controls {
        for shape in shapes {
            let mut set = parameters();
            set.drive.control = control;
            set.drive.shape = shape;
            set.drive.sensors = Sensors::Exact;
            let mut flash = SimulatedFlash::new();
            store(&mut flash).save(&set).expect("saved");
            assert_eq!(load(&mut flash), Loaded { parameters: set, origin: Origin::Saved });
        }
    }
}

/// Asserts that a flash holds set `old`, zero for none, or `new`; gives which.
fn assert_old_or_new(flash: &mut SimulatedFlash, old: u16, new: u16, context: &str) -> u16 {
    let loaded = load(flash);
    let (before, after) = match old {
        0 => (Loaded { parameters: parameters(), origin: Origin::NeverSaved }, numbered(new)),
        old => (Loaded { parameters: numbered(old), origin: Origin::Saved }, numbered(new)),
    };
    if loaded == before {
        old
    } else {
        assert_eq!(loaded, Loaded { parameters: after, origin: Origin::Saved }, "{context}");
        new
    }
}

#[test]
fn a_power_failure_leaves_the_old_set_or_the_new_one() {
    let mut flash = SimulatedFlash::new();
    let mut failures = 0;
    // The pages are full, and erased, every few saves.
    for number in 1..20 {
        let mut whole = flash.clone();
        store(&mut whole).save(&numbered(number)).expect("saved");
        let operations = whole.operations() - flash.operations();
        for (operation, tear) in
            (0..operations).flat_map(|operation| Tear::ALL.map(|tear| (operation, tear)))
        {
            let context = format!("save {number}, operation {operation}, {tear:?}");
            let mut torn = flash.clone();
            torn.fail_after(operation, tear);
            store(&mut torn).save(&numbered(number)).expect_err("no power");
            failures += 1;
            let mut again = torn.powered_again();
            let left = assert_old_or_new(&mut again, number - 1, number, &context);
            assert_eq!(assert_old_or_new(&mut again, left, left, &context), left, "and stays");
            store(&mut again).save(&numbered(100)).expect("saved after a failure");
            assert_eq!(load(&mut again).parameters, numbered(100), "{context}");
        }
        flash = whole;
    }
    assert!(failures > 5000, "{failures}");
}

#[test]
fn a_second_power_failure_does_no_more_harm() {
    let mut flash = SimulatedFlash::new();
    let mut failures = 0;
    for number in 1..12 {
        let mut whole = flash.clone();
        store(&mut whole).save(&numbered(number)).expect("saved");
        let operations = whole.operations() - flash.operations();
        for tear in Tear::ALL {
            for operation in (0..operations).step_by(5) {
                let mut torn = flash.clone();
                torn.fail_after(operation, tear);
                store(&mut torn).save(&numbered(number)).expect_err("no power");
                let first = torn.powered_again();
                let left = assert_old_or_new(&mut first.clone(), number - 1, number, "first");
                for (later, second_tear) in
                    [(0, Tear::Some), (1, Tear::Middle), (2, Tear::Back), (30, Tear::Front)]
                {
                    let context = format!(
                        "save {number}, {tear:?} at {operation}, then {second_tear:?} at {later}"
                    );
                    let mut second = first.clone();
                    second.fail_after(later, second_tear);
                    // Loading may repair, and so be what is interrupted.
                    let _ = load(&mut second);
                    let saved = store(&mut second).save(&numbered(100));
                    assert_eq!(
                        saved,
                        Err(SaveError::Flash(Some(FlashError::PowerLost))),
                        "{context}"
                    );
                    let mut third = second.powered_again();
                    assert_old_or_new(&mut third, left, 100, &context);
                    store(&mut third).save(&numbered(101)).expect("saved after failures");
                    assert_eq!(load(&mut third).parameters, numbered(101), "{context}");
                    failures += 1;
                }
            }
        }
        flash = whole;
    }
    assert!(failures > 1000, "{failures}");
}

#[test]
fn a_flipped_bit_is_harmless_or_told() {
    let mut flash = SimulatedFlash::new();
    for number in 1..4 {
        store(&mut flash).save(&numbered(number)).expect("saved");
    }
    let mut told = 0;
    for bit in 8 * REGION.start as usize..8 * REGION.end as usize {
        let byte = flash.memory()[bit / 8];
        // Of the erased bytes, some; of the others, all.
        if byte == 0xff && bit % 61 > 0 {
            continue;
        }
        let mut damaged = flash.clone();
        damaged.flip(bit);
        let loaded = load(&mut damaged);
        match loaded.origin {
            Origin::Saved => assert_eq!(loaded.parameters, numbered(3), "bit {bit}"),
            Origin::Unreadable => assert_eq!(loaded.parameters, parameters(), "bit {bit}"),
            Origin::NeverSaved => unreachable!("bit {bit}"),
        }
        told += usize::from(loaded.origin == Origin::Unreadable);
        store(&mut damaged).save(&numbered(4)).expect("saved over it");
        assert_eq!(load(&mut damaged).parameters, numbered(4), "bit {bit}");
    }
    assert!(told > 3000, "{told} bits of the newest set count");
}

#[test]
fn a_worn_out_flash_is_no_success() {
    let mut flash = SimulatedFlash::new();
    store(&mut flash).save(&numbered(1)).expect("saved");
    let mut failures = 0;
    // In the middle of where the second set goes, in the first half.
    for bit in (0..8).map(|bit| 8 * (REGION.start as usize + 100) + bit) {
        let mut worn = flash.clone();
        worn.wear_out(bit);
        let expected = match store(&mut worn).save(&numbered(2)) {
            Ok(()) => numbered(2),
            Err(error) => {
                assert_eq!(error, SaveError::Flash(None));
                failures += 1;
                numbered(1)
            }
        };
        assert_eq!(load(&mut worn), Loaded { parameters: expected, origin: Origin::Saved });
    }
    assert!(failures > 0);
}

#[test]
fn nothing_readable_at_all_is_a_fault() {
    let mut flash = SimulatedFlash::new();
    flash.fail_after(0, Tear::Nothing);
    assert!(store(&mut flash).save(&numbered(1)).is_err());
    assert_eq!(load(&mut flash), Loaded { parameters: parameters(), origin: Origin::Unreadable });
}

#[test]
fn regions_that_cannot_be_halved_into_pages_are_refused() {
    for (start, end) in
        [(0, 0), (0, 0x1000), (0, 0x1800), (0x400, 0x2400), (0x2000, 0x1000), (0, 0x2001)]
    {
        let refused = ParameterStore::new(SimulatedFlash::new(), start..end);
        assert!(refused.is_err(), "{start:#x} to {end:#x}");
    }
    assert!(ParameterStore::new(SimulatedFlash::new(), 0..0x2000).is_ok());
}
