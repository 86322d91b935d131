//! The states of a managed node, as rcl_lifecycle has them.
//!
//! <https://design.ros2.org/articles/node_lifecycle.html>. Numbers as in lifecycle_msgs.

use ros2_interfaces_jazzy_serde::lifecycle_msgs::msg::TransitionDescription;
use ros2_interfaces_jazzy_serde::lifecycle_msgs::msg::{State as StateMessage, Transition as TransitionMessage};

/// A primary state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// Set up from nothing; parameters can be set.
    Unconfigured = 1,
    /// Ready, passing over what comes.
    Inactive = 2,
    /// At work.
    Active = 3,
    /// At its end.
    Finalized = 4,
}

/// A transition that can be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transition {
    /// The parameters as they are now are taken over.
    Configure,
    /// What was learned is forgotten.
    CleanUp,
    /// Work begins.
    Activate,
    /// Work stops; what was learned is kept.
    Deactivate,
    /// The node ends.
    ShutDown,
}

/// Each transition with its numbers in lifecycle_msgs, its label, and where it leads from each state.
const TRANSITIONS: [(Transition, u8, &str, State, State); 7] = [
    (Transition::Configure, 1, "configure", State::Unconfigured, State::Inactive),
    (Transition::CleanUp, 2, "cleanup", State::Inactive, State::Unconfigured),
    (Transition::Activate, 3, "activate", State::Inactive, State::Active),
    (Transition::Deactivate, 4, "deactivate", State::Active, State::Inactive),
    (Transition::ShutDown, 5, "shutdown", State::Unconfigured, State::Finalized),
    (Transition::ShutDown, 6, "shutdown", State::Inactive, State::Finalized),
    (Transition::ShutDown, 7, "shutdown", State::Active, State::Finalized),
];

/// The states with transitions under way, for those who ask which there are.
const UNDER_WAY: [(u8, &str); 6] = [
    (10, "configuring"),
    (11, "cleaningup"),
    (12, "shuttingdown"),
    (13, "activating"),
    (14, "deactivating"),
    (15, "errorprocessing"),
];

impl State {
    const ALL: [Self; 4] = [Self::Unconfigured, Self::Inactive, Self::Active, Self::Finalized];

    /// As lifecycle_msgs has it.
    pub fn message(self) -> StateMessage {
        let label = match self {
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
        };
        StateMessage { id: self as u8, label: label.to_owned() }
    }

    /// Every state there is.
    pub fn messages() -> Vec<StateMessage> {
        let unknown = StateMessage { id: 0, label: "unknown".to_owned() };
        let under_way = UNDER_WAY.iter().map(|(id, label)| StateMessage { id: *id, label: (*label).to_owned() });
        [unknown].into_iter().chain(Self::ALL.map(Self::message)).chain(under_way).collect()
    }

    /// What can be asked for in this state.
    pub fn transitions(self) -> Vec<TransitionDescription> {
        descriptions(|from| from == self)
    }

    /// Every transition there is.
    pub fn all_transitions() -> Vec<TransitionDescription> {
        descriptions(|_| true)
    }

    /// The transition asked for by number, or by label where there is one, and where it leads.
    ///
    /// # Errors
    /// Why it is none of this state.
    pub fn transition(self, asked: &TransitionMessage) -> Result<(Transition, TransitionMessage, State), String> {
        let by_label = !asked.label.is_empty();
        let is_asked = |id: u8, label: &str| if by_label { label == asked.label } else { id == asked.id };
        TRANSITIONS
            .iter()
            .find(|(_, id, label, from, _)| *from == self && is_asked(*id, label))
            .map(|(transition, id, label, _, to)| {
                (*transition, TransitionMessage { id: *id, label: (*label).to_owned() }, *to)
            })
            .ok_or_else(|| {
                let named = if by_label { asked.label.clone() } else { asked.id.to_string() };
                format!("no transition `{named}` in state {}", self.message().label)
            })
    }
}

fn descriptions(wanted: impl Fn(State) -> bool) -> Vec<TransitionDescription> {
    let described = TRANSITIONS.iter().filter(|(_, _, _, from, _)| wanted(*from));
    described
        .map(|(_, id, label, from, to)| TransitionDescription {
            transition: TransitionMessage { id: *id, label: (*label).to_owned() },
            start_state: from.message(),
            goal_state: to.message(),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ask(state: State, id: u8, label: &str) -> Result<State, String> {
        state.transition(&TransitionMessage { id, label: label.into() }).map(|(_, _, to)| to)
    }

    #[test]
    fn a_manager_brings_it_up_and_down() {
        let mut state = State::Unconfigured;
        for (id, expected) in [(1, State::Inactive), (3, State::Active), (4, State::Inactive), (2, State::Unconfigured)]
        {
            state = ask(state, id, "").unwrap();
            assert_eq!(state, expected);
        }
        assert_eq!(ask(State::Active, 0, "shutdown"), Ok(State::Finalized));
        assert_eq!(ask(State::Active, 7, ""), Ok(State::Finalized));
        assert_eq!(ask(State::Active, 1, "").unwrap_err(), "no transition `1` in state active");
        assert!(ask(State::Finalized, 1, "").is_err());
        assert_eq!(State::Inactive.transitions().len(), 3);
        assert_eq!(State::messages().len(), 11);
    }
}
