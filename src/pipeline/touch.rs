//! What the tool touches, reading by reading: contact begins with force and outlives it a little.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::Frame;
use super::rest::RestReading;
use crate::mechanism::WrenchSample;
use crate::types::Label;

/// Half the readings that a force is smoothed over.
const SMOOTHING: usize = 4;
/// Contact outlives the force by this \[s\].
const RELEASE: f64 = 0.2;
/// Least and first standard deviation of the tool's reported position \[m\].
const TOOL_SIGMA: (f64, f64) = (0.0002, 0.001);

/// One reading in contact.
#[derive(Clone, Copy, Debug)]
pub(super) struct Touch {
    /// \[s\].
    pub time_s: f64,
    /// \[m\].
    pub tool_in_world: Vector3<f64>,
    /// The part, and whether contact with it begins here.
    pub part: Option<Label>,
    pub begins: bool,
    /// Whether the force says so, not only its memory.
    pub pushes: bool,
}

/// When the first of some readings pushes beyond `threshold_n` \[N\], smoothed as for contact \[s\].
pub(super) fn first_push(samples: &[WrenchSample], rest: &RestReading, threshold_n: f64) -> Option<f64> {
    let mut around = samples.windows(2 * SMOOTHING + 1);
    around.find(|around| pushes(around, rest, threshold_n)).map(|around| around[SMOOTHING].stamp_s)
}

/// Whether the mean of some readings is a push.
fn pushes(around: &[WrenchSample], rest: &RestReading, threshold_n: f64) -> bool {
    let count = around.len() as f64;
    let mean = around.iter().map(|s| s.force_in_world).sum::<Vector3<f64>>() / count;
    rest.is_push(&mean, count, threshold_n)
}

/// A contact under way.
struct ContactNow {
    label: Option<Label>,
    votes: BTreeMap<Label, usize>,
    /// Its motion told which part it is.
    sure: bool,
    last_push_s: f64,
    track: Vec<(f64, Vector3<f64>)>,
}

/// Finds contacts in the readings.
pub(super) struct Toucher {
    /// Force beyond the rest reading that means contact \[N\].
    pub threshold_n: f64,
    /// The part that the wrench is bound to, if any.
    pub bound: Option<Label>,
    contact: Option<ContactNow>,
    /// Parts let go since last asked.
    let_go: Vec<Label>,
    /// The part nearest to the tool, its nearest point and how far that is \[m\], at the last frame.
    nearest: Option<(Label, Vector3<f64>, f64)>,
    /// Readings looked at, in time.
    looked_s: f64,
    tool_variance: f64,
}

impl Toucher {
    /// Nothing touched; contact is a force of `threshold_n` \[N\] beyond the rest reading.
    pub fn new(threshold_n: f64) -> Self {
        Self {
            threshold_n,
            bound: None,
            contact: None,
            let_go: Vec::new(),
            nearest: None,
            looked_s: f64::NEG_INFINITY,
            tool_variance: TOOL_SIGMA.1.powi(2),
        }
    }

    /// Standard deviation of the tool's reported position \[m\].
    pub fn tool_sigma(&self) -> f64 {
        self.tool_variance.sqrt().max(TOOL_SIGMA.0)
    }

    /// The tool's positions since it took hold of a part, if it does.
    pub fn track_of(&self, label: Label) -> Option<&[(f64, Vector3<f64>)]> {
        self.contact.as_ref().filter(|contact| contact.label == Some(label)).map(|contact| contact.track.as_slice())
    }

    /// What the tool is within `reach_m` of without touching it, and the point of it that is nearest.
    pub fn near(&self, reach_m: f64) -> Option<(Label, Vector3<f64>)> {
        if self.contact.is_some() {
            return None;
        }
        self.nearest.filter(|(.., distance)| *distance < reach_m).map(|(label, point, _)| (label, point))
    }

    /// The tool holds this part, whichever is nearest.
    pub fn takes(&mut self, label: Label) {
        if let Some(contact) = &mut self.contact {
            contact.label = Some(label);
            contact.sure = true;
        }
    }

    /// Parts let go since this was last asked.
    pub fn let_go(&mut self) -> Vec<Label> {
        std::mem::take(&mut self.let_go)
    }

    /// Readings since the last frame that are in contact, by part.
    pub fn touches(&mut self, samples: &[WrenchSample], frame: &Frame, rest: &RestReading) -> Vec<Touch> {
        let first = samples.partition_point(|s| s.stamp_s <= self.looked_s);
        let end = samples.partition_point(|s| s.stamp_s <= frame.time_s + 1e-9);
        self.looked_s = frame.time_s;
        let mut touches = Vec::new();
        let tool_now = (end > first).then(|| samples[end - 1].point_in_world);
        let nearest = self.bound.or_else(|| Some(frame.nearest(&tool_now?)?.0));
        self.nearest = tool_now.and_then(|tool| {
            let label = nearest?;
            let points = frame.scans.get(&label)?.iter().map(|p| p.point_in_world);
            let point = points.min_by(|a, b| (a - tool).norm_squared().total_cmp(&(b - tool).norm_squared()))?;
            Some((label, point, (point - tool).norm()))
        });
        let mut voted = false;
        for i in first..end {
            let around = &samples[i.saturating_sub(SMOOTHING)..(i + SMOOTHING + 1).min(end)];
            let pushes = pushes(around, rest, self.threshold_n);
            let sample = samples[i];
            if i >= 3 {
                // Third differences of white noise have 20 times its variance; of a motion, next to none.
                let x = |k: usize| samples[i - k].point_in_world;
                let third = (x(0) - x(1) * 3.0 + x(2) * 3.0 - x(3)).norm_squared() / 60.0;
                self.tool_variance += 0.005 * (third.min(4.0 * self.tool_variance) - self.tool_variance);
            }
            if self.contact.as_ref().is_some_and(|c| !pushes && sample.stamp_s - c.last_push_s > RELEASE) {
                self.let_go.extend(self.contact.take().and_then(|contact| contact.label));
            }
            if self.contact.is_none() && !pushes {
                continue;
            }
            let mut begins = self.contact.is_none();
            let contact = self.contact.get_or_insert_with(|| ContactNow {
                label: None,
                votes: BTreeMap::new(),
                sure: false,
                last_push_s: sample.stamp_s,
                track: Vec::new(),
            });
            if pushes {
                contact.last_push_s = sample.stamp_s;
            }
            if !std::mem::replace(&mut voted, true)
                && let Some(label) = nearest
            {
                *contact.votes.entry(label).or_default() += 1;
                let most = contact.votes.iter().max_by_key(|(_, votes)| **votes).map(|(label, _)| *label);
                if contact.label != most && !contact.sure {
                    begins = true;
                    contact.label = most;
                    contact.track.clear();
                }
            }
            contact.track.push((sample.stamp_s, sample.point_in_world));
            touches.push(Touch {
                time_s: sample.stamp_s,
                tool_in_world: sample.point_in_world,
                part: contact.label,
                begins,
                pushes,
            });
        }
        touches
    }
}
