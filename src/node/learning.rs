//! What was seen waits here for its turn to be learned, beside the stream.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use anyhow::Context as _;
use rayon::{ThreadPool, ThreadPoolBuilder};
use thread_priority::{
    NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue,
    ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};

use super::health::{SharedHealth, now};
use crate::pipeline::{ClosedWindow, FirstLook, Learned, Looked, Worker};

/// Windows that wait at most; one more, and the oldest that waits is dropped and counted.
const MOST_WAITING: usize = 4;
/// How much tracking goes before other programs and inference after them, in nice's steps: a tenth of the
/// share of what is not nice. Less, and beside busy programs inference would starve.
const NICENESS: (i32, i32) = (-10, 10);
/// The latter, of 0 to 99.
const NICE_PRIORITY: u8 = 23;

/// What there is to learn.
enum Work {
    /// The object at rest.
    Look(Arc<FirstLook>),
    /// A window.
    Window(Box<ClosedWindow>),
}

/// What was learned, for the stream to adopt.
pub enum Taught {
    /// Models of the parts.
    Models(Looked),
    /// What a window taught.
    Window(Box<Learned>),
}

/// Work, and which life of the pipeline it is from.
struct Job {
    life: u64,
    work: Work,
}

struct Queue {
    waiting: VecDeque<Job>,
    open: bool,
}

/// The queue and its learner's thread; cheap to share.
#[derive(Clone)]
pub struct Learning {
    queue: Arc<(Mutex<Queue>, Condvar)>,
    health: SharedHealth,
}

impl Learning {
    /// Starts the thread. `learned` gets what everything taught, with its life.
    ///
    /// # Errors
    /// No threads.
    pub fn start(
        threads: usize,
        health: SharedHealth,
        learned: impl Fn(u64, Taught) + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = if threads == 0 { cores.saturating_sub(1).max(1) } else { threads };
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("inference {index}"))
            .start_handler(|_| give_way())
            .build()
            .context("threads for inference")?;
        let queue = Queue { waiting: VecDeque::new(), open: true };
        let learning = Self { queue: Arc::new((Mutex::new(queue), Condvar::new())), health };
        let own = learning.clone();
        std::thread::Builder::new()
            .name("learning".into())
            .spawn(move || own.learn_all(&pool, &learned))
            .context("the thread for learning")?;
        Ok(learning)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The object was seen at rest.
    pub fn look(&self, life: u64, look: Arc<FirstLook>) {
        self.lock().waiting.push_back(Job { life, work: Work::Look(look) });
        self.queue.1.notify_one();
    }

    /// A window closed. Returns those that too many waiting cost their turn.
    pub fn put(&self, life: u64, window: Box<ClosedWindow>) -> Vec<Box<ClosedWindow>> {
        let mut queue = self.lock();
        queue.waiting.push_back(Job { life, work: Work::Window(window) });
        let is_window = |job: &Job| matches!(job.work, Work::Window(_));
        let count = queue.waiting.iter().filter(|job| is_window(job)).count();
        let mut dropped = Vec::new();
        for _ in MOST_WAITING..count {
            let oldest = queue.waiting.iter().position(is_window);
            if let Some(Job { work: Work::Window(window), .. }) = oldest.and_then(|at| queue.waiting.remove(at)) {
                dropped.push(window);
            }
        }
        drop(queue);
        self.queue.1.notify_one();
        let mut health = self.health.lock();
        health.inference.waiting = count.min(MOST_WAITING);
        health.inference.superseded += dropped.len() as u64;
        dropped
    }

    /// Forgets what waits.
    pub fn clear(&self) {
        self.lock().waiting.clear();
        self.health.lock().inference.waiting = 0;
    }

    /// No more will come; the thread ends after the window it is at.
    pub fn close(&self) {
        let mut queue = self.lock();
        queue.open = false;
        queue.waiting.clear();
        drop(queue);
        self.queue.1.notify_all();
    }

    fn next(&self) -> Option<Job> {
        let asleep = |queue: &mut Queue| queue.open && queue.waiting.is_empty();
        let mut queue = self.queue.1.wait_while(self.lock(), asleep).unwrap_or_else(PoisonError::into_inner);
        queue.waiting.pop_front()
    }

    fn learn_all(&self, pool: &ThreadPool, learned: &(impl Fn(u64, Taught) + Sync)) {
        give_way();
        let (mut worker, mut life, mut walls_s) = (Worker::default(), 0, Vec::new());
        while let Some(job) = self.next() {
            if job.life != life {
                (worker, life, walls_s) = (Worker::default(), job.life, Vec::new());
            }
            match job.work {
                Work::Look(look) => {
                    let begin = now();
                    let models = pool.install(|| worker.look(&look));
                    tracing::info!("models of the parts made in {:.1} s", begin.elapsed().as_secs_f64());
                    learned(life, Taught::Models(models));
                }
                Work::Window(window) => {
                    let tell = |window| learned(life, Taught::Window(window));
                    tell(self.learn(pool, &mut worker, *window, &mut walls_s, tell));
                }
            }
        }
    }

    /// Learns a window. `tell` gets what it says before what is known is reviewed, which may take far longer.
    fn learn(
        &self,
        pool: &ThreadPool,
        worker: &mut Worker,
        window: ClosedWindow,
        walls_s: &mut Vec<f64>,
        tell: impl Fn(Box<Learned>) + Sync,
    ) -> Box<Learned> {
        let begin = now();
        let waiting = self.lock().waiting.len();
        {
            let mut health = self.health.lock();
            health.inference.since = Some(begin);
            health.inference.waiting = waiting;
        }
        walls_s.push(0.0);
        let mut timed = |mut result: Learned| {
            if let Some(last) = walls_s.last_mut() {
                *last = begin.elapsed().as_secs_f64();
            }
            for (record, wall_s) in result.posterior.windows.iter_mut().zip(&*walls_s) {
                record.inference_wall_s = *wall_s;
            }
            Box::new(result)
        };
        let (from, to) = window.span_s();
        let result = pool.install(|| {
            worker.learn(window, |first| {
                tell(timed(first));
                tracing::info!("window of {from:.1} s to {to:.1} s told in {:.1} s", begin.elapsed().as_secs_f64());
            })
        });
        let result = timed(result);
        let took_s = begin.elapsed().as_secs_f64();
        let mut health = self.health.lock();
        health.inference.since = None;
        health.inference.last_s = took_s;
        health.inference.learned += 1;
        drop(health);
        tracing::info!("window of {from:.1} s to {to:.1} s learned in {took_s:.1} s");
        result
    }
}

/// Threads begun by this one from now on go first: in real time (SCHED_RR at its lowest priority, 1) where the
/// system permits it, else by nice. Few systems permit that to all: then nothing changes. Nice alone does not
/// do: it counts within a session only where sessions are scheduled as groups.
pub fn go_first() {
    let realtime = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::RoundRobin);
    if set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, realtime).is_err() {
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS.0);
    }
}

/// Lets the stream go first: a batch, which takes the processor from nothing that wakes up, and nice.
pub fn give_way() {
    let batch = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch);
    if let Ok(priority) = ThreadPriorityValue::try_from(NICE_PRIORITY) {
        // It may always be given up.
        let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), batch);
    }
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS.1);
}
