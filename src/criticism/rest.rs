//! What the wrench sensor reads while the tool touches nothing: its bias, if it has one.

use nalgebra::{DMatrix, DVector};

use crate::inference::Gaussian;
use crate::math::median;
use crate::model::{BatchWindow, DynamicsInput, SENSOR_SIZE};

/// Readings this long before and after a contact do not count \[s\].
const MARGIN_S: f64 = 0.15;
/// Fewer readings than this say nothing.
const FEWEST: usize = 20;
/// A reading's mean is known no better than this, in units of its scale.
const FLOOR: f64 = 0.01;

/// Readings at rest.
#[derive(Clone, Debug, PartialEq)]
pub struct RestReadings {
    /// Mean of force and torque, in units of the sensor's scales.
    pub mean: [f64; 6],
    /// Its standard deviation.
    pub deviation: [f64; 6],
}

impl RestReadings {
    /// From all windows; `None` where there is too little quiet. `scales` are force's and torque's.
    pub fn of(batch: &[BatchWindow], input: &DynamicsInput<'_>, scales: &[f64; 3]) -> Option<Self> {
        let mut readings: [Vec<f64>; 6] = Default::default();
        for window in batch {
            let tools = window.track.drives.iter().filter(|drive| drive.tool);
            let held: Vec<(f64, f64)> = tools
                .filter_map(|drive| Some((drive.samples.first()?.stamp_s, drive.samples.last()?.stamp_s)))
                .collect();
            if held.is_empty() {
                continue;
            }
            let holds = |t: f64| held.iter().any(|(first, last)| t >= first - MARGIN_S && t <= last + MARGIN_S);
            let observed = &input.windows[window.index];
            let (Some(from), Some(to)) = (observed.times_s.first(), observed.times_s.last()) else { continue };
            for wrench in observed.wrenches.iter().filter(|wrench| wrench.tool) {
                let t = wrench.stamp.seconds_since(input.zero);
                let within = t >= *from - MARGIN_S && t <= *to + MARGIN_S;
                if within && !holds(t) {
                    for axis in 0..3 {
                        readings[axis].push(wrench.force_in_world[axis] / scales[0]);
                        readings[3 + axis].push(wrench.torque_in_world[axis] / scales[1]);
                    }
                }
            }
        }
        if readings[0].len() < FEWEST {
            return None;
        }
        let moments = readings.map(robust_mean);
        Some(Self { mean: moments.map(|m| m.0), deviation: moments.map(|m| m.1) })
    }

    /// The sensor's numbers after the readings, the standard normal prior in it.
    pub fn posterior(&self) -> Option<Gaussian> {
        let mut mean = DVector::zeros(SENSOR_SIZE);
        let mut covariance = DMatrix::identity(SENSOR_SIZE, SENSOR_SIZE);
        for i in 0..6 {
            let variance = self.deviation[i].powi(2);
            covariance[(i, i)] = variance / (1.0 + variance);
            mean[i] = self.mean[i] / (1.0 + variance);
        }
        Gaussian::from_moments(&mean, &covariance).ok()
    }

    /// ln P(readings | a bias) − ln P(readings | none).
    pub fn evidence_of_bias(&self) -> f64 {
        (0..6)
            .map(|i| {
                let (square, variance) = (self.mean[i].powi(2), self.deviation[i].powi(2));
                0.5 * (square / variance - square / (1.0 + variance)) - 0.5 * ((1.0 + variance) / variance).ln()
            })
            .sum()
    }
}

/// Mean without what is far off, and its standard deviation.
fn robust_mean(values: Vec<f64>) -> (f64, f64) {
    let middle = median(values.clone()).unwrap_or(0.0);
    let distances = values.iter().map(|v| (v - middle).abs()).collect();
    let spread = (1.4826 * median(distances).unwrap_or(0.0)).max(1e-9);
    let near: Vec<f64> = values.into_iter().filter(|v| (v - middle).abs() < 4.0 * spread).collect();
    let count = near.len().max(1) as f64;
    (near.iter().sum::<f64>() / count, (spread / count.sqrt()).hypot(FLOOR))
}
