//! Residual forces before and after, over position, rate and time, as SVG files.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::anyhow;
use bayesian_object_models::pipeline::{PartScore, ResidualSample, Scores};
use plotters::prelude::*;

/// Size of a figure \[px\].
const SIZE: (u32, u32) = (960, 260);
/// Bins over an argument, and the share of samples at either end that is left out of the picture.
const BINS: usize = 40;
const BEFORE: RGBColor = RGBColor(190, 60, 40);
const AFTER: RGBColor = RGBColor(30, 90, 170);

/// Draws every part's residual by the first and the last model; returns the lines that show the files.
pub fn residuals(scores: &Scores, name: &str, docs: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    let (Some(first), Some(last)) = (scores.stages.first(), scores.stages.last()) else { return Ok(text) };
    for (label, before) in &first.parts {
        let Some(after) = last.parts.get(label).filter(|_| before.residuals.len() > BINS) else { continue };
        let file = format!("criticism/{name}_{label}.svg");
        let unit = if before.turns { ("rad", "rad/s", "N·m") } else { ("m", "m/s", "N") };
        draw(&docs.join(&file), [before, after], unit).map_err(|error| anyhow!("{file}: {error}"))?;
        let _ = writeln!(
            text,
            "\n![Residual force of part {label} over position, rate and time]({file})\n\nPart {label}: mean residual \
             force in bins of position, rate and time; red by the declared model, blue by the last."
        );
    }
    Ok(text)
}

/// What a residual is drawn over, with its axis and the samples' place on it.
type Panel = (String, fn(&ResidualSample) -> f64);

fn draw(
    path: &Path,
    models: [&PartScore; 2],
    (position, rate, force): (&str, &str, &str),
) -> Result<(), Box<dyn std::error::Error>> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        area.fill(&WHITE)?;
        let panels: [Panel; 3] = [
            (format!("position [{position}]"), |s| s.position),
            (format!("rate [{rate}]"), |s| s.rate),
            ("time [s]".to_owned(), |s| s.time_s),
        ];
        for (panel, (name, of)) in area.split_evenly((1, 3)).iter().zip(panels) {
            let lines = models.map(|model| binned(&model.residuals, of));
            let all = || lines.iter().flatten();
            let range = |values: Vec<f64>| {
                let low = values.iter().copied().fold(f64::INFINITY, f64::min);
                let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let margin = 0.06 * (high - low).max(1e-6);
                low - margin..high + margin
            };
            let (xs, ys) = (range(all().map(|p| p.0).collect()), range(all().map(|p| p.1).chain([0.0]).collect()));
            if !(xs.start.is_finite() && ys.start.is_finite()) {
                continue;
            }
            let mut chart = ChartBuilder::on(panel)
                .margin(8)
                .x_label_area_size(34)
                .y_label_area_size(52)
                .build_cartesian_2d(xs, ys)?;
            let mut mesh = chart.configure_mesh();
            mesh.light_line_style(TRANSPARENT).x_labels(6).y_labels(6).x_desc(name);
            mesh.y_desc(format!("residual [{force}]")).draw()?;
            for (line, color) in lines.into_iter().zip([BEFORE, AFTER]) {
                chart.draw_series(LineSeries::new(line, color.stroke_width(2)))?;
            }
        }
        area.present()?;
    }
    fs::write(path, svg)?;
    Ok(())
}

/// Means in bins, those with samples.
fn binned(samples: &[ResidualSample], of: fn(&ResidualSample) -> f64) -> Vec<(f64, f64)> {
    let (low, high) = samples.iter().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    let width = (high - low).max(1e-9) / BINS as f64;
    let mut bins = vec![(0.0, 0usize); BINS];
    for sample in samples {
        let bin = (((of(sample) - low) / width) as usize).min(BINS - 1);
        bins[bin] = (bins[bin].0 + sample.force, bins[bin].1 + 1);
    }
    let mean = |(bin, (sum, count)): (usize, (f64, usize))| {
        (count > 0).then(|| (low + (bin as f64 + 0.5) * width, sum / count as f64))
    };
    bins.into_iter().enumerate().filter_map(mean).collect()
}
