//! What has arrived and waits for the stream: of clouds the newest, of all else everything in order.
//!
//! Tasks that drain the network put in, the stream's thread takes out. A cloud that was not taken
//! before the next of its camera came is dropped, so that none that is used is old.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::io::ingest::Message;

/// A message with when it came.
#[derive(Debug)]
pub struct Arrival {
    /// Its absolute topic.
    pub topic: Arc<str>,
    /// When it was taken from the network.
    pub at: Instant,
    /// The message.
    pub message: Message<'static>,
}

/// What the stream takes at once.
#[derive(Debug)]
pub struct Batch<C> {
    /// What it is told to do, in order.
    pub commands: Vec<C>,
    /// Wrenches, poses and transforms, in order of arrival.
    pub readings: Vec<Arrival>,
    /// The newest cloud of each camera.
    pub clouds: Vec<Arrival>,
}

/// What was dropped because the stream did not keep up, by topic.
pub type Dropped = BTreeMap<String, u64>;

#[derive(Debug)]
struct Waiting<C> {
    commands: VecDeque<C>,
    readings: VecDeque<Arrival>,
    clouds: BTreeMap<(Arc<str>, String), Arrival>,
    superseded: Dropped,
    overflown: Dropped,
}

/// The inbox; cheap to share.
#[derive(Debug)]
pub struct Inbox<C> {
    waiting: Mutex<Waiting<C>>,
    arrived: Condvar,
    most_readings: usize,
}

impl<C> Inbox<C> {
    /// Empty; of readings at most `most_readings` wait.
    pub fn new(most_readings: usize) -> Self {
        let waiting = Waiting {
            commands: VecDeque::new(),
            readings: VecDeque::new(),
            clouds: BTreeMap::new(),
            superseded: Dropped::new(),
            overflown: Dropped::new(),
        };
        Self { waiting: Mutex::new(waiting), arrived: Condvar::new(), most_readings }
    }

    fn lock(&self) -> MutexGuard<'_, Waiting<C>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts in a message.
    pub fn put(&self, arrival: Arrival) {
        let mut waiting = self.lock();
        if let Message::Cloud(cloud) = &arrival.message {
            let camera = (Arc::clone(&arrival.topic), cloud.header.frame_id.clone());
            if let Some(older) = waiting.clouds.insert(camera, arrival) {
                *waiting.superseded.entry(older.topic.to_string()).or_default() += 1;
            }
        } else {
            waiting.readings.push_back(arrival);
            if waiting.readings.len() > self.most_readings
                && let Some(oldest) = waiting.readings.pop_front()
            {
                *waiting.overflown.entry(oldest.topic.to_string()).or_default() += 1;
            }
        }
        drop(waiting);
        self.arrived.notify_one();
    }

    /// Tells the stream something.
    pub fn tell(&self, command: C) {
        self.lock().commands.push_back(command);
        self.arrived.notify_one();
    }

    /// Everything that waits, once there is something or the patience is over.
    pub fn take(&self, patience: Duration) -> Batch<C> {
        let empty = |waiting: &mut Waiting<C>| {
            waiting.commands.is_empty() && waiting.readings.is_empty() && waiting.clouds.is_empty()
        };
        let (mut waiting, _) =
            self.arrived.wait_timeout_while(self.lock(), patience, empty).unwrap_or_else(PoisonError::into_inner);
        Batch {
            commands: waiting.commands.drain(..).collect(),
            readings: waiting.readings.drain(..).collect(),
            clouds: std::mem::take(&mut waiting.clouds).into_values().collect(),
        }
    }

    /// How many wait: readings, clouds; what was dropped so far: clouds for newer ones, readings for
    /// want of room.
    pub fn state(&self) -> (usize, usize, Dropped, Dropped) {
        let waiting = self.lock();
        (waiting.readings.len(), waiting.clouds.len(), waiting.superseded.clone(), waiting.overflown.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::messages::{Header, PointCloud2, TfMessage};

    fn cloud(frame: &str, sec: i32) -> Message<'static> {
        let mut header = Header { frame_id: frame.into(), ..Header::default() };
        header.stamp.sec = sec;
        Message::Cloud(PointCloud2 {
            header,
            height: 1,
            width: 0,
            fields: Vec::new(),
            is_bigendian: false,
            point_step: 0,
            row_step: 0,
            data: Vec::new().into(),
            is_dense: true,
        })
    }

    #[allow(clippy::disallowed_methods)]
    fn arrival(message: Message<'static>) -> Arrival {
        Arrival { topic: "/t".into(), at: Instant::now(), message }
    }

    #[test]
    fn of_each_camera_the_newest_cloud_of_readings_all_that_fit() {
        let inbox: Inbox<u8> = Inbox::new(3);
        for sec in 0..3 {
            inbox.put(arrival(cloud("left", sec)));
            inbox.put(arrival(cloud("right", sec)));
        }
        for _ in 0..5 {
            inbox.put(arrival(Message::Tf(TfMessage::default())));
        }
        inbox.tell(7);
        assert_eq!(inbox.state(), (3, 2, Dropped::from([("/t".into(), 4)]), Dropped::from([("/t".into(), 2)])));
        let batch = inbox.take(Duration::ZERO);
        let stamps: Vec<i32> = batch
            .clouds
            .iter()
            .map(|arrival| if let Message::Cloud(cloud) = &arrival.message { cloud.header.stamp.sec } else { -1 })
            .collect();
        assert_eq!((stamps, batch.readings.len(), batch.commands), (vec![2, 2], 3, vec![7]));
        let batch = inbox.take(Duration::from_millis(1));
        assert!(batch.commands.is_empty() && batch.clouds.is_empty());
    }
}
