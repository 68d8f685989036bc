//! Line plots as SVG text, through plotters.

use anyhow::{Result, anyhow};
use plotters::prelude::*;
use std::ops::Range;

/// A line of a plot.
pub struct Line {
    /// Its name in the legend; empty for none.
    pub name: String,
    /// Its colour; lines of one thing have one colour in every plot.
    pub color: RGBColor,
    /// Whether it is drawn thin and dashed, as references and bounds are.
    pub dashed: bool,
    /// Points (x, y) in order.
    pub points: Vec<(f64, f64)>,
}

/// A plot.
pub struct Plot {
    /// Heading inside the picture.
    pub title: String,
    /// Label of the x axis, with its unit, where that is not the time (s).
    pub x_label: Option<String>,
    /// Label of the y axis, with its unit.
    pub y_label: String,
    /// Times (s), or what `x_label` says, that are shown.
    pub span: Range<f64>,
    /// Lines, the lowest first.
    pub lines: Vec<Line>,
}

const SIZE: (u32, u32) = (620, 300);

impl Plot {
    /// The plot as an SVG element that scales with its place.
    pub fn svg(&self) -> Result<String> {
        let mut svg = String::new();
        self.draw(&mut svg).map_err(|error| anyhow!("cannot draw {}: {error}", self.title))?;
        let fixed = format!("width=\"{}\" height=\"{}\"", SIZE.0, SIZE.1);
        Ok(svg.replacen(&fixed, "role=\"img\"", 1))
    }

    /// From the least to the largest y, with a margin.
    fn y_range(&self) -> Range<f64> {
        let values = || self.lines.iter().flat_map(|line| line.points.iter().map(|point| point.1));
        let (least, largest) =
            (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
        let margin = (0.06 * (largest - least)).max(1e-9);
        least - margin..largest + margin
    }

    /// A corner for the legend that has no points, and the range of y with room for it above them if there is none.
    fn legend(&self, y: Range<f64>) -> (SeriesLabelPosition, Range<f64>) {
        let middle = 0.5 * (y.start + y.end);
        let width = self.span.end - self.span.start;
        let (left, right) = (self.span.start + 0.35 * width, self.span.end - 0.35 * width);
        let points_where = |holds: &dyn Fn(f64, f64) -> bool| {
            let points = self.lines.iter().flat_map(|line| &line.points);
            points.filter(|&&(x, y)| holds(x, y)).count()
        };
        let corners = [
            (points_where(&|x, y| x > right && y > middle), SeriesLabelPosition::UpperRight),
            (points_where(&|x, y| x > right && y < middle), SeriesLabelPosition::LowerRight),
            (points_where(&|x, y| x < left && y > middle), SeriesLabelPosition::UpperLeft),
            (points_where(&|x, y| x < left && y < middle), SeriesLabelPosition::LowerLeft),
        ];
        match corners.into_iter().find(|(points, _)| *points == 0) {
            Some((_, empty)) => (empty, y),
            None => (SeriesLabelPosition::UpperRight, y.start..y.end + 0.35 * (y.end - y.start)),
        }
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        // Short spans read better in milliseconds.
        let width = self.span.end - self.span.start;
        let (scale, x_label) = match &self.x_label {
            Some(label) => (1.0, label.as_str()),
            None if width < 0.5 => (1e3, "time [ms]"),
            None => (1.0, "time [s]"),
        };
        let (legend, y_range) = self.legend(self.y_range());
        let height = y_range.end - y_range.start;
        let mut chart = ChartBuilder::on(&root)
            .caption(&self.title, ("sans-serif", 15))
            .margin(8)
            .margin_right(24)
            .x_label_area_size(36)
            .y_label_area_size(66)
            .build_cartesian_2d(self.span.start * scale..self.span.end * scale, y_range)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(BLACK.mix(0.12))
            .x_desc(x_label)
            .y_desc(&self.y_label)
            .x_labels(7)
            .y_labels(6)
            .x_label_formatter(&|value| tick(*value, width * scale))
            .y_label_formatter(&|value| tick(*value, height))
            .label_style(("sans-serif", 13))
            .draw()?;
        for line in &self.lines {
            let color = line.color;
            let style = color.stroke_width(if line.dashed { 1 } else { 2 });
            let points = line.points.iter().map(|&(x, y)| (x * scale, y));
            let drawn = if line.dashed {
                chart.draw_series(DashedLineSeries::new(points, 5, 4, style))?
            } else {
                chart.draw_series(LineSeries::new(points, style))?
            };
            if line.name.is_empty() {
                continue;
            }
            // The library guesses the width of a label, and guesses short.
            drawn.label(format!("{}  ", line.name)).legend(move |(x, y)| {
                PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2))
            });
        }
        if self.lines.iter().all(|line| line.name.is_empty()) {
            root.present()?;
            return Ok(());
        }
        chart
            .configure_series_labels()
            .position(legend)
            .background_style(WHITE.mix(0.85))
            .border_style(BLACK.mix(0.2))
            .label_font(("sans-serif", 13))
            .draw()?;
        root.present()?;
        Ok(())
    }
}

/// A tick's label on an axis of this length: as many decimals as tell neighbours apart, without trailing zeros.
fn tick(value: f64, length: f64) -> String {
    let decimals = (1.0 - (length / 6.0).log10().floor()).max(0.0) as usize;
    if decimals > 6 {
        return if value.abs() < 1e-6 * length { "0".to_owned() } else { format!("{value:.1e}") };
    }
    let text = format!("{value:.decimals$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_short() {
        let texts = [(-1e-18, 1.0), (104.7, 60.0), (5000.5, 2.0), (2e-6, 1e-5), (-20_000.0, 3e4)]
            .map(|(value, length)| tick(value, length));
        assert_eq!(texts, ["0", "105", "5000.5", "2.0e-6", "-20000"]);
    }

    #[test]
    fn a_plot_holds_its_lines_and_labels() {
        let plot = Plot {
            title: "speed".to_owned(),
            x_label: None,
            y_label: "ω [rad/s]".to_owned(),
            span: 0.0..1.0,
            lines: vec![Line {
                name: "reference".to_owned(),
                color: RED,
                dashed: false,
                points: vec![(0.0, 0.0), (0.5, 2.0), (1.0, 1.0)],
            }],
        };
        let svg = plot.svg().expect("drawn");
        for part in ["<svg", "role=\"img\"", "viewBox", "polyline", "ω [rad/s]", "reference"] {
            assert!(svg.contains(part), "no {part}");
        }
    }
}
