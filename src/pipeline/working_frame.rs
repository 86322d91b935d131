//! The frame that the pipeline works in: it goes with the object, not with the world.
//!
//! Voxels, search grids and starting points have axes. Were they the world's, another choice of the
//! world's frame would give another posterior. So: z up, origin and x from the first cloud, all
//! input carried in, all output carried out. Without gravity, z is the cloud's thinnest direction.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Vector3};

use super::{Learner, Output, Pipeline};
use crate::geometry::{HullProperties, hull_properties};
use crate::math::Pose;
use crate::model::PoseMeasurement;
use crate::types::posterior::ObjectPosterior;
use crate::types::{AppliedWrench, Input, Label, LabelledPoint};

/// Gravity weaker than this says nothing of up \[m/s²\].
const LEAST_GRAVITY: f64 = 1e-3;

/// Input until the frame is known, then the frame.
#[derive(Debug)]
pub(super) enum WorkingFrame {
    /// Nothing was seen; wrenches wait.
    Open(Vec<Input>),
    /// world_from_work.
    Known(Pose),
}

impl Pipeline {
    /// Takes one input, in the order of arrival.
    pub fn push(&mut self, input: Input) -> Vec<Output> {
        let pending = match &mut self.working_frame {
            WorkingFrame::Known(_) => vec![input],
            WorkingFrame::Open(early) => {
                let found = frame_of(&input, &self.settings.gravity_in_world);
                early.push(input);
                let Some(world_from_work) = found else { return Vec::new() };
                let pending = std::mem::take(early);
                self.working_frame = WorkingFrame::Known(world_from_work);
                pending
            }
        };
        let world_from_work = self.world_from_work();
        let work_from_world = world_from_work.inverse();
        let outputs = pending.into_iter().flat_map(|input| self.push_carried(carried_input(input, &work_from_world)));
        let outputs: Vec<Output> = outputs.collect();
        outputs.into_iter().map(|output| carried_output(output, &world_from_work, self.begin_s)).collect()
    }

    /// Ends the stream: what is open is closed and learned.
    pub fn finish(&mut self) -> Vec<Output> {
        let world_from_work = self.world_from_work();
        let outputs = self.finish_carried();
        outputs.into_iter().map(|output| carried_output(output, &world_from_work, self.begin_s)).collect()
    }

    /// What is believed now; before the first window, the prior. `None` while no part was seen.
    pub fn posterior(&self) -> Option<ObjectPosterior> {
        Some(self.posterior_in_work()?.carried_by(&self.world_from_work()))
    }

    /// Hulls of the parts as seen so far, in world at the first frame.
    pub fn hulls(&self) -> BTreeMap<Label, HullProperties> {
        hulls(&self.surfaces_in_work(), &self.world_from_work())
    }

    /// Least and greatest position of each joint of the likeliest tree in the windows learned, by child
    /// \[m or rad\].
    pub fn ranges_seen(&self) -> BTreeMap<Label, (f64, f64)> {
        self.learner().map(Learner::ranges_seen).unwrap_or_default()
    }

    pub(super) fn gravity_in_work(&self) -> Vector3<f64> {
        self.world_from_work().rotation.transpose() * self.settings.gravity_in_world
    }

    pub(super) fn world_from_work(&self) -> Pose {
        match self.working_frame {
            WorkingFrame::Open(_) => Pose::identity(),
            WorkingFrame::Known(pose) => pose,
        }
    }
}

/// Hulls of surfaces, carried into world.
pub(super) fn hulls(
    surfaces_in_work: &BTreeMap<Label, Vec<Vector3<f64>>>,
    world_from_work: &Pose,
) -> BTreeMap<Label, HullProperties> {
    let in_world = |points: &[Vector3<f64>]| -> Vec<Vector3<f64>> {
        points.iter().map(|p| world_from_work.transform_point(p)).collect()
    };
    let surfaces = surfaces_in_work.iter();
    surfaces.filter_map(|(label, points)| Some((*label, hull_properties(&in_world(points), None)?))).collect()
}

/// world_from_work by the first thing seen; wrenches say nothing of it.
fn frame_of(input: &Input, gravity_in_world: &Vector3<f64>) -> Option<Pose> {
    match input {
        Input::Cloud(cloud) => frame_of_points(&cloud.points, gravity_in_world),
        Input::Pose(pose) => Some(pose.world_from_frame),
        Input::Wrench(_) => None,
    }
}

fn frame_of_points(points: &[LabelledPoint], gravity_in_world: &Vector3<f64>) -> Option<Pose> {
    let count = points.len() as f64;
    if points.is_empty() {
        return None;
    }
    let mean = points.iter().map(|p| p.point_in_world).sum::<Vector3<f64>>() / count;
    let centred = || points.iter().map(|p| p.point_in_world - mean);
    let covariance = centred().map(|p| p * p.transpose()).sum::<Matrix3<f64>>() / count;
    // Towards the longer tail: an eigenvector's sign means nothing.
    let signed =
        |axis: Vector3<f64>| if centred().map(|p| p.dot(&axis).powi(3)).sum::<f64>() < 0.0 { -axis } else { axis };
    let eigen = covariance.symmetric_eigen();
    let thinnest: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into();
    let strength = gravity_in_world.norm();
    let up = if strength > LEAST_GRAVITY { -gravity_in_world / strength } else { signed(thinnest) };
    let level = Matrix3::identity() - up * up.transpose();
    let eigen = (level * covariance * level).symmetric_eigen();
    let longest: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imax()).into();
    // All points on one vertical line: any direction across it serves.
    let across = level * longest;
    let across = across.try_normalize(1e-6).unwrap_or_else(|| crate::math::orthonormal_pair(&up).0);
    let x = signed(across);
    Some(Pose { rotation: Matrix3::from_columns(&[x, up.cross(&x), up]), translation: mean })
}

fn carried_input(input: Input, work_from_world: &Pose) -> Input {
    let point = |p: &Vector3<f64>| work_from_world.transform_point(p);
    match input {
        Input::Cloud(mut cloud) => {
            cloud.viewpoint_in_world = cloud.viewpoint_in_world.as_ref().map(point);
            for seen in &mut cloud.points {
                seen.point_in_world = point(&seen.point_in_world);
            }
            Input::Cloud(cloud)
        }
        Input::Wrench(wrench) => Input::Wrench(AppliedWrench {
            point_in_world: point(&wrench.point_in_world),
            force_in_world: work_from_world.rotation * wrench.force_in_world,
            torque_in_world: work_from_world.rotation * wrench.torque_in_world,
            ..wrench
        }),
        Input::Pose(mut pose) => {
            pose.world_from_frame = *work_from_world * pose.world_from_frame;
            pose.information = turned(&pose.information, &work_from_world.rotation);
            Input::Pose(pose)
        }
    }
}

/// In world, times from the stream's own zero.
fn carried_output(output: Output, world_from_work: &Pose, begin_s: f64) -> Output {
    match output {
        Output::Observation { time_s, label, measurement } => {
            let displacement = *world_from_work * measurement.displacement * world_from_work.inverse();
            let information = turned(&measurement.information, &world_from_work.rotation);
            Output::Observation {
                time_s: time_s - begin_s,
                label,
                measurement: PoseMeasurement { displacement, information },
            }
        }
        Output::Prediction { time_s, horizon_s, label, displacement, covariance_m2 } => {
            let displacement = *world_from_work * displacement * world_from_work.inverse();
            let covariance_m2 = world_from_work.rotation * covariance_m2 * world_from_work.rotation.transpose();
            Output::Prediction { time_s: time_s - begin_s, horizon_s, label, displacement, covariance_m2 }
        }
        Output::Tracked { time_s, label, displacement, twist } => {
            let displacement = *world_from_work * displacement * world_from_work.inverse();
            let twist = world_from_work.adjoint(&twist);
            Output::Tracked { time_s: time_s - begin_s, label, displacement, twist }
        }
        Output::WindowClosed(window) => Output::WindowClosed(Box::new(window.carried_out(world_from_work))),
        other => other,
    }
}

/// The information of (angular, linear) with both turned.
fn turned(information: &Matrix6<f64>, rotation: &Matrix3<f64>) -> Matrix6<f64> {
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(rotation);
    both * information * both.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    fn points() -> Vec<LabelledPoint> {
        let spread =
            |i: usize| Vector3::new((i as f64 * 0.7).sin(), 0.3 * (i as f64 * 1.3).cos(), 0.2 * i as f64 / 50.0);
        // Squares, for tails of unequal length.
        (0..50).map(|i| LabelledPoint { point_in_world: spread(i).map(|x| x + x * x), label: Label(1) }).collect()
    }

    fn moved() -> Pose {
        Pose::from_quaternion(&UnitQuaternion::from_euler_angles(0.4, -1.1, 2.5), Vector3::new(3.0, -1.0, 0.2))
    }

    #[test]
    fn the_frame_goes_with_the_world() {
        for gravity in [Vector3::new(0.0, 0.0, -9.81), Vector3::zeros()] {
            let frame = frame_of_points(&points(), &gravity).unwrap();
            let mut elsewhere = points();
            elsewhere.iter_mut().for_each(|p| p.point_in_world = moved().transform_point(&p.point_in_world));
            let other = frame_of_points(&elsewhere, &(moved().rotation * gravity)).unwrap();
            let expected = moved() * frame;
            assert!((other.rotation - expected.rotation).norm() < 1e-12, "{other:?} {expected:?}");
            assert!((other.translation - expected.translation).norm() < 1e-12);
            assert!((frame.rotation.determinant() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn up_is_against_gravity() {
        let frame = frame_of_points(&points(), &Vector3::new(0.0, -9.81, 0.0)).unwrap();
        assert!((frame.rotation.column(2) - Vector3::y()).norm() < 1e-12);
        assert!(frame_of_points(&[], &Vector3::z()).is_none());
        let alone = frame_of_points(&points()[..1], &-Vector3::z()).unwrap();
        assert!((alone.rotation.determinant() - 1.0).abs() < 1e-12);
    }
}
