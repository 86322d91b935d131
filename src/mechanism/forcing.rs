//! Applied wrenches over time: samples, with bias and delay.
//!
//! Between two samples the wrench about the world origin is linear in time (about the carried point,
//! where the contact moves with the body).

use nalgebra::Vector3;

use super::inertia::Spatial;
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
        let Place { first, weight } = self.locate(time_s, cursor);
        let at = |i: usize| self.samples.get(i).map_or_else(Spatial::zero, |s| self.reading(s));
        let mut wrench = at(first);
        if let Some(weight) = weight {
            wrench += (at(first + 1) + wrench * -T::one()) * weight;
        }
        let point = match self.point {
            WrenchPoint::Recorded => WrenchOrigin::World(Vector3::zeros()),
            WrenchPoint::Carried(point) => WrenchOrigin::Carried(point),
        };
        BodyWrench { body: self.body, point, force: wrench.linear, torque: wrench.angular }
    }

    /// A reading without bias: about the world origin, or about the carried point.
    pub(super) fn reading(&self, sample: &WrenchSample) -> Spatial<T> {
        let force = sample.force_in_world.map(T::constant) - self.force_bias;
        let torque = sample.torque_in_world.map(T::constant) - self.torque_bias;
        match self.point {
            WrenchPoint::Recorded => Spatial::wrench_at(&sample.point_in_world.map(T::constant), force, &torque),
            WrenchPoint::Carried(_) => Spatial { angular: torque, linear: force },
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
