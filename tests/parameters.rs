//! Parameters in a flash: what survives a power failure, damage, and other versions of the firmware.

mod common;

use common::{controls, every_name, names, parameters, with_control};
use host_sim::flash::{FlashError, SimulatedFlash, Tear};
use quasidrive::config::ConfigError;
use quasidrive::control::ControlConfig;
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::pi::PiConfig;
use quasidrive::estimate::SpeedSource;
use quasidrive::link::frame::{LONGEST, encode};
use quasidrive::link::message::{Answer, Message};
use quasidrive::math::Q31;
use quasidrive::parameters::Parameters;
use quasidrive::parameters::records;
use quasidrive::parameters::store::{Loaded, Origin, ParameterStore, SaveError};
use quasidrive::schema::{Content, LONGEST_PATH, Parameter, SetError, Value, Visitor, set};
use quasidrive::sense::Sensors;
use quasidrive::supervisor::Supervisor;
use quasidrive::trajectory::Shape;
use std::collections::BTreeSet;
use std::ops::Range;

/// The last two pages.
const REGION: Range<u32> = 0x1_f000..0x2_0000;

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
    let [.., pi, ladrc] = controls();
    let (ControlConfig::Pi(pi), ControlConfig::Ladrc(ladrc)) = (pi, ladrc) else {
        unreachable!("as they are ordered")
    };
    let speed = SpeedSource::Difference { bandwidth: 9.0 };
    let others = [
        ControlConfig::Pi(PiConfig { disturbance: None, ..pi }),
        ControlConfig::Ladrc(LadrcConfig { speed, ..ladrc }),
    ];
    let shapes = [Shape::Step, Shape::SCurve { acceleration: 1e3, jerk: 1e5 }];
    for control in controls().into_iter().chain(others) {
        for shape in shapes {
            let mut set = with_control(&parameters(), control);
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
    assert!(failures > 4000, "{failures}");
}

#[test]
fn where_reading_fails_after_a_power_failure_there_is_no_set() {
    let mut flash = SimulatedFlash::new();
    flash.check_when_reading();
    for number in 1..5 {
        let mut whole = flash.clone();
        store(&mut whole).save(&numbered(number)).expect("saved");
        for operation in 0..whole.operations() - flash.operations() {
            let context = format!("save {number}, operation {operation}");
            let mut torn = flash.clone();
            torn.fail_after(operation, Tear::Some);
            store(&mut torn).save(&numbered(number)).expect_err("no power");
            let mut again = torn.powered_again();
            let loaded = load(&mut again);
            if number == 1 && loaded.origin == Origin::Unreadable {
                // What was never saved cannot be told from what can no longer be read.
                assert_eq!(loaded.parameters, parameters(), "{context}");
            } else {
                assert_old_or_new(&mut again, number - 1, number, &context);
            }
            store(&mut again).save(&numbered(100)).expect("saved after a failure");
            assert_eq!(load(&mut again).parameters, numbered(100), "{context}");
        }
        flash = whole;
    }
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
                    assert_eq!(saved, Err(SaveError::Flash(FlashError::PowerLost)), "{context}");
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
    assert!(told > 2000, "{told} bits of the newest set count");
}

#[test]
fn what_was_damaged_stays_told_through_an_interrupted_save() {
    let mut flash = SimulatedFlash::new();
    for number in 1..4 {
        store(&mut flash).save(&numbered(number)).expect("saved");
    }
    let newest = 3.0_f32.to_le_bytes();
    let place = flash.memory().windows(4).position(|bytes| bytes == newest).expect("set 3");
    flash.flip(8 * place);
    let unreadable = Loaded { parameters: parameters(), origin: Origin::Unreadable };
    assert_eq!(load(&mut flash), unreadable);
    let mut whole = flash.clone();
    store(&mut whole).save(&numbered(4)).expect("saved");
    let saved = Loaded { parameters: numbered(4), origin: Origin::Saved };
    assert_eq!(load(&mut whole), saved);
    for operation in 0..whole.operations() - flash.operations() {
        for tear in Tear::ALL {
            let mut torn = flash.clone();
            torn.fail_after(operation, tear);
            store(&mut torn).save(&numbered(4)).expect_err("no power");
            let loaded = load(&mut torn.powered_again());
            // In no case the set before the damaged one.
            assert!(loaded == unreadable || loaded == saved, "{operation}, {tear:?}: {loaded:?}");
        }
    }
}

#[test]
fn a_worn_out_flash_is_no_success() {
    let mut flash = SimulatedFlash::new();
    store(&mut flash).save(&numbered(1)).expect("saved");
    let mut failures = 0;
    // In the middle of where the second set goes, in the second slot.
    let middle = (REGION.start + REGION.end) as usize / 2;
    for bit in (0..8).map(|bit| 8 * (middle + 100) + bit) {
        let mut worn = flash.clone();
        worn.wear_out(bit);
        let expected = match store(&mut worn).save(&numbered(2)) {
            Ok(()) => numbered(2),
            Err(error) => {
                assert_eq!(error, SaveError::Worn);
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
        [(0, 0), (0, 0x800), (0, 0x1800), (0x400, 0x1400), (0x2000, 0x1000), (0, 0x1001)]
    {
        let refused = ParameterStore::new(SimulatedFlash::new(), start..end);
        assert!(refused.is_err(), "{start:#x} to {end:#x}");
    }
    assert!(ParameterStore::new(SimulatedFlash::new(), 0..0x1000).is_ok());
}

/// A parameter by itself, at a path of its own.
struct At<'p>(&'static str, &'p mut dyn Parameter);

impl Parameter for At<'_> {
    fn content(&self) -> Content {
        Content::Group
    }

    fn set_content(&mut self, _: Content) -> bool {
        false
    }

    fn visit(&mut self, visitor: &mut Visitor) {
        visitor(self.0, self.1);
    }
}

/// A name that this firmware does not know.
struct Name(&'static [&'static str]);

impl Parameter for Name {
    fn content(&self) -> Content {
        Content::Name(0)
    }

    fn set_content(&mut self, _: Content) -> bool {
        false
    }

    fn names(&self) -> &'static [&'static str] {
        self.0
    }
}

fn record(path: &'static str, parameter: &mut dyn Parameter) -> Vec<u8> {
    let mut bytes = [0; 8];
    assert_eq!(records::write(&mut At(path, parameter), &mut bytes), Some(8));
    bytes.to_vec()
}

/// What is saved: different from the defaults in one number of each kind.
fn saved() -> Parameters {
    let mut saved = parameters();
    saved.drive.motor.inertia = 1e-4;
    saved.drive.limits.duty = 0.5;
    saved.drive.shape = Shape::SCurve { acceleration: 1e3, jerk: 1e5 };
    saved
}

/// A set as another version would have saved it, without the paths that `dropped` tells and with other records; as it is read.
fn migrated(
    set: &Parameters,
    dropped: impl Fn(&str) -> bool,
    others: &[Vec<u8>],
) -> Option<Parameters> {
    let mut bytes = [0; 512];
    let length = records::write(&mut { *set }, &mut bytes).expect("room");
    let mut kept = others.concat();
    let paths = names(*set).into_iter().filter(|(_, value)| value.is_some());
    for ((path, _), record) in paths.zip(bytes[..length].chunks(8)) {
        if !dropped(&path) {
            kept.extend(record);
        }
    }
    let mut read = parameters();
    records::read(&mut read, &kept).then_some(read)
}

#[test]
fn what_is_unknown_is_ignored() {
    let others = [
        record("limits.temperature", &mut 80.0_f32),
        record("brake", &mut Name(&["Chopper"])),
        record("control.limits.duty", &mut 0.1_f32),
    ];
    assert_eq!(migrated(&saved(), |_| false, &others), Some(saved()));
}

#[test]
fn what_is_missing_keeps_its_default() {
    let without = |dropped: &str| migrated(&saved(), |path| path == dropped, &[]);
    let mut expected = saved();
    expected.drive.limits.duty = parameters().drive.limits.duty;
    assert_eq!(without("limits.duty"), Some(expected));
    assert_eq!(migrated(&saved(), |path| path.starts_with("limits"), &[]), Some(expected));
    let mut expected = saved();
    expected.drive.shape = parameters().drive.shape;
    assert_eq!(without("reference"), Some(expected));
    assert_eq!(migrated(&saved(), |_| true, &[]), Some(parameters()), "nothing at all");
}

#[test]
fn what_has_another_kind_keeps_its_default_and_an_unknown_variant_is_unreadable() {
    let instead = |path: &str, other| migrated(&saved(), |dropped| dropped == path, &[other]);
    let mut expected = saved();
    expected.drive.limits.duty = parameters().drive.limits.duty;
    assert_eq!(instead("limits.duty", record("limits.duty", &mut Name(&["high"]))), Some(expected));
    let mut expected = saved();
    expected.drive.shape = parameters().drive.shape;
    let splines = record("reference", &mut Name(&["Splines"]));
    assert_eq!(instead("reference", splines), None);
    assert_eq!(instead("control", record("control", &mut Name(&["Learning"]))), None);
    assert_eq!(instead("reference", record("reference", &mut 1.0_f32)), Some(expected));
}

#[test]
fn a_variants_gains_are_never_completed_from_another_variant() {
    // The default has a bandwidth of the same name, for another controller.
    let [.., ladrc] = controls();
    let ladrc = with_control(&saved(), ladrc);
    assert_eq!(migrated(&ladrc, |_| false, &[]), Some(ladrc));
    let missing = |path: &str| path == "control.observer_bandwidth";
    let read = migrated(&ladrc, missing, &[]).expect("readable");
    let error = Supervisor::<f32>::new(&read.drive, &read.protection).expect_err("not set");
    assert!(error.field == "control.observer_bandwidth" && error.value.is_nan(), "{error}");
}

#[test]
fn numbers_out_of_a_types_range_are_unreadable() {
    let path = "sensors.highest_code";
    let with =
        |mut code: f32| migrated(&saved(), |other| other == path, &[record(path, &mut code)]);
    assert_eq!(with(4095.0), Some(saved()));
    for code in [65_536.0, -1.0, 4095.5, f32::NAN, f32::INFINITY] {
        assert_eq!(with(code), None, "{code}");
    }
}

#[test]
fn names_are_unique_and_have_room() {
    let mut records = BTreeSet::new();
    let mut paths = BTreeSet::new();
    for set in every_name() {
        let mut bytes = [0; 512];
        let length = records::write(&mut { set }, &mut bytes).expect("room");
        assert!(length + 16 <= 344, "what the store's module says of today's sets: {length}");
        for ((path, value), record) in
            names(set).into_iter().filter(|(_, value)| value.is_some()).zip(bytes.chunks(8))
        {
            assert!(path.len() <= LONGEST_PATH, "{path}");
            let kind = matches!(value, Some(Value::Name(_)));
            paths.insert((path, kind));
            records.insert(<[u8; 4]>::try_from(&record[..4]).expect("a key"));
        }
    }
    assert!(paths.len() > 40, "{paths:?}");
    assert_eq!(paths.len(), records.len(), "no two have the same key");
    assert!(!records.contains(&[0; 4]), "which is what pads records");
    assert!(paths.contains(&("control.speed.fed".to_owned(), true)));
}

#[test]
fn values_are_set_by_name_or_refused() {
    let mut changed = parameters();
    let mut change = |name, value| set(&mut changed, name, value);
    for (name, value) in [
        ("limits.duty", Value::Number(0.5)),
        ("sensors.counts_per_turn", Value::Number(-2048.0)),
        ("sensors.reads", Value::Name("Last")),
        ("timing.delay", Value::Name("false")),
        ("control", Value::Name("Pi")),
        ("control.disturbance", Value::Number(300.0)),
        ("control.disturbance", Value::Name("none")),
        ("control.speed", Value::Name("Difference")),
        ("control.speed.bandwidth", Value::Number(900.0)),
    ] {
        assert_eq!(change(name, value), Ok(()), "{name}");
    }
    for (name, value, error) in [
        ("limits.duty", Value::Name("high"), SetError::Unfit),
        ("sensors.counts_per_turn", Value::Number(0.5), SetError::Unfit),
        ("timing.delay", Value::Number(1.0), SetError::Unfit),
        ("control", Value::Name("pi"), SetError::Unfit),
        ("control", Value::Number(2.0), SetError::Unfit),
        ("control.disturbance", Value::Name("some"), SetError::Unfit),
        ("control.load_torque", Value::Number(1.0), SetError::Unknown),
        ("limits", Value::Number(1.0), SetError::Unknown),
        ("limits.dut", Value::Number(1.0), SetError::Unknown),
        ("", Value::Name(""), SetError::Unknown),
    ] {
        assert_eq!(change(name, value), Err(error), "{name}");
    }
    let ControlConfig::Pi(pi) = changed.drive.control else { unreachable!("chosen above") };
    assert_eq!((pi.disturbance, pi.speed), (None, SpeedSource::Difference { bandwidth: 900.0 }));
    assert!(pi.current_bandwidth.is_nan(), "not set");
    assert!(!changed.drive.timing.delay && changed.drive.limits.duty == 0.5);
    // The same variant once more keeps what it holds.
    assert_eq!(set(&mut changed, "control.speed", Value::Name("Difference")), Ok(()));
    let bandwidth = ("control.speed.bandwidth".to_owned(), Some(Value::Number(900.0)));
    assert!(names(changed).contains(&bandwidth));
}

/// The errors that one bad number in a set leads to.
fn errors(set: Parameters) -> Vec<ConfigError> {
    let mut errors = Vec::new();
    for (name, value) in names(set) {
        let Some(Value::Number(number)) = value else { continue };
        for bad in [
            0.0,
            -1.0,
            -number,
            1e-30,
            1e30,
            1e-3 * number,
            0.3 * number,
            3.0 * number,
            1e3 * number,
            1e6,
            1e9 * number,
            f32::NAN,
            f32::INFINITY,
        ] {
            let mut broken = set;
            if quasidrive::schema::set(&mut broken, &name, Value::Number(bad)).is_ok() {
                let Parameters { drive, protection } = broken;
                errors.extend(Supervisor::<f32>::new(&drive, &protection).err());
                errors.extend(Supervisor::<Q31>::new(&drive, &protection).err());
            }
        }
    }
    errors
}

#[test]
fn numbers_that_are_not_set_are_refused() {
    let is_nan = |value| matches!(value, Some(Value::Number(number)) if number.is_nan());
    let is_refused = |Parameters { drive, protection }: &Parameters| {
        let [float, fixed] = [
            Supervisor::<f32>::new(drive, protection).err(),
            Supervisor::<Q31>::new(drive, protection).err(),
        ];
        float.is_some() && fixed.is_some()
    };
    let (mut unset, mut broken) = (0, 0);
    for set in every_name() {
        if names(set).iter().any(|(_, value)| is_nan(*value)) {
            assert!(is_refused(&set), "{set:?}");
            unset += 1;
        }
    }
    for control in controls() {
        let whole = with_control(&parameters(), control);
        for (name, _) in names(whole) {
            let mut set = whole;
            if quasidrive::schema::set(&mut set, &name, Value::Number(f32::NAN)).is_ok() {
                assert!(is_refused(&set), "{name}");
                broken += 1;
            }
        }
    }
    assert!(unset > 5 && broken > 100, "{unset}, {broken}");
}

#[test]
fn errors_name_parameters_and_fit_into_a_frame() {
    let known: BTreeSet<String> =
        every_name().into_iter().flat_map(names).map(|(name, _)| name).collect();
    let mut sets = controls().map(|control| with_control(&parameters(), control)).to_vec();
    for shape in [Shape::Step, Shape::SCurve { acceleration: 1e3, jerk: 1e5 }] {
        let mut set = parameters();
        set.drive.shape = shape;
        sets.push(set);
    }
    let mut blamed = BTreeSet::new();
    for set in sets {
        assert_eq!(Supervisor::<f32>::new(&set.drive, &set.protection).err(), None);
        for error in errors(set) {
            assert!(known.contains(error.field), "{error}");
            let answer = Answer::Refused(error.into());
            let message = Message::Answer { sequence: u16::MAX, answer };
            assert!(encode(&message, &mut [0; LONGEST]).is_some(), "{error}");
            blamed.insert(error.field);
        }
    }
    assert!(blamed.len() > 30, "{blamed:?}");
}
