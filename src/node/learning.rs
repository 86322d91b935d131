//! Windows wait here for their turn to be learned, beside the stream.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use anyhow::Context as _;
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::health::{SharedHealth, now};
use crate::pipeline::{ClosedWindow, Learned, Worker};

/// Windows that wait at most; one more, and the oldest that waits is dropped and counted.
const MOST_WAITING: usize = 8;
/// How much inference gives way to the stream where they share a core, in nice's steps.
const NICENESS: i32 = 10;

/// A window, and which life of the pipeline it is from.
struct Job {
    life: u64,
    window: Box<ClosedWindow>,
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
    /// Starts the thread. `learned` gets what every window taught, with its life.
    ///
    /// # Errors
    /// No threads.
    pub fn start(
        threads: usize,
        health: SharedHealth,
        learned: impl Fn(u64, Box<Learned>) + Send + 'static,
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

    /// A window closed. Returns those that too many waiting cost their turn.
    pub fn put(&self, life: u64, window: Box<ClosedWindow>) -> Vec<Box<ClosedWindow>> {
        let mut queue = self.lock();
        queue.waiting.push_back(Job { life, window });
        let over = queue.waiting.len().saturating_sub(MOST_WAITING);
        let dropped: Vec<Box<ClosedWindow>> = queue.waiting.drain(..over).map(|job| job.window).collect();
        let waiting = queue.waiting.len();
        drop(queue);
        self.queue.1.notify_one();
        let mut health = self.health.lock();
        health.inference.waiting = waiting;
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

    fn learn_all(&self, pool: &ThreadPool, learned: &impl Fn(u64, Box<Learned>)) {
        give_way();
        let (mut worker, mut life, mut walls_s) = (Worker::default(), 0, Vec::new());
        while let Some(job) = self.next() {
            if job.life != life {
                (worker, life, walls_s) = (Worker::default(), job.life, Vec::new());
            }
            let begin = now();
            {
                let mut health = self.health.lock();
                health.inference.since = Some(begin);
                health.inference.waiting = self.lock().waiting.len();
            }
            let mut result = Box::new(pool.install(|| worker.learn(&job.window)));
            let took_s = begin.elapsed().as_secs_f64();
            walls_s.push(took_s);
            for (record, wall_s) in result.posterior.windows.iter_mut().zip(&walls_s) {
                record.inference_wall_s = *wall_s;
            }
            let mut health = self.health.lock();
            health.inference.since = None;
            health.inference.last_s = took_s;
            health.inference.learned += 1;
            drop(health);
            let (from, to) = result.span_s;
            tracing::info!("window of {from:.1} s to {to:.1} s learned in {took_s:.1} s");
            learned(life, result);
        }
    }
}

/// Lets the stream go first. On a system that refuses it, both have the same right.
fn give_way() {
    let thread = rustix::thread::gettid();
    let _ = rustix::process::setpriority_process(Some(thread), NICENESS);
}
