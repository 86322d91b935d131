//! Line charts as SVG text, in colours that follow the page's light or dark theme.

use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::series::Series;

/// Size of a chart \[px\]; it scales with the page.
const SIZE: (u32, u32) = (900, 240);
/// Points drawn of a line at most.
const MOST_POINTS: usize = 1500;

/// A colour of the page, by the number that stands for it in the drawing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ink {
    /// Text and axes.
    Text = 1,
    /// Grid lines.
    Grid = 2,
    /// The main line.
    First = 3,
    /// The second.
    Second = 4,
    /// The third.
    Third = 5,
    /// What is only in the background.
    Faint = 6,
    /// Spans in which the tool holds the part.
    Held = 7,
}

impl Ink {
    const ALL: [(Self, &'static str); 7] = [
        (Self::Text, "var(--text)"),
        (Self::Grid, "var(--grid)"),
        (Self::First, "var(--first)"),
        (Self::Second, "var(--second)"),
        (Self::Third, "var(--third)"),
        (Self::Faint, "var(--faint)"),
        (Self::Held, "var(--held)"),
    ];

    /// A colour that nothing else has, to be replaced in the text.
    fn marker(self) -> RGBColor {
        RGBColor(1, 2, self as u8)
    }
}

/// One line, or points without one.
#[derive(Clone, Debug)]
pub struct Line<'a> {
    /// Its pieces.
    pub pieces: Vec<&'a Series>,
    /// Its colour.
    pub ink: Ink,
    /// Drawn as dots.
    pub dots: bool,
}

/// A chart over time.
#[derive(Clone, Debug, Default)]
pub struct Chart<'a> {
    /// What is drawn upward, with its unit.
    pub value: String,
    /// The lines, first ones below later ones.
    pub lines: Vec<Line<'a>>,
    /// Spans in the background \[s\].
    pub spans: Vec<(f64, f64)>,
    /// Least and greatest time \[s\].
    pub times_s: (f64, f64),
    /// Zero is always in it.
    pub from_zero: bool,
}

impl Chart<'_> {
    /// The SVG element; `None` where there is nothing to draw.
    pub fn svg(&self) -> Option<String> {
        let values = || self.lines.iter().flat_map(|line| &line.pieces).flat_map(|piece| piece.iter());
        let (mut low, mut high) =
            values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), (_, v)| (l.min(*v), h.max(*v)));
        if !(low.is_finite() && high.is_finite()) || self.times_s.1 <= self.times_s.0 {
            return None;
        }
        if self.from_zero {
            (low, high) = (low.min(0.0), high.max(0.0));
        }
        let margin = 0.06 * (high - low).max(1e-6);
        let bottom = if self.from_zero && low == 0.0 { 0.0 } else { low - margin };
        let mut text = String::new();
        {
            let area = SVGBackend::with_string(&mut text, SIZE).into_drawing_area();
            self.draw(&area, bottom..high + margin).ok()?;
            area.present().ok()?;
        }
        Some(themed(&text))
    }

    fn draw(
        &self,
        area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
        values: std::ops::Range<f64>,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let label = |size: u32| ("sans-serif", size).into_font().color(&Ink::Text.marker());
        let mut chart: ChartContext<'_, _, Cartesian2d<RangedCoordf64, RangedCoordf64>> = ChartBuilder::on(area)
            .margin(8)
            .x_label_area_size(34)
            .y_label_area_size(66)
            .build_cartesian_2d(self.times_s.0..self.times_s.1, values.clone())?;
        for (from, to) in &self.spans {
            let corners = [(*from, values.start), (*to, values.end)];
            chart.draw_series([Rectangle::new(corners, Ink::Held.marker().filled())])?;
        }
        chart
            .configure_mesh()
            .bold_line_style(Ink::Grid.marker())
            .light_line_style(TRANSPARENT)
            .axis_style(Ink::Text.marker())
            .label_style(label(13))
            .axis_desc_style(label(14))
            .x_labels(12)
            .y_labels(6)
            .x_desc("time [s]")
            .y_desc(&self.value)
            .draw()?;
        for line in &self.lines {
            for piece in &line.pieces {
                let thin = piece.len().div_ceil(MOST_POINTS).max(1);
                let points = piece.iter().step_by(thin).copied();
                let ink = line.ink.marker();
                if line.dots {
                    chart.draw_series(points.map(|at| Circle::new(at, 2, ink.filled())))?;
                } else {
                    chart.draw_series(LineSeries::new(points, ink.stroke_width(2)))?;
                }
            }
        }
        Ok(())
    }
}

/// The drawing with the page's colours, as wide as the page.
fn themed(svg: &str) -> String {
    let mut text = svg.to_owned();
    for (ink, color) in Ink::ALL {
        let RGBColor(r, g, b) = ink.marker();
        text = text.replace(&format!("#{r:02X}{g:02X}{b:02X}"), color);
    }
    let (width, height) = SIZE;
    text.replacen(&format!("width=\"{width}\" height=\"{height}\" "), "class=\"chart\" role=\"img\" ", 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_the_pages_own() {
        let series: Series = (0..50).map(|i| (f64::from(i), f64::from(i).sin())).collect();
        let line = Line { pieces: vec![&series], ink: Ink::First, dots: false };
        let chart = Chart {
            value: "position [m]".into(),
            lines: vec![line],
            spans: vec![(3.0, 9.0)],
            times_s: (0.0, 49.0),
            from_zero: false,
        };
        let svg = chart.svg().unwrap();
        for part in ["class=\"chart\"", "var(--first)", "var(--held)", "var(--text)", "position [m]"] {
            assert!(svg.contains(part), "{part}: {svg}");
        }
        assert!(!svg.contains("#0102"), "{svg}");
    }

    #[test]
    fn nothing_is_drawn_of_nothing() {
        assert_eq!(Chart { times_s: (0.0, 1.0), ..Chart::default() }.svg(), None);
        let nan: Series = vec![(0.0, f64::NAN)];
        let line = Line { pieces: vec![&nan], ink: Ink::First, dots: true };
        assert_eq!(Chart { lines: vec![line], times_s: (0.0, 1.0), ..Chart::default() }.svg(), None);
    }
}
