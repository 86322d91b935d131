//! Applied wrenches over time: samples between which they are linear, with bias and delay.

use nalgebra::Vector3;

use super::step::{BodyWrench, WrenchOrigin};
use crate::math::Real;

/// One reading of what the tool does to the object, in world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrenchSample {
    /// Time of the reading \[s\].
    pub stamp_s: f64,
    /// Origin of the sensor's frame \[m\].
    pub point_in_world: Vector3<f64>,
    /// Force on the object \[N\].
    pub force_in_world: Vector3<f64>,
    /// Torque on the object about that point \[N·m\].
    pub torque_in_world: Vector3<f64>,
}

/// Where the readings of a track are applied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WrenchPoint<T: Real> {
    /// At each reading's own point.
    Recorded,
    /// At a point of the body, given at the reference configuration \[m\], and moving with it.
    Carried(Vector3<T>),
}

/// The wrench on one body over a record. Before the first reading and after the last it is constant.
#[derive(Clone, Debug)]
pub struct WrenchTrack<'a, T: Real> {
    /// Index of the body.
    pub body: usize,
    /// Readings in order of time.
    pub samples: &'a [WrenchSample],
    /// Where they are applied.
    pub point: WrenchPoint<T>,
    /// δ \[s\]: the wrench acting at t is the one reported at t + δ.
    pub delay_s: T,
    /// What the sensor adds to the force, world axes \[N\].
    pub force_bias: Vector3<T>,
    /// What the sensor adds to the torque about its origin, world axes \[N·m\].
    pub torque_bias: Vector3<T>,
}

impl<'a, T: Real> WrenchTrack<'a, T> {
    /// A track without bias and delay, applied where it was recorded.
    pub fn new(body: usize, samples: &'a [WrenchSample]) -> Self {
        Self {
            body,
            samples,
            point: WrenchPoint::Recorded,
            delay_s: T::zero(),
            force_bias: Vector3::zeros(),
            torque_bias: Vector3::zeros(),
        }
    }

    /// The wrench acting at `time_s`. `cursor` remembers the place in the samples between calls and
    /// changes nothing but the cost; start it at zero.
    pub fn wrench(&self, time_s: f64, cursor: &mut usize) -> BodyWrench<T> {
        let place = self.locate(time_s, cursor);
        let (reading, weight) = (&self.samples[place.first..], place.weight);
        let between = |of: fn(&WrenchSample) -> &Vector3<f64>| match weight {
            Some(weight) => {
                let (a, b) = (of(&reading[0]), of(&reading[1]));
                a.zip_map(b, |a, b| T::constant(a) + weight * T::constant(b - a))
            }
            None => reading.first().map_or_else(Vector3::zeros, |reading| of(reading).map(T::constant)),
        };
        BodyWrench {
            body: self.body,
            point: match self.point {
                WrenchPoint::Recorded => WrenchOrigin::World(between(|s| &s.point_in_world)),
                WrenchPoint::Carried(point) => WrenchOrigin::Carried(point),
            },
            force: between(|s| &s.force_in_world) - self.force_bias,
            torque: between(|s| &s.torque_in_world) - self.torque_bias,
        }
    }

    /// The samples about `time_s`: the index of the first and the weight of the one after it, if
    /// the time is between two.
    pub(super) fn locate(&self, time_s: f64, cursor: &mut usize) -> Place<T> {
        let reported = self.delay_s + T::constant(time_s);
        let at = reported.value();
        let last = self.samples.len().saturating_sub(1);
        *cursor = (*cursor).min(last);
        while *cursor > 0 && self.samples[*cursor].stamp_s > at {
            *cursor -= 1;
        }
        while *cursor < last && self.samples[*cursor + 1].stamp_s <= at {
            *cursor += 1;
        }
        let first = *cursor;
        let outside = first == last || self.samples[first].stamp_s > at;
        let weight = (!outside).then(|| {
            let span = self.samples[first + 1].stamp_s - self.samples[first].stamp_s;
            (reported - T::constant(self.samples[first].stamp_s)) * T::constant(1.0 / span)
        });
        Place { first, weight }
    }
}

/// A place between two samples.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place<T: Real> {
    /// The sample before.
    pub first: usize,
    /// The weight of the one after it; `None` outside of the record.
    pub weight: Option<T>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(stamp_s: f64, force: f64) -> WrenchSample {
        WrenchSample {
            stamp_s,
            point_in_world: Vector3::zeros(),
            force_in_world: Vector3::x() * force,
            torque_in_world: Vector3::zeros(),
        }
    }

    #[test]
    fn linear_between_constant_outside_late_by_the_delay() {
        let samples = [sample(1.0, 0.0), sample(2.0, 4.0), sample(4.0, 0.0)];
        let mut track = WrenchTrack::new(0, &samples);
        let mut cursor = 0;
        for (time_s, force) in [(0.0, 0.0), (1.25, 1.0), (3.0, 2.0), (1.5, 2.0), (5.0, 0.0), (0.5, 0.0)] {
            assert_eq!(track.wrench(time_s, &mut cursor).force.x, force, "at {time_s}");
        }
        track.delay_s = 0.25;
        track.force_bias.x = 0.5;
        assert_eq!(track.wrench(1.0, &mut cursor).force.x, 0.5);
    }

    #[test]
    fn no_readings_are_no_wrench() {
        let track: WrenchTrack<f64> = WrenchTrack::new(0, &[]);
        assert_eq!(track.wrench(1.0, &mut 0).force, Vector3::zeros());
    }
}
