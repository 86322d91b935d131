//! Log lines, besides standard error, on /rosout.

use std::fmt::{self, Write as _};
use std::sync::OnceLock;

use ros2_client::Publisher;
use ros2_interfaces_jazzy_serde::rcl_interfaces::msg::Log;
use tokio::sync::mpsc;
use tracing::{
    Event, Level, Subscriber,
    field::{Field, Visit},
};
use tracing_subscriber::{Layer, layer::Context};

use super::health::wall_time;
use super::participant::publish;

/// Lines that wait for the network at most; more are on standard error only.
const MOST_WAITING: usize = 1000;

/// Where lines go once there is a node.
static SENDER: OnceLock<mpsc::Sender<Log>> = OnceLock::new();

/// Hands the lines of this program on.
pub struct RosoutLayer;

impl<S: Subscriber> Layer<S> for RosoutLayer {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        // Those of the transport would call forth more of them.
        let metadata = event.metadata();
        let Some(sender) = SENDER.get().filter(|_| metadata.target().starts_with("bayesian_object_models")) else {
            return;
        };
        let mut text = Text::default();
        event.record(&mut text);
        let level = match *metadata.level() {
            Level::ERROR => Log::ERROR,
            Level::WARN => Log::WARN,
            Level::INFO => Log::INFO,
            Level::DEBUG | Level::TRACE => Log::DEBUG,
        };
        // A full queue is no reason to stop: the line is on standard error.
        let _ = sender.try_send(Log {
            stamp: wall_time(),
            level,
            name: String::new(),
            msg: text.message + &text.fields,
            file: metadata.file().unwrap_or_default().to_owned(),
            function: metadata.target().to_owned(),
            line: metadata.line().unwrap_or_default(),
        });
    }
}

#[derive(Default)]
struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a string does not fail.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.fields, " {name}={value:?}"),
        };
    }
}

/// Sends what is logged from now on, under the node's name; ends with the runtime.
pub async fn send(publisher: Publisher<Log>, node: String) {
    let (sender, mut lines) = mpsc::channel(MOST_WAITING);
    if SENDER.set(sender).is_err() {
        return;
    }
    while let Some(line) = lines.recv().await {
        // Nobody is left to tell of a log that cannot be sent.
        let _ = publish(&publisher, Log { name: node.clone(), ..line }).await;
    }
}
