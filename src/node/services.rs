//! Services: parameters as rcl has them, the lifecycle as its managers expect it, and the node's own.

use std::future::Future;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::Context as _;
use ros2_client::Server;
use ros2_interfaces_jazzy_serde::lifecycle_msgs::{
    msg::{Transition as TransitionMessage, TransitionEvent},
    srv::{
        ChangeStateRequest, ChangeStateResponse, GetAvailableStatesRequest, GetAvailableStatesResponse,
        GetAvailableTransitionsRequest, GetAvailableTransitionsResponse, GetStateRequest, GetStateResponse,
    },
};
use ros2_interfaces_jazzy_serde::rcl_interfaces::{
    msg::{ListParametersResult, Parameter, ParameterEvent, ParameterValue, SetParametersResult},
    srv::{
        DescribeParametersRequest, DescribeParametersResponse, GetParameterTypesRequest, GetParameterTypesResponse,
        GetParametersRequest, GetParametersResponse, ListParametersRequest, ListParametersResponse,
        SetParametersAtomicallyRequest, SetParametersAtomicallyResponse, SetParametersRequest, SetParametersResponse,
    },
};
use ros2_interfaces_jazzy_serde::std_srvs::srv::{TriggerRequest, TriggerResponse};
use serde::{Serialize, de::DeserializeOwned};
use tokio::sync::{Notify, oneshot};
use tracing::{info, warn};

use super::health::{SharedHealth, since_epoch, wall_time};
use super::inbox::Inbox;
use super::lifecycle::{State, Transition};
use super::parameters::Parameters;
use super::participant::{Participant, Wire};
use super::planning;
use super::publications::{Outputs, Publication};
use super::stream::Command;
use super::value::Value;
use crate::io::config::InputConfig;
use crate::io::model_file::{SavedModel, write_model};
use crate::io::output_file::OutputFile;
use crate::ros::messages::{
    self, LoadModelRequest, LoadModelResponse, PredictRequest, PredictResponse, SaveModelRequest, SaveModelResponse,
};

/// What services ask and change; cheap to share.
#[derive(Clone)]
pub struct Managed {
    /// The node's full name.
    pub name: String,
    /// The parameters' values.
    pub parameters: Arc<Mutex<Parameters>>,
    /// Names of topics as resolved at the start.
    pub input: InputConfig,
    /// To the stream.
    pub inbox: Arc<Inbox<Command>>,
    /// To the network.
    pub outputs: Outputs,
    /// Where the state is seen.
    pub health: SharedHealth,
    /// Told when the node is shut down.
    pub ended: Arc<Notify>,
}

impl Managed {
    /// To read or to change.
    pub fn parameters(&self) -> MutexGuard<'_, Parameters> {
        self.parameters.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The lifecycle's state.
    pub fn state(&self) -> State {
        self.health.lock().state
    }

    /// Goes through a transition.
    ///
    /// # Errors
    /// It is none of this state, or the parameters make no configuration.
    pub fn change(&self, asked: &TransitionMessage) -> Result<State, String> {
        let start = self.state();
        let (transition, message, goal) = start.transition(asked)?;
        match transition {
            Transition::Configure => {
                let parameters = self.parameters();
                let config = parameters.config()?;
                let mut settings = config.pipeline_settings(parameters.root());
                (settings.predict, settings.live) = (true, true);
                let input = with_topics(&config.input, &self.input);
                self.inbox.tell(Command::Configure(Box::new((input, settings))));
                self.inbox.tell(Command::PublishTf(parameters.tf_prefix()));
            }
            Transition::CleanUp => self.inbox.tell(Command::CleanUp),
            Transition::Activate => self.inbox.tell(Command::Activate),
            Transition::Deactivate => self.inbox.tell(Command::Deactivate),
            Transition::ShutDown => {
                self.inbox.tell(Command::CleanUp);
                self.ended.notify_one();
            }
        }
        self.health.lock().state = goal;
        info!("{}: {} → {}", message.label, start.message().label, goal.message().label);
        self.outputs.send(Publication::Transition(TransitionEvent {
            timestamp: since_epoch().as_nanos().try_into().unwrap_or(u64::MAX),
            transition: message,
            start_state: start.message(),
            goal_state: goal.message(),
        }));
        Ok(goal)
    }

    /// Where the parts would be under a planned wrench.
    async fn predict(&self, request: PredictRequest) -> PredictResponse {
        let answered = async {
            let (reply, ground) = oneshot::channel();
            self.inbox.tell(Command::Planner(request.header.frame_id.clone(), reply));
            let ground = ground.await.context("the node is shutting down")?.map_err(anyhow::Error::msg)?;
            tokio::task::spawn_blocking(move || planning::answer(&ground, &request)).await?
        };
        let answered: anyhow::Result<PredictResponse> = answered.await;
        answered.unwrap_or_else(|error| PredictResponse { message: reason(&error), ..PredictResponse::default() })
    }

    /// Writes what was learned, while the stream goes on.
    async fn save(&self, path: PathBuf) -> anyhow::Result<()> {
        let (reply, snapshot) = oneshot::channel();
        self.inbox.tell(Command::Snapshot(reply));
        let (snapshot, bags) =
            snapshot.await.context("the node is shutting down")?.context("no interaction was seen: nothing to save")?;
        tokio::task::spawn_blocking(move || {
            let mut file = OutputFile::create(&path)?;
            write_model(&mut file, &bags, &snapshot.saved()).with_context(|| path.display().to_string())?;
            file.finish().map_err(anyhow::Error::from)
        })
        .await?
    }

    /// Reads what was learned before, and goes on from there.
    async fn load(&self, path: PathBuf) -> anyhow::Result<()> {
        let model = tokio::task::spawn_blocking(move || SavedModel::from_file(&path)).await??;
        let (reply, outcome) = oneshot::channel();
        self.inbox.tell(Command::Resume(Box::new(model), reply));
        outcome.await.context("the node is shutting down")?.map_err(anyhow::Error::msg)
    }

    fn set(&self, parameters: &[Parameter]) -> SetParametersResult {
        let settings: Vec<(String, Value)> =
            parameters.iter().map(|parameter| (parameter.name.clone(), Value::from(&parameter.value))).collect();
        let unconfigured = self.state() == State::Unconfigured;
        let outcome = self.parameters().set(&settings, unconfigured);
        if let Err(reason) = outcome {
            return SetParametersResult { successful: false, reason };
        }
        self.inbox.tell(Command::PublishTf(self.parameters().tf_prefix()));
        let mut event = ParameterEvent { node: self.name.clone(), ..ParameterEvent::default() };
        event.stamp = wall_time();
        event.changed_parameters = parameters.to_vec();
        self.outputs.send(Publication::ParameterEvent(event));
        SetParametersResult { successful: true, reason: String::new() }
    }

    fn list(&self, prefixes: &[String], depth: u64) -> ListParametersResult {
        let parameters = self.parameters();
        let wanted = |name: &&str| {
            let below = |prefix: &String| {
                if prefix == name { Some("") } else { name.strip_prefix(prefix.as_str())?.strip_prefix('.') }
            };
            let rest = if prefixes.is_empty() { Some(*name) } else { prefixes.iter().find_map(below) };
            // Depth counts the separators below the prefix; 0: any.
            rest.is_some_and(|rest| depth == 0 || (rest.matches('.').count() as u64) < depth)
        };
        let names: Vec<String> = parameters.names().filter(wanted).map(str::to_owned).collect();
        let mut above: Vec<String> = names
            .iter()
            .filter(|_| depth > 0)
            .filter_map(|name| name.rsplit_once('.'))
            .map(|(prefix, _)| prefix.to_owned())
            .collect();
        above.dedup();
        ListParametersResult { names, prefixes: above }
    }
}

/// The configuration with the names of topics as they are on the network.
pub fn with_topics(config: &InputConfig, resolved: &InputConfig) -> InputConfig {
    let mut config = config.clone();
    config.clouds.clone_from(&resolved.clouds);
    config.poses.clone_from(&resolved.poses);
    config.tf.clone_from(&resolved.tf);
    config.tf_static.clone_from(&resolved.tf_static);
    for (wrench, resolved) in config.wrenches.iter_mut().zip(&resolved.wrenches) {
        wrench.topic.clone_from(&resolved.topic);
    }
    config
}

/// Why something failed, in one line; many an error says its cause itself.
fn reason(error: &anyhow::Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// Answers every request, in order.
fn answer<Q, A, F>(server: Server<Wire<Q>, Wire<A>>, respond: impl Fn(Q) -> F + Send + 'static)
where
    Q: Serialize + DeserializeOwned + Send + Sync + 'static,
    A: Serialize + DeserializeOwned + Send + Sync + 'static,
    F: Future<Output = A> + Send,
{
    tokio::spawn(async move {
        loop {
            match server.async_receive_request().await {
                Ok((id, Wire(request))) => {
                    let response = respond(request).await;
                    if let Err(error) = server.async_send_response(id, Wire(response)).await {
                        warn!("an answer could not be sent: {error}");
                    }
                }
                Err(error) => warn!("a request could not be read: {error}"),
            }
        }
    });
}

/// Serves all there is.
///
/// # Errors
/// A name that is none, or DDS.
pub fn serve(participant: &mut Participant, managed: &Managed) -> anyhow::Result<()> {
    serve_parameters(participant, managed)?;
    serve_lifecycle(participant, managed)?;
    let own = managed.clone();
    let server = participant.serve::<TriggerRequest, TriggerResponse>("~/reset", "std_srvs/srv/Trigger")?;
    answer(server, move |_| {
        let (done, waiting) = oneshot::channel();
        own.inbox.tell(Command::Reset(done));
        async move {
            let success = waiting.await.is_ok();
            let message = if success { "what was learned is forgotten" } else { "the node is shutting down" };
            TriggerResponse { success, message: message.to_owned() }
        }
    });
    let own = managed.clone();
    let type_name = format!("{}/srv/Predict", messages::PACKAGE);
    let server = participant.serve::<PredictRequest, PredictResponse>("~/predict", &type_name)?;
    answer(server, move |request: PredictRequest| {
        let own = own.clone();
        async move { own.predict(request).await }
    });
    let own = managed.clone();
    let type_name = format!("{}/srv/SaveModel", messages::PACKAGE);
    let server = participant.serve::<SaveModelRequest, SaveModelResponse>("~/save_model", &type_name)?;
    answer(server, move |request: SaveModelRequest| {
        let own = own.clone();
        async move {
            match own.save(PathBuf::from(&request.path)).await {
                Ok(()) => SaveModelResponse { success: true, message: format!("saved to {}", request.path) },
                Err(error) => SaveModelResponse { success: false, message: reason(&error) },
            }
        }
    });
    let own = managed.clone();
    let type_name = format!("{}/srv/LoadModel", messages::PACKAGE);
    let server = participant.serve::<LoadModelRequest, LoadModelResponse>("~/load_model", &type_name)?;
    answer(server, move |request: LoadModelRequest| {
        let own = own.clone();
        async move {
            match own.load(PathBuf::from(&request.path)).await {
                Ok(()) => LoadModelResponse { success: true, message: format!("goes on from {}", request.path) },
                Err(error) => LoadModelResponse { success: false, message: reason(&error) },
            }
        }
    });
    Ok(())
}

/// Serves a request that is answered at once.
fn at_once<Q, A>(
    participant: &mut Participant,
    managed: &Managed,
    (name, type_name): (&str, &str),
    respond: impl Fn(&Managed, Q) -> A + Send + Sync + 'static,
) -> anyhow::Result<()>
where
    Q: Serialize + DeserializeOwned + Clone + Send + Sync + 'static,
    A: Serialize + DeserializeOwned + Send + Sync + 'static,
{
    let server = participant.serve::<Q, A>(name, type_name)?;
    let own = managed.clone();
    answer(server, move |request| std::future::ready(respond(&own, request)));
    Ok(())
}

fn serve_parameters(participant: &mut Participant, managed: &Managed) -> anyhow::Result<()> {
    let service = ("~/get_parameters", "rcl_interfaces/srv/GetParameters");
    at_once(participant, managed, service, |managed, request: GetParametersRequest| {
        let parameters = managed.parameters();
        let value = |name: &String| ParameterValue::from(parameters.get(name).unwrap_or(&Value::NotSet));
        GetParametersResponse { values: request.names.iter().map(value).collect() }
    })?;
    let service = ("~/get_parameter_types", "rcl_interfaces/srv/GetParameterTypes");
    at_once(participant, managed, service, |managed, request: GetParameterTypesRequest| {
        let parameters = managed.parameters();
        let of = |name: &String| parameters.get(name).map_or(0, Value::type_number);
        GetParameterTypesResponse { types: request.names.iter().map(of).collect() }
    })?;
    let service = ("~/set_parameters", "rcl_interfaces/srv/SetParameters");
    at_once(participant, managed, service, |managed, request: SetParametersRequest| SetParametersResponse {
        results: request.parameters.iter().map(|one| managed.set(std::slice::from_ref(one))).collect(),
    })?;
    let service = ("~/set_parameters_atomically", "rcl_interfaces/srv/SetParametersAtomically");
    at_once(participant, managed, service, |managed, request: SetParametersAtomicallyRequest| {
        SetParametersAtomicallyResponse { result: managed.set(&request.parameters) }
    })?;
    let service = ("~/list_parameters", "rcl_interfaces/srv/ListParameters");
    at_once(participant, managed, service, |managed, request: ListParametersRequest| ListParametersResponse {
        result: managed.list(&request.prefixes, request.depth),
    })?;
    let service = ("~/describe_parameters", "rcl_interfaces/srv/DescribeParameters");
    at_once(participant, managed, service, |managed, request: DescribeParametersRequest| {
        let parameters = managed.parameters();
        DescribeParametersResponse {
            descriptors: request.names.iter().map(|name| parameters.descriptor(name)).collect(),
        }
    })
}

fn serve_lifecycle(participant: &mut Participant, managed: &Managed) -> anyhow::Result<()> {
    let service = ("~/change_state", "lifecycle_msgs/srv/ChangeState");
    at_once(participant, managed, service, |managed, request: ChangeStateRequest| {
        let outcome = managed.change(&request.transition);
        if let Err(reason) = &outcome {
            warn!("{reason}");
        }
        ChangeStateResponse { success: outcome.is_ok() }
    })?;
    let service = ("~/get_state", "lifecycle_msgs/srv/GetState");
    at_once(participant, managed, service, |managed, _: GetStateRequest| GetStateResponse {
        current_state: managed.state().message(),
    })?;
    let service = ("~/get_available_states", "lifecycle_msgs/srv/GetAvailableStates");
    at_once(participant, managed, service, |_, _: GetAvailableStatesRequest| GetAvailableStatesResponse {
        available_states: State::messages(),
    })?;
    let service = ("~/get_available_transitions", "lifecycle_msgs/srv/GetAvailableTransitions");
    at_once(participant, managed, service, |managed, _: GetAvailableTransitionsRequest| {
        GetAvailableTransitionsResponse { available_transitions: managed.state().transitions() }
    })?;
    let service = ("~/get_transition_graph", "lifecycle_msgs/srv/GetAvailableTransitions");
    at_once(participant, managed, service, |_, _: GetAvailableTransitionsRequest| GetAvailableTransitionsResponse {
        available_transitions: State::all_transitions(),
    })
}
