//! Likelihood of a window by its innovations: e_k = y_k − H_k q(t_k | y_1 … y_{k−1}; θ).
//!
//! Between two observations the joints are simulated; at an observation the state is corrected with
//! the extended Kalman gain: shooting segments as short as the spacing of observations, whose weak
//! continuity is the process noise. That noise is not a tuning: it is what the wrench sensor's own
//! noise does to the joints, times κ ≥ 1 for what the model misses. The innovations are then white
//! with covariance S, and −½ Σ (eᵀ S⁻¹ e + ln |S|) is the log likelihood (Ljung, "System
//! Identification", 1999, section 7.4; Kristensen, Madsen, Jørgensen, Automatica 40, 2004).
//! The state holds the contact point's constant error beside (q, q̇), and that of angles which count from an
//! unknown zero. Derivatives are for fixed gains, by forward mode for one joint and by the structure of the
//! equations for several.

use std::borrow::Cow;
use std::cell::RefCell;

use nalgebra::{DMatrix, DVector, Vector3};
use num_dual::DualSVec64;

use super::attenuation::{SensedNoise, SharedNoise};
use super::layout::{AddedTable, Mechanism, SensorError};
use super::track::{CONTACT_DEVIATION, Drive, JointTrack, Observation};
use crate::inference::Failure;
use crate::math::Real;
use crate::mechanism::effects::TableSpan;
use crate::mechanism::{
    Reach, SingleJoint, Spatial, State, StateSlopes, TangentWorkspace, Tree, TreeSlope, Workspace, WrenchPoint,
    WrenchSample, WrenchTrack, advance_single, advance_with_slopes, rollout_in,
};
use crate::model::Axis;

/// Longest step of the simulation \[s\]: half a wrench sample; trajectories of the midpoint step
/// change by less than .1 mm when it is halved.
const STEP_S: f64 = 0.004;
/// The same where several joints move: as long as a wrench sample, for speed.
const CHAIN_STEP_S: f64 = 0.008;
/// Friction varies by this share of itself over `FRICTION_SPAN_S` for reasons outside the model:
/// a floor of the process noise, for the time when no wrench acts.
const FRICTION_SHARE: f64 = 0.02;
const FRICTION_SPAN_S: f64 = 0.02;
/// A joint whose rate is this many standard deviations from zero is not about to stick.
const CLEAR: f64 = 3.0;
/// Standard deviation of the first position \[m or rad\] and rate \[m/s or rad/s\].
const FIRST_POSITION: f64 = 0.02;
const FIRST_RATE: f64 = 0.1;
/// The same of a rate that the window opens with, in shares of it.
const FIRST_RATE_SHARE: f64 = 0.1;
/// Components of the contact point's error, after (q, q̇).
const CONTACT: usize = 3;

/// The model of one window.
#[derive(Clone, Debug)]
pub struct WindowModel<'a> {
    /// Joints and gravity.
    pub mechanism: &'a Mechanism,
    /// Axes by joint.
    pub axes: &'a [Axis],
    /// Positions of the joints that rest in the window.
    pub frozen: &'a [Option<f64>],
    /// The others, by index.
    pub moving: &'a [usize],
    /// Observations and wrench.
    pub track: &'a JointTrack,
    /// κ, the process noise in units of what the wrench sensor explains.
    pub noise_scale: f64,
}

/// Gain and whitening of one observation.
#[derive(Clone, Debug)]
pub struct Gain {
    /// K, of the state by innovation.
    pub(super) gain: DMatrix<f64>,
    /// L with S = L Lᵀ.
    pub(super) deviation: DMatrix<f64>,
}

/// One observation of the filter: before it and after it.
pub(super) struct FilterStep {
    pub(super) predicted: DVector<f64>,
    pub(super) predicted_covariance: DMatrix<f64>,
    pub(super) updated: DVector<f64>,
    pub(super) updated_covariance: DMatrix<f64>,
    /// Of the state from the observation before.
    pub(super) transition: DMatrix<f64>,
}

/// The way from one observation to the next.
pub(super) struct Advance {
    /// Of the whole state.
    pub(super) transition: DMatrix<f64>,
    /// Of (q, q̇) by the parameters, and by (q, q̇) before.
    derivatives: DMatrix<f64>,
    /// The tool's readings' noise in between.
    pub(super) sensed: SensedNoise,
}

/// A span under way, chunk by chunk.
struct Passage {
    span: [f64; 2],
    /// How many parameters there are.
    p: usize,
    after: DVector<f64>,
    derivatives: DMatrix<f64>,
}

/// One observation, and the way to it.
pub(super) struct Passed {
    pub(super) advance: Option<Advance>,
    pub(super) rows: DMatrix<f64>,
    pub(super) gain: Gain,
}

/// Innovations of a window.
#[derive(Clone, Debug, Default)]
pub struct Innovations {
    /// L⁻¹ e, one observation after the other.
    pub whitened: Vec<f64>,
    /// Their derivatives, row by row.
    pub slopes: Vec<f64>,
    /// Σ ½ ln |S|.
    pub half_log_determinant: f64,
    /// For [`WindowModel::residuals`].
    pub gains: Vec<Gain>,
}

impl Innovations {
    /// ½ Σ e² / S.
    pub fn cost(&self) -> f64 {
        0.5 * self.whitened.iter().map(|e| e * e).sum::<f64>()
    }
}

/// Directions that one simulation of a single joint carries derivatives along, at most.
const CHUNK: usize = 8;
/// Step of what is differenced where several joints move.
const DIFFERENCE: f64 = 1e-6;
/// A position or rate this near an interval of a table may lie in it \[m or rad, m/s or rad/s\].
const TABLE_MARGIN: f64 = 1e-9;

/// What a simulation needs of the parameters.
#[derive(Clone)]
pub(super) struct Plant<T: Real> {
    pub(super) tree: Tree<T>,
    /// The only joint that moves, if one does.
    single: Option<SingleJoint<T>>,
    sensor: SensorError<T>,
    /// Lent to one simulation at a time.
    workspace: RefCell<Workspace<T>>,
}

/// A plant with derivatives along some of the directions: first parameters, then q, then q̇.
struct Chunk<const N: usize> {
    plant: Plant<DualSVec64<N>>,
    first: usize,
    /// Where its parameters matter, if all are entries of tables.
    spans: Option<Vec<TableSpan>>,
}

/// Plants of a single joint that together cover all directions.
struct Forward {
    /// Without derivatives, to see where the joint goes.
    plain: Plant<f64>,
    eights: Vec<Chunk<8>>,
    four: Option<Chunk<4>>,
    two: Option<Chunk<2>>,
}

/// How the derivatives of a span are taken.
enum Slopes {
    Forward(Box<Forward>),
    Chain(Box<Chain>),
}

/// Several joints, and how they depend on the parameters.
struct Chain {
    plant: Plant<f64>,
    /// The parameters of the tree, and their places among all.
    slopes: Vec<TreeSlope>,
    places: Vec<usize>,
    /// The other parameters, those of the sensor: their places, and the plants with them moved by [`DIFFERENCE`].
    moved: Vec<(usize, Plant<f64>)>,
    workspace: RefCell<TangentWorkspace>,
}

impl WindowModel<'_> {
    /// Innovations, their derivatives by the `active` entries of `x`, and the gains, at `x`.
    pub fn linearize(&self, x: &[f64], active: &[usize]) -> Result<Innovations, Failure> {
        self.pass_all(x, active).map(|(innovations, _)| innovations)
    }

    /// The same, and what innovations and derivatives have in common of the readings' noise.
    pub(super) fn linearize_with_noise(
        &self,
        x: &[f64],
        active: &[usize],
    ) -> Result<(Innovations, SharedNoise), Failure> {
        let (innovations, passed) = self.pass_all(x, active)?;
        Ok((innovations, SharedNoise::of(&passed, self, (x, active))?))
    }

    fn pass_all(&self, x: &[f64], active: &[usize]) -> Result<(Innovations, Vec<Passed>), Failure> {
        let n = self.moving.len();
        let p = active.len();
        let slopes = self.slopes(x, active)?;
        let noise = ProcessNoise::new(self, x)?;
        let observations = &self.track.observations;
        if observations.len() < 3 {
            return Err(Failure::NoInformation);
        }
        let mut state = self.first_state();
        let size = state.len();
        let mut covariance = self.first_covariance(&state);
        let mut result = Innovations::default();
        let mut passed: Vec<Passed> = Vec::with_capacity(observations.len());
        for (k, observation) in observations.iter().enumerate() {
            let mut advance = None;
            if k > 0 {
                let span = [observations[k - 1].time_s, observation.time_s];
                let before = state.rows(0, 2 * n).into_owned();
                let (next, derivatives) = self.advance_with_slopes(&slopes, &before, span, p)?;
                state.rows_mut(0, 2 * n).copy_from(&next);
                let mut transition = DMatrix::identity(size, size);
                transition.view_mut((0, 0), (2 * n, 2 * n)).copy_from(&derivatives.columns(p, 2 * n));
                let ends = [before.as_slice(), next.as_slice()];
                let carried = self.over_spread(&slopes, &transition, ends, &covariance, span)?;
                covariance = &*carried * covariance * carried.transpose();
                let mut own = covariance.view_mut((0, 0), (2 * n, 2 * n));
                let positions = self.all_positions(state.as_slice());
                let (added, density) = noise.over(span, &positions, self)?;
                own += &added;
                let free = (0..n).filter(|&i| next[n + i] != 0.0).collect();
                let sensed = SensedNoise { positions, density, span_s: span[1] - span[0], free };
                advance = Some(Advance { transition, derivatives, sensed });
            }
            let rows = self.state_rows(observation);
            let innovation = &observation.value - &rows * &state;
            let spread = &covariance * rows.transpose();
            let total = &rows * &spread + DMatrix::identity(n, n);
            let cholesky = total.cholesky().ok_or(Failure::Diverged)?;
            let gain = cholesky.solve(&spread.transpose()).transpose();
            covariance -= &gain * spread.transpose();
            covariance = (&covariance + covariance.transpose()) * 0.5;
            let deviation = cholesky.unpack();
            let whitened = deviation.solve_lower_triangular(&innovation).ok_or(Failure::Diverged)?;
            result.half_log_determinant += deviation.diagonal().iter().map(|d| d.ln()).sum::<f64>();
            result.whitened.extend(whitened.iter());
            state += &gain * innovation;
            passed.push(Passed { advance, rows, gain: Gain { gain, deviation } });
        }
        self.innovation_slopes(&passed, p, &mut result.slopes)?;
        result.gains = passed.iter().map(|passed| passed.gain.clone()).collect();
        if result.whitened.iter().chain(&result.slopes).all(|e| e.is_finite()) {
            Ok((result, passed))
        } else {
            Err(Failure::Diverged)
        }
    }

    /// Derivatives of the whitened innovations by the `p` parameters, row by row.
    fn innovation_slopes(&self, passed: &[Passed], p: usize, all: &mut Vec<f64>) -> Result<(), Failure> {
        let n = self.moving.len();
        let mut slope = DMatrix::zeros(self.state_size(), p);
        all.reserve(n * p * passed.len());
        for Passed { advance, rows, gain: Gain { gain, deviation } } in passed {
            if let Some(advance) = advance {
                slope = &advance.transition * slope;
                let mut own = slope.rows_mut(0, 2 * n);
                own += advance.derivatives.columns(0, p);
            }
            let innovation = -(rows * &slope);
            slope += gain * &innovation;
            let whitened = deviation.solve_lower_triangular(&innovation).ok_or(Failure::Diverged)?;
            all.extend(whitened.row_iter().flat_map(|row| row.iter().copied().collect::<Vec<f64>>()));
        }
        Ok(())
    }

    /// The filter alone, step by step.
    pub(super) fn filtered(&self, x: &[f64]) -> Result<Vec<FilterStep>, Failure> {
        let n = self.moving.len();
        let size = self.state_size();
        let slopes = self.slopes(x, &[])?;
        let noise = ProcessNoise::new(self, x)?;
        let mut predicted = self.first_state();
        let mut covariance = self.first_covariance(&predicted);
        let mut transition = DMatrix::identity(size, size);
        let mut steps: Vec<FilterStep> = Vec::new();
        let mut before_s = None;
        for observation in &self.track.observations {
            if let (Some(from_s), Some(last)) = (before_s, steps.last()) {
                let span = [from_s, observation.time_s];
                let moved = last.updated.rows(0, 2 * n).into_owned();
                let (next, derivatives) = self.advance_with_slopes(&slopes, &moved, span, 0)?;
                predicted.copy_from(&last.updated);
                predicted.rows_mut(0, 2 * n).copy_from(&next);
                transition.view_mut((0, 0), (2 * n, 2 * n)).copy_from(&derivatives.columns(0, 2 * n));
                let ends = [moved.as_slice(), next.as_slice()];
                let carried = self.over_spread(&slopes, &transition, ends, &last.updated_covariance, span)?;
                transition = carried.into_owned();
                covariance = &transition * &last.updated_covariance * transition.transpose();
                let mut own = covariance.view_mut((0, 0), (2 * n, 2 * n));
                own += noise.over(span, &self.all_positions(predicted.as_slice()), self)?.0;
            }
            let rows = self.state_rows(observation);
            let innovation = &observation.value - &rows * &predicted;
            let spread = &covariance * rows.transpose();
            let total = &rows * &spread + DMatrix::identity(n, n);
            let gain = total.cholesky().ok_or(Failure::Diverged)?.solve(&spread.transpose()).transpose();
            let updated_covariance = &covariance - &gain * spread.transpose();
            steps.push(FilterStep {
                updated: &predicted + &gain * innovation,
                updated_covariance: (&updated_covariance + updated_covariance.transpose()) * 0.5,
                predicted: predicted.clone(),
                // Never singular, where a joint sticks.
                predicted_covariance: &covariance + DMatrix::identity(size, size) * 1e-14,
                transition: transition.clone(),
            });
            before_s = Some(observation.time_s);
        }
        if steps.len() < 3 { Err(Failure::NoInformation) } else { Ok(steps) }
    }

    fn first_covariance(&self, state: &DVector<f64>) -> DMatrix<f64> {
        let n = self.moving.len();
        let zeros = 2 * n + CONTACT;
        let deviation = |i: usize| match i {
            i if i < n => FIRST_POSITION,
            i if i < 2 * n => FIRST_RATE.hypot(FIRST_RATE_SHARE * state[i]),
            i if i < zeros => CONTACT_DEVIATION,
            i => self.track.zero_deviations[i - zeros],
        };
        let size = state.len();
        let mut covariance = DMatrix::from_fn(size, size, |i, j| if i == j { deviation(i).powi(2) } else { 0.0 });
        // Where the joint is follows from where it was measured.
        for (i, deviation) in (zeros..size).map(|zero| (zero - zeros, deviation(zero))) {
            covariance[(i, i)] += deviation.powi(2);
            covariance[(i, zeros + i)] = -deviation.powi(2);
            covariance[(zeros + i, i)] = -deviation.powi(2);
        }
        covariance
    }

    /// Of (q, q̇), the contact point's error and, where measured positions have one, theirs.
    fn state_size(&self) -> usize {
        let zeros = if self.track.zero_deviations.iter().any(|d| *d > 0.0) { self.moving.len() } else { 0 };
        2 * self.moving.len() + CONTACT + zeros
    }

    /// \[H 0 G H\], what an observation sees of the state.
    fn state_rows(&self, observation: &Observation) -> DMatrix<f64> {
        let n = observation.rows.ncols();
        let mut rows = DMatrix::zeros(n, self.state_size());
        rows.columns_mut(0, n).copy_from(&observation.rows);
        rows.columns_mut(2 * n, CONTACT).copy_from(&observation.contact_rows);
        if rows.ncols() > 2 * n + CONTACT {
            rows.columns_mut(2 * n + CONTACT, n).copy_from(&observation.rows);
        }
        rows
    }

    /// What measured positions are off by in a state.
    pub(super) fn zeros<'s>(&self, state: &'s DVector<f64>) -> &'s [f64] {
        &state.as_slice()[2 * self.moving.len() + CONTACT..]
    }

    /// Whitened innovations at `x` with gains from elsewhere.
    pub fn residuals(&self, x: &[f64], gains: &[Gain]) -> Result<Vec<f64>, Failure> {
        let n = self.moving.len();
        let plant = self.plant(x)?;
        let mut state = self.first_state();
        let mut all = Vec::with_capacity(n * gains.len());
        for (k, (observation, Gain { gain, deviation })) in self.track.observations.iter().zip(gains).enumerate() {
            if k > 0 {
                let span = [self.track.observations[k - 1].time_s, observation.time_s];
                let run = self.advance(&plant, &state.as_slice()[..2 * n], span)?;
                state.rows_mut(0, 2 * n).copy_from_slice(&run);
            }
            let innovation = &observation.value - self.state_rows(observation) * &state;
            let whitened = deviation.solve_lower_triangular(&innovation).ok_or(Failure::Diverged)?;
            all.extend(whitened.iter());
            state += gain * innovation;
        }
        if all.iter().all(|e: &f64| e.is_finite()) { Ok(all) } else { Err(Failure::Diverged) }
    }

    pub(super) fn plant<T: Real>(&self, x: &[T]) -> Result<Plant<T>, Failure> {
        let tree = self.mechanism.tree(x, self.axes, self.frozen)?;
        let workspace = RefCell::new(Workspace::new(&tree));
        let single = SingleJoint::of(&tree);
        Ok(Plant { tree, single, sensor: self.mechanism.sensor_error(x), workspace })
    }

    fn forward(&self, x: &[f64], active: &[usize]) -> Result<Slopes, Failure> {
        let directions = active.len() + 2 * self.moving.len();
        let rest = directions % CHUNK;
        let whole = if rest > 4 { directions.div_ceil(CHUNK) } else { directions / CHUNK };
        let first = whole * CHUNK;
        let eights = (0..whole).map(|k| self.chunk::<8>(x, active, k * CHUNK));
        Ok(Slopes::Forward(Box::new(Forward {
            plain: self.plant(x)?,
            eights: eights.collect::<Result<_, Failure>>()?,
            four: (rest == 3 || rest == 4).then(|| self.chunk(x, active, first)).transpose()?,
            two: (rest == 1 || rest == 2).then(|| self.chunk(x, active, first)).transpose()?,
        })))
    }

    /// The plant with derivatives along the directions from the `first` on.
    fn chunk<const N: usize>(&self, x: &[f64], active: &[usize], first: usize) -> Result<Chunk<N>, Failure> {
        let mut parameters: Vec<DualSVec64<N>> = x.iter().map(|&v| Real::constant(v)).collect();
        let own = active.iter().enumerate().skip(first).take(N);
        for (i, &at) in own.clone() {
            parameters[at] = parameters[at].derivative(i - first);
        }
        let parameters_only = first + N <= active.len();
        let spans: Option<Vec<TableSpan>> = own.map(|(_, &at)| self.table_span(at)).collect();
        Ok(Chunk { plant: self.plant(&parameters)?, first, spans: spans.filter(|_| parameters_only) })
    }

    /// Where a number matters that is an entry of a table of a joint that moves.
    fn table_span(&self, at: usize) -> Option<TableSpan> {
        self.moving.iter().find_map(|&joint| {
            let model = &self.mechanism.joints[joint];
            let own = at.checked_sub(self.mechanism.offset(joint))?;
            (0..model.tables.len()).find_map(|table| {
                let node = own.checked_sub(model.table_offset(table))?;
                let AddedTable { kind, nodes, .. } = &model.tables[table];
                (node < nodes.len()).then(|| TableSpan::of_node(*kind, nodes, node))
            })
        })
    }

    fn chain(&self, x: &[f64], active: &[usize]) -> Result<Slopes, Failure> {
        let plant = self.plant(x)?;
        let workspace = RefCell::new(TangentWorkspace::new(&plant.tree));
        let mut chain = Chain { plant, slopes: Vec::new(), places: Vec::new(), moved: Vec::new(), workspace };
        for (place, &at) in active.iter().enumerate() {
            let mut moved = x.to_vec();
            moved[at] += DIFFERENCE;
            let moved: Plant<f64> = self.plant(&moved)?;
            if moved.sensor == chain.plant.sensor {
                chain.slopes.push(TreeSlope::new(&chain.plant.tree, moved.tree, DIFFERENCE));
                chain.places.push(place);
            } else {
                chain.moved.push((place, moved));
            }
        }
        Ok(Slopes::Chain(Box::new(chain)))
    }

    fn slopes(&self, x: &[f64], active: &[usize]) -> Result<Slopes, Failure> {
        if self.moving.len() > 1 { self.chain(x, active) } else { self.forward(x, active) }
    }

    /// The state after a span, and its derivatives by the `p` parameters, then by the state before.
    fn advance_with_slopes(
        &self,
        slopes: &Slopes,
        state: &DVector<f64>,
        span: [f64; 2],
        p: usize,
    ) -> Result<(DVector<f64>, DMatrix<f64>), Failure> {
        let forward = match slopes {
            Slopes::Forward(forward) => forward,
            Slopes::Chain(chain) => return self.advance_chain(chain, state, span, p),
        };
        let size = state.len();
        let mut passage = Passage { span, p, after: DVector::zeros(size), derivatives: DMatrix::zeros(size, p + size) };
        let mut reach = None;
        for chunk in &forward.eights {
            if let Some(spans) = &chunk.spans {
                let reach = match reach {
                    Some(reach) => reach,
                    None => *reach.insert(self.reach(&forward.plain, state.as_slice(), span)?),
                };
                // Entries of tables that the joint does not come to change nothing.
                if !spans.iter().any(|own| own.meets(&reach, span, TABLE_MARGIN)) {
                    continue;
                }
            }
            self.pass(chunk, state, &mut passage)?;
        }
        forward.four.iter().try_for_each(|chunk| self.pass(chunk, state, &mut passage))?;
        forward.two.iter().try_for_each(|chunk| self.pass(chunk, state, &mut passage))?;
        Ok((passage.after, passage.derivatives))
    }

    /// The transition of a covariance from the one of a state: a joint of a chain that
    /// sticks forgets its rate, but not if it may well be moving, so that differences are taken over what the
    /// rate may be (Norgaard, Poulsen, Ravn, Automatica 36, 2000), unless all joints go on as they go. `ends` are
    /// (q, q̇) before and after the span.
    fn over_spread<'t>(
        &self,
        slopes: &Slopes,
        transition: &'t DMatrix<f64>,
        ends: [&[f64]; 2],
        covariance: &DMatrix<f64>,
        span: [f64; 2],
    ) -> Result<Cow<'t, DMatrix<f64>>, Failure> {
        let Slopes::Chain(chain) = slopes else { return Ok(Cow::Borrowed(transition)) };
        let spread = spread_of(covariance, self.moving.len());
        let [before, after] = ends.map(|end| &end[spread.len()..]);
        let goes_on = |i: usize| before[i] * after[i] > 0.0 && before[i].abs().min(after[i].abs()) > CLEAR * spread[i];
        if (0..spread.len()).all(goes_on) {
            return Ok(Cow::Borrowed(transition));
        }
        let mut transition = transition.clone();
        for (i, deviation) in spread.iter().enumerate() {
            let (rate, by) = (spread.len() + i, deviation.max(DIFFERENCE));
            let moved = |by: f64| {
                let mut start = ends[0].to_vec();
                start[rate] += by;
                self.advance(&chain.plant, &start, span).map(DVector::from_vec)
            };
            let slope = (moved(by)? - moved(-by)?) / (2.0 * by);
            transition.view_mut((0, rate), (slope.len(), 1)).copy_from(&slope);
        }
        Ok(Cow::Owned(transition))
    }

    /// [`Self::advance_with_slopes`] where several joints move.
    fn advance_chain(
        &self,
        chain: &Chain,
        state: &DVector<f64>,
        span: [f64; 2],
        p: usize,
    ) -> Result<(DVector<f64>, DMatrix<f64>), Failure> {
        let Chain { plant, slopes, places, moved, workspace } = chain;
        let (n, own) = (self.moving.len(), slopes.len());
        let first = |at: usize| DMatrix::from_fn(n, own + 2 * n, |k, c| if c == own + at + k { 1.0 } else { 0.0 });
        let (mut positions, mut rates) = (first(0), first(n));
        let mut after = state.clone();
        let contacts = self.contacts(&plant.sensor);
        for span in even_spans(&contacts, span).into_iter().flatten() {
            let tracks = self.tracks(&plant.sensor, span, &contacts);
            let start = self.tree_state(after.as_slice());
            let mut carried = StateSlopes::new(positions, rates);
            let along = (&slopes[..], &mut carried);
            let mut workspace = workspace.borrow_mut();
            let end = advance_with_slopes(&plant.tree, &start, &tracks, (span, CHAIN_STEP_S), along, &mut workspace)
                .map_err(|_| Failure::Diverged)?;
            after = DVector::from_vec(self.of_moving(&end.positions, &end.rates));
            (positions, rates) = (carried.positions, carried.rates);
        }
        let mut derivatives = DMatrix::zeros(2 * n, p + 2 * n);
        for (c, place) in places.iter().copied().chain(p..p + 2 * n).enumerate() {
            derivatives.view_mut((0, place), (n, 1)).copy_from(&positions.column(c));
            derivatives.view_mut((n, place), (n, 1)).copy_from(&rates.column(c));
        }
        for (place, plant) in moved {
            let end = DVector::from_vec(self.advance(plant, state.as_slice(), span)?);
            derivatives.set_column(*place, &((end - &after) / DIFFERENCE));
        }
        Ok((after, derivatives))
    }

    /// Carries a chunk's derivatives through a span.
    fn pass<const N: usize>(
        &self,
        chunk: &Chunk<N>,
        state: &DVector<f64>,
        passage: &mut Passage,
    ) -> Result<(), Failure> {
        let (size, p) = (state.len(), passage.p);
        let start: Vec<DualSVec64<N>> = (0..size)
            .map(|i| {
                let value: DualSVec64<N> = Real::constant(state[i]);
                match (p + i).checked_sub(chunk.first) {
                    Some(direction) if direction < N => value.derivative(direction),
                    _ => value,
                }
            })
            .collect();
        for (i, value) in self.advance(&chunk.plant, &start, passage.span)?.iter().enumerate() {
            passage.after[i] = value.re;
            if let Some(eps) = &value.eps.0 {
                for direction in 0..N.min(p + size - chunk.first) {
                    passage.derivatives[(i, chunk.first + direction)] = eps[direction];
                }
            }
        }
        Ok(())
    }

    /// Where a single joint goes in a span.
    fn reach(&self, plant: &Plant<f64>, state: &[f64], span: [f64; 2]) -> Result<Reach, Failure> {
        let mut reach = Reach::default();
        self.advance_noting(plant, state, span, Some(&mut reach))?;
        Ok(reach)
    }

    /// (q, q̇) of the moving joints after a span.
    pub(super) fn advance<T: Real>(&self, plant: &Plant<T>, state: &[T], span: [f64; 2]) -> Result<Vec<T>, Failure> {
        self.advance_noting(plant, state, span, None)
    }

    /// The same; `reach` takes in where a single joint goes.
    fn advance_noting<T: Real>(
        &self,
        plant: &Plant<T>,
        state: &[T],
        span: [f64; 2],
        mut reach: Option<&mut Reach>,
    ) -> Result<Vec<T>, Failure> {
        let contacts = self.contacts(&plant.sensor);
        let mut state = state.to_vec();
        for span in even_spans(&contacts, span).into_iter().flatten() {
            let tracks = self.tracks(&plant.sensor, span, &contacts);
            state = self.advance_evenly(plant, &state, span, &tracks, reach.as_deref_mut())?;
        }
        Ok(state)
    }

    /// When each drive's contact begins and ends, where the sensor's bias acts in between.
    fn contacts<T: Real>(&self, sensor: &SensorError<T>) -> Vec<Option<[f64; 2]>> {
        let delay_s = sensor.delay_s.value();
        let ends = |drive: &Drive| {
            let samples = &drive.samples;
            (drive.tool && samples.len() > 4 && self.mechanism.sensor.bias)
                .then(|| [samples[1].stamp_s - delay_s, samples[samples.len() - 2].stamp_s - delay_s])
        };
        self.track.drives.iter().map(ends).collect()
    }

    /// What acts in a span.
    fn tracks<T: Real>(
        &self,
        sensor: &SensorError<T>,
        span: [f64; 2],
        contacts: &[Option<[f64; 2]>],
    ) -> Vec<WrenchTrack<'_, T>> {
        let middle_s = 0.5 * (span[0] + span[1]);
        let delay_s = sensor.delay_s.value();
        let drives = self.track.drives.iter().zip(contacts);
        drives
            .filter(|(_, contact)| contact.is_none_or(|[from, to]| middle_s > from && middle_s < to))
            .map(|(drive, contact)| {
                // Where a bias counts, the zeros about the contact do not.
                let last = drive.samples.len();
                let all = if contact.is_some() { &drive.samples[1..last - 1] } else { &drive.samples[..] };
                let bias = |of: Vector3<T>| if drive.tool { of } else { Vector3::zeros() };
                WrenchTrack {
                    body: drive.joint,
                    samples: within(all, [span[0] + delay_s, span[1] + delay_s]),
                    point: WrenchPoint::Recorded,
                    delay_s: sensor.delay_s,
                    force_bias: bias(sensor.force_bias),
                    torque_bias: bias(sensor.torque_bias),
                }
            })
            .collect()
    }

    fn advance_evenly<T: Real>(
        &self,
        Plant { tree, single, workspace, .. }: &Plant<T>,
        state: &[T],
        span: [f64; 2],
        tracks: &[WrenchTrack<'_, T>],
        reach: Option<&mut Reach>,
    ) -> Result<Vec<T>, Failure> {
        if let Some(single) = single
            && *self.moving == [single.body]
        {
            let start = (state[0], state[1]);
            let end = advance_single((tree, single), start, tracks, span, STEP_S, reach);
            return end.map(|(position, rate)| vec![position, rate]).map_err(|_| Failure::Diverged);
        }
        let step_s = if self.moving.len() > 1 { CHAIN_STEP_S } else { STEP_S };
        let start = self.tree_state(state);
        let run = rollout_in(&mut workspace.borrow_mut(), tree, &start, tracks, &span, step_s)
            .map_err(|_| Failure::Diverged)?;
        Ok(self.of_moving(run.positions(1), run.rates(1)))
    }

    /// The tree's state from (q, q̇) of the moving joints.
    fn tree_state<T: Real>(&self, state: &[T]) -> State<T> {
        let mut positions = vec![T::zero(); self.mechanism.joints.len()];
        let mut rates = positions.clone();
        for (i, &joint) in self.moving.iter().enumerate() {
            positions[joint] = state[i];
            rates[joint] = state[self.moving.len() + i];
        }
        State::new(positions, rates)
    }

    /// (q, q̇) of the moving joints from those of all.
    fn of_moving<T: Real>(&self, positions: &[T], rates: &[T]) -> Vec<T> {
        [positions, rates].into_iter().flat_map(|all| self.moving.iter().map(|&joint| all[joint])).collect()
    }

    /// Positions of all joints, those of the moving ones from a state; the others' are in the tree.
    pub(super) fn all_positions(&self, state: &[f64]) -> Vec<f64> {
        let mut positions = vec![0.0; self.mechanism.joints.len()];
        for (i, &joint) in self.moving.iter().enumerate() {
            positions[joint] = state[i];
        }
        positions
    }

    /// The state at the first observation, with rates if the window opens in motion.
    fn first_state(&self) -> DVector<f64> {
        let n = self.moving.len();
        let first = &self.track.positions[0];
        let ahead = 3.min(self.track.positions.len() - 1);
        let span_s = self.track.observations[ahead].time_s - self.track.observations[0].time_s;
        DVector::from_fn(self.state_size(), |i, _| {
            if i < n {
                return first[i];
            }
            if i >= 2 * n {
                return 0.0;
            }
            let step = self.track.positions[ahead][i - n] - first[i - n];
            // Positions of a joint at rest are equal, as the kinematic fit ties them.
            if step.abs() > 0.02 && span_s > 0.0 { self.first_rate(i - n, ahead) } else { 0.0 }
        })
    }

    /// Slope at the first observation of the parabola through it, the one `ahead` of it and the middle one.
    fn first_rate(&self, i: usize, ahead: usize) -> f64 {
        let point = |k: usize| {
            let span_s = self.track.observations[k].time_s - self.track.observations[0].time_s;
            (span_s, self.track.positions[k][i] - self.track.positions[0][i])
        };
        let ((t1, x1), (t2, x2)) = (point(ahead.div_ceil(2)), point(ahead));
        if t1 > 0.0 && t2 > t1 { (x1 * t2 / t1 - x2 * t1 / t2) / (t2 - t1) } else { x2 / t2 }
    }
}

/// A span in parts in which contact neither begins nor ends: the sensor's errors act while the tool does.
fn even_spans(contacts: &[Option<[f64; 2]>], span: [f64; 2]) -> [Option<[f64; 2]>; 2] {
    let within = |t: &f64| *t > span[0] + 1e-6 && *t < span[1] - 1e-6;
    match contacts.iter().flatten().flatten().copied().find(within) {
        Some(cut) => [Some([span[0], cut]), Some([cut, span[1]])],
        None => [Some(span), None],
    }
}

/// Standard deviations of the rates.
fn spread_of(covariance: &DMatrix<f64>, n: usize) -> Vec<f64> {
    (n..2 * n).map(|i| covariance[(i, i)].max(0.0).sqrt()).collect()
}

/// The samples needed between two times.
fn within(samples: &[WrenchSample], span: [f64; 2]) -> &[WrenchSample] {
    let from = samples.partition_point(|s| s.stamp_s <= span[0]).saturating_sub(1);
    let to = (samples.partition_point(|s| s.stamp_s < span[1]) + 1).min(samples.len());
    &samples[from.min(to)..to]
}

/// White generalized force: what the wrench sensor's noise and the unevenness of friction do.
struct ProcessNoise {
    tree: Tree<f64>,
    workspace: RefCell<Workspace<f64>>,
    /// Density of the friction's unevenness per moving joint \[N² s or (N·m)² s\].
    floor: Vec<f64>,
}

/// Covariance that (q, q̇) gather over a span by white noise of their accelerations.
pub(super) fn gathered(density: &DMatrix<f64>, span_s: f64) -> DMatrix<f64> {
    let (n, h) = (density.nrows(), span_s);
    let share = [[h * h * h / 3.0, h * h / 2.0], [h * h / 2.0, h]];
    DMatrix::from_fn(2 * n, 2 * n, |i, j| share[i / n][j / n] * density[(i % n, j % n)])
}

impl ProcessNoise {
    fn new(model: &WindowModel<'_>, x: &[f64]) -> Result<Self, Failure> {
        let tree = model.mechanism.tree(x, model.axes, model.frozen)?;
        let workspace = RefCell::new(Workspace::new(&tree));
        let floor = model
            .moving
            .iter()
            .map(|&joint| {
                let friction = x[model.mechanism.offset(joint) + super::layout::FRICTION].exp();
                (FRICTION_SHARE * friction).powi(2) * FRICTION_SPAN_S
            })
            .collect();
        Ok(Self { tree, workspace, floor })
    }

    /// Covariance that (q, q̇) gather over a span, and the density of what the tool's readings do of it without κ.
    fn over(
        &self,
        span: [f64; 2],
        q: &[f64],
        model: &WindowModel<'_>,
    ) -> Result<(DMatrix<f64>, DMatrix<f64>), Failure> {
        let n = model.moving.len();
        let (mut sensed, mut others) = (DMatrix::zeros(n, n), DMatrix::zeros(n, n));
        let (screws, mass) = self.tree.screws_and_mass_matrix(q, &mut self.workspace.borrow_mut());
        for drive in &model.track.drives {
            let Some(sample) = within(&drive.samples, span).first() else { continue };
            let mut levers = vec![[nalgebra::Vector3::zeros(); 2]; n];
            let mut at = Some(drive.joint);
            while let Some(joint) = at {
                if let Some(i) = model.moving.iter().position(|&m| m == joint) {
                    let Spatial { angular, linear } = screws[joint];
                    levers[i] = [angular.cross(&sample.point_in_world) + linear, angular];
                }
                at = model.mechanism.joints[joint].joint.parent;
            }
            let acting = if drive.tool { &mut sensed } else { &mut others };
            for (kind, deviation) in [drive.force_deviation, drive.torque_deviation].into_iter().enumerate() {
                let variance = deviation.powi(2) * drive.sample_span_s;
                for i in 0..n {
                    for j in 0..n {
                        acting[(i, j)] += variance * levers[i][kind].dot(&levers[j][kind]);
                    }
                }
            }
        }
        let mass = DMatrix::from_fn(n, n, |i, j| mass[(model.moving[i], model.moving[j])]);
        let inverse = mass.cholesky().ok_or(Failure::Diverged)?.inverse();
        let floor = DMatrix::from_fn(n, n, |i, j| if i == j { self.floor[i] } else { 0.0 });
        let density = &inverse * (&sensed + others + floor) * &inverse * model.noise_scale;
        Ok((gathered(&density, span[1] - span[0]), sensed))
    }
}

/// Jᵀ J and Jᵀ r of innovations with `width` derivatives each.
pub fn normal_equations(innovations: &Innovations, width: usize) -> (DMatrix<f64>, DVector<f64>) {
    let jacobian = DMatrix::from_row_slice(innovations.whitened.len(), width, &innovations.slopes);
    let residual = DVector::from_column_slice(&innovations.whitened);
    (jacobian.transpose() * &jacobian, jacobian.transpose() * residual)
}
