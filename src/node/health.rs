//! How the node does: rates, drops, ages, times; and what is wrong, named.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use ros2_interfaces_jazzy_serde::builtin_interfaces::msg::Time;
use rustix::time::{ClockId, clock_gettime};

use super::inbox::Dropped;
use super::lifecycle::State;
use crate::io::counters::{ByReason, Counters};
use crate::types::Stamp;

/// Times kept for quantiles.
const TIMES_KEPT: usize = 2000;
/// A message that waits for its transform this long is said to.
const TF_PATIENCE: Duration = Duration::from_millis(400);
/// Clocks that do not advance for this long stand still.
const CLOCK_PATIENCE: Duration = Duration::from_millis(800);
/// Weight of a new period in the mean.
const PERIOD_SHARE: f64 = 0.2;

/// What a topic brings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Segmented points.
    Cloud,
    /// Readings of a wrench.
    Wrench,
    /// A part's pose.
    Pose,
    /// Transforms.
    Tf,
    /// Sim time.
    Clock,
}

/// One topic that is read.
#[derive(Clone, Debug)]
pub struct TopicHealth {
    /// What it brings.
    pub kind: Kind,
    /// Messages so far.
    pub received: u64,
    /// The newest's arrival.
    pub last: Option<Instant>,
    /// Mean time between messages \[s\].
    pub period_s: Option<f64>,
    /// Messages that could not be decoded.
    pub undecodable: u64,
}

/// The last so many times.
#[derive(Clone, Debug, Default)]
pub struct Times(VecDeque<f64>);

impl Times {
    /// Adds one \[s\].
    pub fn add(&mut self, time_s: f64) {
        self.0.push_back(time_s);
        if self.0.len() > TIMES_KEPT {
            self.0.pop_front();
        }
    }

    /// Those at shares of the way from the shortest to the longest \[s\]; zero if there are none.
    pub fn quantiles<const N: usize>(&self, shares: [f64; N]) -> [f64; N] {
        let mut sorted: Vec<f64> = self.0.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().saturating_sub(1);
        shares.map(|share| sorted.get((share * last as f64).round() as usize).copied().unwrap_or(0.0))
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.0.len()
    }
}

/// Inference, as it stands.
#[derive(Clone, Debug, Default)]
pub struct Inference {
    /// Windows learned.
    pub learned: u64,
    /// Windows that wait.
    pub waiting: usize,
    /// Windows dropped because too many waited.
    pub superseded: u64,
    /// What the last window took \[s\].
    pub last_s: f64,
    /// When the one under way was begun.
    pub since: Option<Instant>,
}

/// Limits that warnings go by.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Clouds that come more slowly are too slow \[Hz\].
    pub slowest_clouds_hz: f64,
    /// A wrench topic silent for longer is dead \[s\].
    pub wrench_timeout_s: f64,
}

/// Everything known of how the node does.
#[derive(Clone, Debug)]
pub struct Health {
    /// The lifecycle's state.
    pub state: State,
    /// By absolute topic.
    pub topics: BTreeMap<String, TopicHealth>,
    /// What reading counted.
    pub counters: Counters,
    /// Readings and clouds that wait for the stream.
    pub queued: (usize, usize),
    /// Clouds dropped for newer ones, readings dropped for want of room.
    pub dropped: (Dropped, Dropped),
    /// Topics that wait for a transform: since when, the first message's stamp, and what is missing.
    pub no_tf: BTreeMap<String, (Instant, Stamp, String)>,
    /// From a cloud's arrival to its predictions being sent \[s\].
    pub latency: Times,
    /// From taking a cloud to its predictions being ready \[s\].
    pub tracking: Times,
    /// Of that, on the processor \[s\].
    pub processor: Times,
    /// Taking over what was learned, on the stream's processor \[s\].
    pub adoption: Times,
    /// Learning.
    pub inference: Inference,
    /// Publishers and subscribers whose QoS does not fit, by topic.
    pub incompatible: BTreeMap<String, String>,
    /// Parameters given that could not be used.
    pub parameters: Vec<String>,
    /// Messages sent, by topic.
    pub sent: BTreeMap<&'static str, u64>,
    /// Messages not sent, by reason.
    pub unsent: ByReason,
    /// When sim time last advanced, where it is used.
    pub clock: Option<Instant>,
    /// Jumps of time: how many, the last's text and when.
    pub jumps: (u64, String, Option<Instant>),
    /// What was dropped at the last check, to see what grows.
    seen: BTreeMap<String, u64>,
    /// What grew lately, and when.
    growing: BTreeMap<String, (Instant, u64)>,
    started: Instant,
}

/// Shared by all tasks.
#[derive(Clone, Debug)]
pub struct SharedHealth(Arc<Mutex<Health>>);

impl SharedHealth {
    /// Nothing yet.
    pub fn new(parameters: Vec<String>) -> Self {
        Self(Arc::new(Mutex::new(Health {
            state: State::Unconfigured,
            topics: BTreeMap::new(),
            counters: Counters::default(),
            queued: (0, 0),
            dropped: (Dropped::new(), Dropped::new()),
            no_tf: BTreeMap::new(),
            latency: Times::default(),
            tracking: Times::default(),
            processor: Times::default(),
            adoption: Times::default(),
            inference: Inference::default(),
            incompatible: BTreeMap::new(),
            parameters,
            sent: BTreeMap::new(),
            unsent: ByReason::new(),
            clock: None,
            jumps: (0, String::new(), None),
            seen: BTreeMap::new(),
            growing: BTreeMap::new(),
            started: now(),
        })))
    }

    /// To read or to change.
    pub fn lock(&self) -> MutexGuard<'_, Health> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The wall clock, for ages and rates; what is learned never depends on it.
#[allow(clippy::disallowed_methods)]
pub fn now() -> Instant {
    Instant::now()
}

/// The wall clock since 1970, for what says when it was sent or written.
#[allow(clippy::disallowed_methods)]
pub fn since_epoch() -> Duration {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default()
}

/// The same as a stamp.
pub fn wall_time() -> Time {
    let since = since_epoch();
    Time { sec: i32::try_from(since.as_secs()).unwrap_or(i32::MAX), nanosec: since.subsec_nanos() }
}

/// Time that this thread has had on a processor \[s\].
pub fn processor_s() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

impl Health {
    /// A topic is listened to.
    pub fn listen(&mut self, topic: &str, kind: Kind) {
        let fresh = TopicHealth { kind, received: 0, last: None, period_s: None, undecodable: 0 };
        self.topics.entry(topic.to_owned()).or_insert(fresh);
    }

    /// A message came.
    pub fn received(&mut self, topic: &str, at: Instant) {
        let Some(topic) = self.topics.get_mut(topic) else { return };
        topic.received += 1;
        if let Some(last) = topic.last.replace(at) {
            let period_s = at.duration_since(last).as_secs_f64();
            let mean = topic.period_s.unwrap_or(period_s);
            topic.period_s = Some(mean + PERIOD_SHARE * (period_s - mean));
        }
    }

    /// Time jumped.
    pub fn jumped(&mut self, text: String) {
        self.jumps = (self.jumps.0 + 1, text, Some(now()));
    }

    /// Everything that is wrong now: a name that stays the same as long as it lasts, and a line.
    pub fn complaints(&mut self, limits: Limits) -> BTreeMap<String, String> {
        let at = now();
        let mut found = BTreeMap::new();
        for (index, line) in self.parameters.iter().enumerate() {
            found.insert(format!("parameter {index}"), line.clone());
        }
        for (topic, line) in &self.incompatible {
            found.insert(format!("qos {topic}"), format!("{topic}: {line}"));
        }
        if self.state == State::Active {
            self.complain_of_topics(at, limits, &mut found);
        }
        for (topic, (since, _, missing)) in &self.no_tf {
            if at.duration_since(*since) > TF_PATIENCE {
                found.insert(format!("tf {topic}"), format!("{topic} waits for its transform: {missing}"));
            }
        }
        if let Some(advanced) = self.clock.filter(|advanced| at.duration_since(*advanced) > CLOCK_PATIENCE) {
            let age = at.duration_since(advanced).as_secs_f64();
            found.insert("clock".into(), format!("/clock has stood still for {}", seconds(age)));
        }
        if let (_, text, Some(when)) = &self.jumps
            && at.duration_since(*when) < Duration::from_secs(5)
        {
            found.insert("jump".into(), text.clone());
        }
        self.complain_of_drops(at, &mut found);
        found
    }

    fn complain_of_topics(&self, at: Instant, limits: Limits, found: &mut BTreeMap<String, String>) {
        for (name, topic) in &self.topics {
            let silent_s = at.duration_since(topic.last.unwrap_or(self.started)).as_secs_f64();
            let never = topic.received == 0;
            match topic.kind {
                Kind::Wrench if silent_s > limits.wrench_timeout_s.max(if never { 2.0 } else { 0.0 }) => {
                    let since = if never { "nothing has come" } else { "silent" };
                    found.insert(format!("wrench {name}"), format!("{name}: {since} for {}", seconds(silent_s)));
                }
                Kind::Cloud if !never => {
                    let slowest_s = 1.0 / limits.slowest_clouds_hz;
                    let period_s = silent_s.max(topic.period_s.unwrap_or(0.0));
                    if period_s > 1.5 * slowest_s {
                        let line = format!(
                            "{name}: clouds at {:.1} Hz, the last {} ago; need {:.1} Hz",
                            1.0 / period_s,
                            seconds(silent_s),
                            limits.slowest_clouds_hz
                        );
                        found.insert(format!("cloud {name}"), line);
                    }
                }
                _ => {}
            }
        }
    }

    /// What was dropped within the last seconds.
    fn complain_of_drops(&mut self, at: Instant, found: &mut BTreeMap<String, String>) {
        let mut counts: BTreeMap<String, u64> = BTreeMap::new();
        let counters = &self.counters;
        for (what, reasons) in [
            ("clouds dropped", &counters.clouds_dropped),
            ("wrenches dropped", &counters.wrenches_dropped),
            ("poses dropped", &counters.poses_dropped),
            ("transforms dropped", &counters.tf_dropped),
        ] {
            counts.extend(reasons.iter().map(|(reason, count)| (format!("{what}: {reason}"), *count)));
        }
        let (superseded, overflown) = &self.dropped;
        counts.extend(superseded.iter().map(|(t, n)| (format!("{t}: clouds come faster than they are tracked"), *n)));
        counts.extend(overflown.iter().map(|(t, n)| (format!("{t}: readings come faster than they are used"), *n)));
        counts.extend(self.unsent.iter().map(|(reason, n)| (format!("not sent: {reason}"), *n)));
        let undecodable = self.topics.iter().filter(|(_, topic)| topic.undecodable > 0);
        counts.extend(undecodable.map(|(name, topic)| (format!("{name}: undecodable"), topic.undecodable)));
        if self.inference.superseded > 0 {
            counts.insert("windows dropped: too many wait to be learned".into(), self.inference.superseded);
        }
        for (line, count) in counts {
            let before = self.seen.insert(line.clone(), count).unwrap_or(0);
            if count > before {
                self.growing.insert(line, (at, count));
            }
        }
        self.growing.retain(|_, (when, _)| at.duration_since(*when) < Duration::from_secs(3));
        for (line, (_, count)) in &self.growing {
            found.insert(line.clone(), format!("{line} ({count} so far)"));
        }
    }
}

fn seconds(time_s: f64) -> String {
    format!("{time_s:.1} s")
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { slowest_clouds_hz: 5.0, wrench_timeout_s: 0.3 };

    #[test]
    fn quantiles_of_the_last_times() {
        let mut times = Times::default();
        assert_eq!(times.quantiles([0.5]), [0.0]);
        (0..=100).for_each(|i| times.add(f64::from(i)));
        assert_eq!(times.quantiles([0.0, 0.5, 0.99, 1.0]), [0.0, 50.0, 99.0, 100.0]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let shared = SharedHealth::new(vec!["unknown parameter `x` (file)".into()]);
        let mut health = shared.lock();
        health.state = State::Active;
        let Some(past) = now().checked_sub(Duration::from_secs(2)) else { return };
        for (topic, kind) in [("/wrench", Kind::Wrench), ("/points", Kind::Cloud)] {
            health.listen(topic, kind);
            health.received(topic, past);
        }
        health.no_tf.insert("/points".into(), (past, Stamp(0), "frame `cam` is unknown".into()));
        health.incompatible.insert("/wrench".into(), "publisher is best effort".into());
        health.clock = Some(past);
        health.counters.clouds_dropped.insert("unknown_frame".into(), 3);
        let found: Vec<String> = health.complaints(LIMITS).into_values().collect();
        let all = found.join("\n");
        for expected in [
            "unknown parameter `x`",
            "/wrench: silent for 2.0 s",
            "/points: clouds at 0.5 Hz",
            "/points waits for its transform: frame `cam` is unknown",
            "/wrench: publisher is best effort",
            "/clock has stood still for 2.0 s",
            "clouds dropped: unknown_frame (3 so far)",
        ] {
            assert!(all.contains(expected), "{expected} in\n{all}");
        }
        assert_eq!(found.len(), 7, "{all}");
    }
}
