//! The command line as a user meets it: output, files, exit codes, refusals.

use assert_cmd::Command;
use predicates::prelude::*;
use predicates::str::{contains, starts_with};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn host_sim() -> Command {
    Command::new(env!("CARGO_BIN_EXE_host-sim"))
}

fn scenarios() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios")
}

fn paper() -> PathBuf {
    scenarios().join("paper.toml")
}

/// The paper's scenario with one piece of text replaced.
fn edited(from: &str, to: &str) -> (tempfile::TempDir, PathBuf) {
    let text = std::fs::read_to_string(paper()).expect("shipped");
    assert!(text.contains(from), "{from:?} is not in paper.toml");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("edited.toml");
    std::fs::write(&file, text.replacen(from, to, 1)).expect("written");
    (folder, file)
}

#[test]
fn json_holds_the_metrics_in_si_units() {
    let output = host_sim().arg("run").arg(paper()).arg("--json").output().expect("runs");
    assert!(output.status.success());
    assert!(output.stderr.is_empty(), "no progress bar in a pipe");
    let run: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let metrics = &run["metrics"];
    for name in [
        "rms_z1",
        "rms_z2",
        "rms_voltage",
        "rms_voltage_step",
        "rms_load_torque_error",
        "peak_speed",
        "peak_current",
        "peak_voltage",
        "first_voltage",
    ] {
        assert!(metrics[name].as_f64().expect(name) > 0.0, "{name}");
        assert!(metrics["steady"][name].as_f64().expect(name) > 0.0, "steady {name}");
    }
    assert_eq!(metrics["periods"], 200_000);
    // Three jumps: 1.5 s, 2.5 s and 1.5 s are left of 3 s, 4 s and 3 s.
    assert_eq!(metrics["steady"]["periods"], 110_000);
    assert_eq!(run["controller"], "bs-qsmdo");
    assert_eq!(run["fault"], Value::Null);
}

#[test]
fn overrides_replace_the_scenarios_settings() {
    let run = |arguments: &[&str]| -> Value {
        let output = host_sim().arg("run").arg(paper()).arg("--json").args(arguments).output();
        serde_json::from_slice(&output.expect("runs").stdout).expect("one JSON object")
    };
    let changed =
        run(&["--controller", "bs", "--rate", "10000", "--form", "explicit", "--scalar", "f64"]);
    assert_eq!(changed["controller"], "bs");
    assert_eq!(changed["form"], "explicit");
    assert_eq!(changed["scalar"], "f64");
    assert_eq!(changed["metrics"]["periods"], 100_000);
    let error = |run: &Value| run["metrics"]["steady"]["rms_z1"].as_f64().expect("counted");
    assert!(error(&changed) > 1000.0 * error(&run(&[])), "plain BS does not hold the load");
}

#[test]
fn csv_holds_every_period() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("run.csv");
    host_sim().arg("run").arg(paper()).arg("--csv").arg(&out).assert().success();
    let text = std::fs::read_to_string(&out).expect("written");
    let mut lines = text.lines();
    let header = lines.next().expect("a header");
    assert!(header.starts_with("time,reference,speed,current,voltage,z1,z2,"), "{header}");
    assert_eq!(lines.clone().count(), 200_000);
    assert!(lines.next().expect("a row").starts_with("0.0,104.72"));
}

#[test]
fn table_and_comparison() {
    host_sim().arg("run").arg(paper()).assert().success().stdout(contains("rms z1"));
    let smooth = scenarios().join("smooth.toml");
    host_sim()
        .arg("compare")
        .args([paper(), smooth])
        .assert()
        .success()
        .stdout(contains("paper").and(contains("smooth")).and(contains("rms load torque error")));
}

#[test]
fn refusals_name_file_line_and_field() {
    let cases = [
        ("inertia = 7.95e-5", "inertia = 0.0", ":5: motor.inertia must be positive"),
        ("inertia = 7.95e-5", "inertia = -1.0", ":5: motor.inertia must be positive"),
        ("inertia = 7.95e-5", "inertia = 1e-60", ":5: motor.inertia must be positive"),
        ("inertia = 7.95e-5", "intertia = 7.95e-5", ":5: motor.intertia: unknown field"),
        (
            "viscous_friction = 0",
            "viscous_friction = -1",
            ":9: motor.viscous_friction must be zero",
        ),
        ("duration = 10.0", "duration = nan", ":2: duration must be positive and finite"),
        ("duration = 10.0", "duration = -1", ":2: duration must be positive and finite"),
        ("rate = 20e3", "rate = inf", ":12: timing.rate must be positive and finite"),
        ("rate = 20e3", "rate = \"fast\"", ":12: timing.rate: invalid type"),
        ("voltage = 24.0", "voltage = 0", ":16: bus.voltage must be positive"),
        ("\"bs-qsmdo\"", "\"pid\"", ":19: control.controller: unknown variant `pid`"),
        ("k1 = 1300.0", "", ":23: gains: missing field `k1`"),
        ("epsilon2 = 5.0", "epsilon2 = 1e-4", ":28: gains.epsilon2 must be larger"),
        ("time = 3.0", "time = -3.0", ":33: reference.steps[1].time must be zero or positive"),
        ("time = 3.0", "time = 8.0", ":34: reference.steps[2].time must not be before"),
        ("136.13", "5000", ":33: reference.steps[1].value must be within ±limits.speed"),
        ("frequency = 1.0", "frequency = inf", ":41: load.sines[1].frequency must be zero"),
        (
            "frequency = 1.0",
            "frequency = 40e3",
            ":41: load.sines[1].frequency must be at most a tenth",
        ),
        ("inductance = 105e-6", "inductance = 1e-12", ":6: motor.inductance must not give"),
        ("duration = 10.0", "duration = 1e-9", ":2: duration must be at least a period"),
        ("[load]", "[initial]\nspeed = 5000\n[load]", ":38: initial.speed must be within"),
        ("c = 200.0", "c = 1e4", ":24: gains.c must be at most 0.4"),
        ("[load]", "[load", ":37: "),
        ("[load]", "[road]", "unknown field `road`"),
        ("[bus]", "[limits]\nduty = 2.0\n[bus]", ":16: limits.duty must be above 0 and at most 1"),
        ("[reference]", "[reference]\nbandwidth = 5", ":31: reference.bandwidth is for shape"),
        ("[reference]", "[reference]\nshape = \"second-order\"", ":31: reference.shape"),
    ];
    for (from, to, message) in cases {
        let (_folder, file) = edited(from, to);
        host_sim()
            .arg("run")
            .arg(&file)
            .assert()
            .code(2)
            .stdout("")
            .stderr(starts_with("error: ").and(contains("edited.toml")).and(contains(message)));
    }
}

#[test]
fn exit_codes_tell_failure() {
    let missing = "no-such-file.toml";
    host_sim().arg("run").arg(missing).assert().code(2).stderr(contains(missing));
    host_sim().arg("run").assert().code(2);
    for rate in ["0", "-5", "nan", "100"] {
        let refused = host_sim().args(["run", "--rate", rate]).arg(paper()).assert();
        refused.code(2).stderr(contains("paper.toml: with the command line's changes, "));
    }
    host_sim()
        .arg("run")
        .arg(scenarios().join("bus-sag.toml"))
        .assert()
        .code(3)
        .stderr(contains("the drive stopped at 2.500000 s: BusUndervoltage"));
    host_sim()
        .args(["paper", "--report", "/dev/null/report.html"])
        .assert()
        .code(1)
        .stderr(contains("/dev/null"));
}

#[test]
fn a_refused_run_leaves_the_csv_file_alone() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("keep.csv");
    std::fs::write(&out, "precious").expect("written");
    let refused = host_sim().args(["run", "--rate", "5", "--csv"]).arg(&out).arg(paper()).assert();
    refused.code(2).stderr(contains("paper.toml").and(contains("command line")));
    assert_eq!(std::fs::read_to_string(&out).expect("there"), "precious");
}

#[test]
fn a_reader_that_has_seen_enough_is_no_error() {
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_host-sim"))
        .arg("run")
        .arg(paper())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .expect("runs");
    drop(child.stdout.take());
    assert!(child.wait().expect("ends").success());
}

#[test]
fn every_shipped_scenario_plays() {
    let mut played = 0;
    for entry in std::fs::read_dir(scenarios()).expect("the scenarios folder") {
        let file = entry.expect("an entry").path();
        if file.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let expected = if file.ends_with("bus-sag.toml") { 3 } else { 0 };
        host_sim().arg("run").arg(&file).assert().code(expected);
        played += 1;
    }
    assert!(played >= 5, "only {played} scenarios are shipped");
}

/// Whether every number in the tables under the README's "What it shows" is printed by the command.
fn shows_the_readmes_numbers(printed: &str) -> bool {
    let readme = Path::new(env!("CARGO_MANIFEST_DIR")).join("../README.md");
    let readme = std::fs::read_to_string(readme).expect("the README");
    let section = readme.split("## What it shows").nth(1).expect("a section");
    let section = section.split("\n## ").next().expect("its text");
    let cells = section.lines().filter(|line| line.starts_with('|')).flat_map(|row| row.split('|'));
    let numbers: Vec<&str> = cells
        .map(|cell| cell.trim().trim_end_matches(" %"))
        .filter(|cell| cell.parse::<f64>().is_ok())
        .collect();
    let printed: Vec<&str> = printed.split_whitespace().collect();
    numbers.len() == 36 && numbers.iter().all(|number| printed.contains(number))
}

#[test]
fn paper_writes_a_self_contained_report() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("deep").join("report.html");
    host_sim()
        .args(["paper", "--report"])
        .arg(&out)
        .assert()
        .success()
        .stdout(predicate::function(shows_the_readmes_numbers));
    let page = std::fs::read_to_string(&out).expect("written");
    for figure in 3..=11 {
        assert!(page.contains(&format!("id=\"figure-{figure}\"")), "Figure {figure}");
    }
    assert!(page.matches("<svg").count() >= 30, "plots are drawn");
    // The SVG namespace is a name, not a place.
    let page = page.replace("http://www.w3.org/2000/svg", "");
    for outside in ["http://", "https://", "<script", "<link", "<img"] {
        assert!(!page.contains(outside), "{outside} in the report");
    }
}

#[test]
fn bench_plays_a_case_by_every_controller() {
    let output = host_sim()
        .args(["bench", "--quick", "--json", "--case", "load steps"])
        .output()
        .expect("runs");
    assert!(output.status.success());
    assert!(output.stderr.is_empty(), "no progress bar in a pipe");
    let board: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let played = board["cases"].as_array().expect("cases");
    assert_eq!(played.len(), 13);
    let figure = |player: &str, name: &str| {
        let of = played.iter().find(|at| at["player"] == player).expect(player);
        assert_eq!((&of["case"], &of["failed"]), (&"load steps".into(), &0.into()), "{player}");
        of["median"][name].as_f64().unwrap_or_else(|| unreachable!("{player} has no {name}"))
    };
    // Two-sided: the drive form's rule says 1.9·ΔT/(J·wo), of 0.05 N·m at about 1400 rad/s.
    let dip = figure("drive BS-QSMDO", "dip");
    assert!((0.7..1.0).contains(&dip), "{dip} rad/s");
    let recovery = figure("drive BS-QSMDO", "recovery");
    assert!((0.004..0.009).contains(&recovery), "{recovery} s");
    assert!(figure("plain BS", "dip") > 1.5 * dip, "plain BS has nothing against the load");
    let shifted = figure("drive BS-QSMDO, shifted reads", "dip");
    assert!(shifted != dip && (0.7..1.2).contains(&shifted), "{shifted} rad/s with shifted reads");
    for matched in board["matched"].as_array().expect("matched") {
        let ripple = matched["figures"]["ripple"].as_f64().expect("matched");
        // Fixed point is set as floating point is, and ripples a little more.
        assert!((8e-3..=10.5e-3).contains(&ripple), "{matched}");
    }
    assert_eq!(board["fronts"], Value::Array(Vec::new()), "nothing was searched");
}

#[test]
fn bench_writes_a_row_for_every_contender_and_statistic() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("board.csv");
    let arguments =
        ["bench", "--quick", "--seeds", "2", "--json", "--case", "1024 counts", "--csv"];
    let output = host_sim().args(arguments).arg(&out).output().expect("runs");
    assert!(output.status.success());
    let board: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let mut rows = csv::Reader::from_path(&out).expect("written");
    let columns: Vec<String> = rows.headers().expect("columns").iter().map(str::to_owned).collect();
    let expected = [
        "motor",
        "encoder_counts_per_turn",
        "case",
        "contender",
        "statistic",
        "rms_error_rad_per_s",
        "peak_error_rad_per_s",
        "dip_rad_per_s",
        "recovery_s",
        "overshoot_per_unit",
        "peak_current_a",
        "voltage_step_v",
        "load_torque_error_n_m",
        "failed_seeds",
        "failure",
    ];
    assert_eq!(columns, expected, "whoever reads these files counts on the names");
    let help = host_sim().args(["bench", "--help"]).output().expect("runs").stdout;
    let help = String::from_utf8_lossy(&help).into_owned();
    for column in expected {
        assert!(help.contains(column), "{column} is not in the help");
    }
    let rows: Vec<_> = rows.records().map(|row| row.expect("a row")).collect();
    let played = board["cases"].as_array().expect("cases");
    assert_eq!(rows.len(), 2 * played.len());
    for (pair, at) in rows.chunks(2).zip(played) {
        for (row, statistic) in pair.iter().zip(["median", "worst"]) {
            let names = ["paper", "1024", "1024 counts", at["player"].as_str().expect("a name")];
            assert_eq!(row.iter().take(5).collect::<Vec<_>>(), [&names[..], &[statistic]].concat());
            // In SI units, as in JSON.
            for (column, field) in [(5, "rms_error"), (8, "recovery"), (11, "voltage_step")] {
                let value: f64 = row[column].parse().expect("a number");
                let expected = at[statistic][field].as_f64().expect("a number");
                assert!((value / expected - 1.0).abs() < 1e-12, "{field} of {row:?}");
            }
            assert_eq!(row[12].is_empty(), at[statistic]["estimation_error"].is_null(), "{row:?}");
        }
    }
}

#[test]
fn bench_reports_and_refuses() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("board.html");
    let bench = |case: &str| {
        let mut command = host_sim();
        command.args(["bench", "--quick", "--case", case, "--report"]).arg(&out);
        command.assert()
    };
    bench("start while turning").success().stdout(contains("drive BS-QISMC"));
    let page = std::fs::read_to_string(&out).expect("written");
    assert!(page.contains("start while turning") && page.contains("</html>"));
    assert!(!page.contains("<svg"), "this case shows no responses");
    bench("reversal").success();
    let page = std::fs::read_to_string(&out).expect("written");
    assert!(page.len() < 3_000_000, "{} bytes", page.len());
    assert_eq!(page.matches("<svg").count(), 2, "speed and speed error");
    assert!(
        page.contains("reversal: speed error") && page.contains("drive BS-QSMDO, shifted reads")
    );
    // Every contender's line and the reference.
    let error = page.rsplit("<svg").next().expect("drawn");
    assert!(error.matches("<polyline").count() >= 10, "a line for each contender");
    bench("no such case").code(1).stderr(contains("there are: paper's cycle"));
    host_sim().args(["bench", "--seeds", "0"]).assert().code(2);
}

#[test]
fn a_drive_is_armed_on_a_turning_motor() {
    let (_folder, file) = edited(
        "[reference]",
        "[initial]\nspeed = 50.0\narmed_after = 0.25\n\n[sensors]\ncodes = 16384\n\n[reference]",
    );
    let run = |arguments: &[&str]| {
        let mut command = host_sim();
        command.arg("run").arg(&file).args(["--controller", "drive-qsmdo"]).args(arguments);
        command.assert()
    };
    let output = run(&["--json", "--duration", "1"]).success().get_output().stdout.clone();
    let run_json: Value = serde_json::from_slice(&output).expect("one JSON object");
    assert_eq!(run_json["metrics"]["periods"], 15_000, "what the drive drove");
    run(&["--controller-on", "qemu"]).code(1).stderr(contains("initial.armed_after must be 0"));
    let (_folder, file) = edited("[reference]", "[initial]\narmed_after = -1.0\n\n[reference]");
    host_sim()
        .arg("run")
        .arg(&file)
        .assert()
        .code(2)
        .stderr(contains("initial.armed_after must be"));
}
