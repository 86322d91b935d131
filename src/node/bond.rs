//! The bond with a lifecycle manager: heartbeats by which each notices that the other is gone.
//!
//! As bondcpp has it (<https://github.com/ros/bond_core>), and, as Nav2's servers do, without a limit on the
//! manager's heartbeats: a manager that is gone is no reason to stop.

use std::future::Future;
use std::time::Duration;

use futures::{StreamExt, pin_mut};
use ros2_client::Publisher;
use ros2_interfaces_jazzy_serde::std_msgs::msg::Header;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};

use super::health::{SharedHealth, now, wall_time};
use super::lifecycle::State;
use super::participant::{Participant, Quality, publish};
use crate::ros::messages::BondStatus;

/// Relative to the node's namespace, as managers have it.
const TOPIC: &str = "bond";
const TYPE: &str = "bond/msg/Status";
/// Between two heartbeats \[s\]: as Nav2's.
const PERIOD_S: f32 = 0.1;
/// What the manager is told to wait for one \[s\]: bondcpp's default.
const HEARTBEAT_TIMEOUT_S: f32 = 4.0;
/// How long a manager is waited for, and how long its farewell \[s\]: bondcpp's defaults.
const CONNECT_TIMEOUT_S: f64 = 10.0;
const DISCONNECT_TIMEOUT_S: f64 = 2.0;

/// This side of the bond; times are seconds of any clock.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Side {
    /// Nobody is there, or not any more.
    Silent,
    /// Says that it is there until then.
    Waiting { until_s: f64 },
    /// The other side was heard.
    Formed,
    /// Says that it goes until then, or until the other side does.
    Ending { until_s: f64 },
}

#[derive(Debug)]
struct Bond {
    side: Side,
    active: bool,
}

impl Bond {
    /// What is to be said now: whether this side is there.
    fn tick(&mut self, active: bool, now_s: f64) -> Option<bool> {
        match (std::mem::replace(&mut self.active, active), active) {
            (false, true) => self.side = Side::Waiting { until_s: now_s + CONNECT_TIMEOUT_S },
            (true, false) if self.side != Side::Silent => {
                self.side = Side::Ending { until_s: now_s + DISCONNECT_TIMEOUT_S };
            }
            _ => {}
        }
        match self.side {
            Side::Formed => Some(true),
            Side::Waiting { until_s } if now_s < until_s => Some(true),
            Side::Ending { until_s } if now_s < until_s => Some(false),
            _ => {
                self.side = Side::Silent;
                None
            }
        }
    }

    /// What is answered to the other side, which says that it is there, or goes.
    fn heard(&mut self, there: bool) -> Option<bool> {
        match (there, self.side) {
            (true, Side::Silent | Side::Waiting { .. }) if self.active => {
                info!("bond with a lifecycle manager");
                self.side = Side::Formed;
                None
            }
            (false, Side::Waiting { .. } | Side::Formed) => {
                info!("the lifecycle manager gave up the bond");
                self.side = Side::Silent;
                Some(false)
            }
            (false, Side::Ending { .. }) => {
                self.side = Side::Silent;
                None
            }
            _ => None,
        }
    }
}

/// Keeps the bond under the node's name as long as the node is active; ends once it is finalized.
///
/// # Errors
/// DDS.
pub fn keep(
    participant: &mut Participant,
    name: String,
    health: SharedHealth,
) -> anyhow::Result<impl Future<Output = ()> + use<>> {
    let said = Quality { reliable: true, latched: false, depth: 5 };
    let publisher: Publisher<BondStatus> = participant.advertise(TOPIC, TYPE, said)?;
    // Managers repeat themselves; and nobody has to wait until this node has acknowledged itself.
    let heard = Quality { reliable: false, latched: false, depth: 100 };
    let subscription = participant.subscribe::<BondStatus>(&participant.resolve(TOPIC), TYPE, heard)?;
    let own = format!("{:?}", publisher.guid());
    Ok(async move {
        let heard = subscription.async_stream();
        pin_mut!(heard);
        let mut bond = Bond { side: Side::Silent, active: false };
        // Every activation is another side of a bond.
        let mut activations = 0;
        let instance = |activations: u32| format!("{own}.{activations}");
        let begin = now();
        let mut ticks = interval(Duration::from_secs_f32(PERIOD_S));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut state = State::Unconfigured;
        while state != State::Finalized {
            let said = tokio::select! {
                _ = ticks.tick() => {
                    state = health.lock().state;
                    if state == State::Active && !bond.active {
                        activations += 1;
                    }
                    bond.tick(state == State::Active, begin.elapsed().as_secs_f64())
                }
                Some(received) = heard.next() => match received {
                    Ok((status, _)) if status.id == name && !status.instance_id.starts_with(&own) => {
                        bond.heard(status.active)
                    }
                    _ => None,
                }
            };
            let Some(active) = said else { continue };
            let status = BondStatus {
                header: Header { stamp: wall_time(), ..Header::default() },
                id: name.clone(),
                instance_id: instance(activations),
                active,
                heartbeat_timeout: HEARTBEAT_TIMEOUT_S,
                heartbeat_period: PERIOD_S,
            };
            if let Err(reason) = publish(&publisher, status).await {
                warn!("{TOPIC}: {reason}");
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn active() -> Bond {
        let mut bond = Bond { side: Side::Silent, active: false };
        assert_eq!(bond.tick(false, 0.0), None);
        assert_eq!(bond.tick(true, 1.0), Some(true));
        bond
    }

    #[test]
    fn it_lasts_while_the_node_is_active() {
        let mut bond = active();
        assert_eq!(bond.heard(true), None);
        assert_eq!(bond.tick(true, 1000.0), Some(true));
        assert_eq!(bond.tick(false, 1001.0), Some(false));
        assert_eq!(bond.heard(true), None);
        assert_eq!(bond.tick(false, 1001.1), Some(false));
        assert_eq!(bond.heard(false), None);
        assert_eq!(bond.tick(false, 1001.2), None);
        assert_eq!(bond.tick(true, 1002.0), Some(true));
    }

    #[test]
    fn without_a_manager_it_falls_silent_until_one_comes() {
        let mut bond = active();
        assert_eq!(bond.tick(true, 10.9), Some(true));
        assert_eq!(bond.tick(true, 11.1), None);
        assert_eq!(bond.heard(true), None);
        assert_eq!(bond.tick(true, 50.0), Some(true));
    }

    #[test]
    fn a_manager_that_goes_is_answered_once() {
        let mut bond = active();
        bond.heard(true);
        assert_eq!(bond.heard(false), Some(false));
        assert_eq!(bond.heard(false), None);
        assert_eq!(bond.tick(true, 2.0), None);
        bond.heard(true);
        assert_eq!(bond.tick(true, 3.0), Some(true));
    }

    #[test]
    fn nobody_hears_a_farewell_for_ever() {
        let mut bond = active();
        bond.heard(true);
        assert_eq!(bond.tick(false, 5.0), Some(false));
        assert_eq!(bond.tick(false, 7.1), None);
    }
}
