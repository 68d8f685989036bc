//! Tables for the terminal.

use crate::metrics::{Figures, Metrics};
use comfy_table::{CellAlignment, Table, TableComponent, presets};

/// A figure's name, its unit, and how to read it.
pub type Row = (&'static str, &'static str, fn(&Figures) -> Option<f64>);

/// The figures in the order they are shown.
pub const ROWS: [Row; 11] = [
    ("rms z1", "rad/s", |figures| figures.rms_z1),
    ("peak z1", "rad/s", |figures| figures.peak_z1),
    ("rms z2", "rad/s²", |figures| figures.rms_z2),
    ("rms voltage", "V", |figures| figures.rms_voltage),
    ("rms voltage step", "V", |figures| figures.rms_voltage_step),
    ("rms load torque error", "N·m", |figures| figures.rms_load_torque_error),
    ("peak load torque error", "N·m", |figures| figures.peak_load_torque_error),
    ("peak speed", "rad/s", |figures| figures.peak_speed),
    ("peak current", "A", |figures| figures.peak_current),
    ("peak voltage", "V", |figures| figures.peak_voltage),
    ("first voltage", "V", |figures| figures.first_voltage),
];

/// A number with five significant digits; a dash for none.
pub fn number(value: Option<f64>) -> String {
    let Some(value) = value else { return "–".to_owned() };
    let magnitude = value.abs();
    if magnitude == 0.0 {
        "0".to_owned()
    } else if (1e-3..1e5).contains(&magnitude) {
        let decimals = (4 - magnitude.log10().floor() as i32).max(0) as usize;
        format!("{value:.decimals$}")
    } else {
        format!("{value:.4e}")
    }
}

/// An empty table with a header, numbers to the right of the first `text_columns`.
pub fn table(header: Vec<String>, text_columns: usize) -> Table {
    let mut table = Table::new();
    table
        .load_preset(presets::NOTHING)
        .set_style(TableComponent::HeaderLines, '─')
        .set_style(TableComponent::MiddleHeaderIntersections, '─')
        .set_header(header);
    for column in table.column_iter_mut().skip(text_columns) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// A number with three significant digits.
pub fn short(value: Option<f64>) -> String {
    let Some(value) = value else { return "–".to_owned() };
    if value == 0.0 || !(1e-4..1e5).contains(&value.abs()) {
        return number(Some(value));
    }
    let decimals = (2 - value.abs().log10().floor() as i32).max(0) as usize;
    format!("{value:.decimals$}")
}

/// One column per run, whole and steady.
pub fn metrics_table(runs: &[(String, Metrics)]) -> Table {
    let mut header = vec!["".to_owned(), "unit".to_owned()];
    for (name, _) in runs {
        header.push(format!("{name}\nwhole"));
        header.push(format!("{name}\nsteady"));
    }
    let mut table = table(header, 2);
    for (name, unit, read) in ROWS {
        let mut cells = vec![name.to_owned(), unit.to_owned()];
        for (_, metrics) in runs {
            cells.push(number(read(&metrics.whole)));
            cells.push(number(read(&metrics.steady)));
        }
        table.add_row(cells);
    }
    table
}
