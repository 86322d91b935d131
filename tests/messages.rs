//! The structs agree with the real ROS types, standard ones and our own, as rosidl builds them.
//!
//! Python makes a message with another value in every field and one of defaults; Rust must read the
//! same values under the same names, write the same bytes, and Python must read those again.
//! Needs `BOM_ROS_ENVIRONMENT` (`rosidl_peer/build.sh`).
#![allow(clippy::unwrap_used)]

mod ros;

use std::{collections::BTreeMap, io::Write};

use bayesian_object_models::{
    io::{
        cdr::{self, Endianness},
        messages as input,
    },
    ros::messages as own,
};
use ros2_interfaces_jazzy_serde::{
    builtin_interfaces, diagnostic_msgs, geometry_msgs, lifecycle_msgs, rcl_interfaces, rosgraph_msgs, sensor_msgs,
    std_msgs, std_srvs, tf2_msgs, visualization_msgs,
};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// What a struct makes of bytes.
struct Read {
    /// Its values by field.
    value: Value,
    /// What it writes for them.
    bytes: Vec<u8>,
}

fn read_as<'de, T: Deserialize<'de> + Serialize>(bytes: &'de [u8]) -> Result<Read, String> {
    let message: T = cdr::decode(bytes).map_err(|error| error.to_string())?;
    let value = serde_json::to_value(&message).unwrap();
    Ok(Read { value: flat(value), bytes: cdr::encode(&message, Endianness::Little).unwrap() })
}

/// Rows of a matrix one after the other, as ROS has them.
fn flat(value: Value) -> Value {
    match value {
        Value::Array(items) if items.iter().all(|item| item.is_array()) && !items.is_empty() => {
            items.into_iter().flat_map(|row| row.as_array().unwrap().clone()).collect()
        }
        Value::Array(items) => items.into_iter().map(flat).collect(),
        Value::Object(fields) => fields.into_iter().map(|(name, field)| (name, flat(field))).collect(),
        other => other,
    }
}

type Reader = fn(&[u8]) -> Result<Read, String>;

/// `package/kind/Name => struct` for each pair.
macro_rules! types {
    ($($package:ident / $kind:ident / $name:ident => $type:ty,)*) => {
        vec![$((
            concat!(stringify!($package), "/", stringify!($kind), "/", stringify!($name)),
            (|bytes| read_as::<$type>(bytes)) as Reader,
        ),)*]
    };
}

/// Every type that this program sends or receives, by the struct that it does so with.
fn types() -> Vec<(&'static str, Reader)> {
    types! {
        bayesian_object_models/msg/Counter => own::Counter,
        bayesian_object_models/msg/Criticism => own::Criticism,
        bayesian_object_models/msg/EdgePosterior => own::EdgePosterior,
        bayesian_object_models/msg/Effect => own::Effect,
        bayesian_object_models/msg/EffectParameter => own::EffectParameter,
        bayesian_object_models/msg/ObjectPosterior => own::ObjectPosterior,
        bayesian_object_models/msg/PartPosterior => own::PartPosterior,
        bayesian_object_models/msg/PredictedPartPose => own::PredictedPartPose,
        bayesian_object_models/msg/PredictedPartPoses => own::PredictedPartPoses,
        bayesian_object_models/msg/PrismaticAxis => own::PrismaticAxis,
        bayesian_object_models/msg/Quantity => own::Quantity,
        bayesian_object_models/msg/ResidualScore => own::ResidualScore,
        bayesian_object_models/msg/RevoluteAxis => own::RevoluteAxis,
        bayesian_object_models/msg/WindowRecord => own::WindowRecord,
        bayesian_object_models/msg/WrenchSegment => own::WrenchSegment,
        bayesian_object_models/srv/LoadModel_Request => own::LoadModelRequest,
        bayesian_object_models/srv/LoadModel_Response => own::LoadModelResponse,
        bayesian_object_models/srv/Predict_Request => own::PredictRequest,
        bayesian_object_models/srv/Predict_Response => own::PredictResponse,
        bayesian_object_models/srv/SaveModel_Request => own::SaveModelRequest,
        bayesian_object_models/srv/SaveModel_Response => own::SaveModelResponse,
        bond/msg/Status => own::BondStatus,
        builtin_interfaces/msg/Time => builtin_interfaces::msg::Time,
        diagnostic_msgs/msg/DiagnosticArray => diagnostic_msgs::msg::DiagnosticArray,
        geometry_msgs/msg/PoseWithCovarianceStamped => input::PoseWithCovarianceStamped,
        geometry_msgs/msg/PoseWithCovarianceStamped => geometry_msgs::msg::PoseWithCovarianceStamped,
        geometry_msgs/msg/WrenchStamped => input::WrenchStamped,
        geometry_msgs/msg/WrenchStamped => geometry_msgs::msg::WrenchStamped,
        lifecycle_msgs/msg/TransitionEvent => lifecycle_msgs::msg::TransitionEvent,
        lifecycle_msgs/srv/ChangeState_Request => lifecycle_msgs::srv::ChangeStateRequest,
        lifecycle_msgs/srv/ChangeState_Response => lifecycle_msgs::srv::ChangeStateResponse,
        lifecycle_msgs/srv/GetAvailableStates_Request => lifecycle_msgs::srv::GetAvailableStatesRequest,
        lifecycle_msgs/srv/GetAvailableStates_Response => lifecycle_msgs::srv::GetAvailableStatesResponse,
        lifecycle_msgs/srv/GetAvailableTransitions_Request => lifecycle_msgs::srv::GetAvailableTransitionsRequest,
        lifecycle_msgs/srv/GetAvailableTransitions_Response => lifecycle_msgs::srv::GetAvailableTransitionsResponse,
        lifecycle_msgs/srv/GetState_Request => lifecycle_msgs::srv::GetStateRequest,
        lifecycle_msgs/srv/GetState_Response => lifecycle_msgs::srv::GetStateResponse,
        rcl_interfaces/msg/Log => rcl_interfaces::msg::Log,
        rcl_interfaces/msg/ParameterEvent => rcl_interfaces::msg::ParameterEvent,
        rcl_interfaces/srv/DescribeParameters_Request => rcl_interfaces::srv::DescribeParametersRequest,
        rcl_interfaces/srv/DescribeParameters_Response => rcl_interfaces::srv::DescribeParametersResponse,
        rcl_interfaces/srv/GetParameterTypes_Request => rcl_interfaces::srv::GetParameterTypesRequest,
        rcl_interfaces/srv/GetParameterTypes_Response => rcl_interfaces::srv::GetParameterTypesResponse,
        rcl_interfaces/srv/GetParameters_Request => rcl_interfaces::srv::GetParametersRequest,
        rcl_interfaces/srv/GetParameters_Response => rcl_interfaces::srv::GetParametersResponse,
        rcl_interfaces/srv/ListParameters_Request => rcl_interfaces::srv::ListParametersRequest,
        rcl_interfaces/srv/ListParameters_Response => rcl_interfaces::srv::ListParametersResponse,
        rcl_interfaces/srv/SetParametersAtomically_Request => rcl_interfaces::srv::SetParametersAtomicallyRequest,
        rcl_interfaces/srv/SetParametersAtomically_Response => rcl_interfaces::srv::SetParametersAtomicallyResponse,
        rcl_interfaces/srv/SetParameters_Request => rcl_interfaces::srv::SetParametersRequest,
        rcl_interfaces/srv/SetParameters_Response => rcl_interfaces::srv::SetParametersResponse,
        rosgraph_msgs/msg/Clock => rosgraph_msgs::msg::Clock,
        sensor_msgs/msg/JointState => sensor_msgs::msg::JointState,
        sensor_msgs/msg/PointCloud2 => input::PointCloud2<'_>,
        sensor_msgs/msg/PointCloud2 => sensor_msgs::msg::PointCloud2,
        std_msgs/msg/String => std_msgs::msg::String,
        std_srvs/srv/Trigger_Request => std_srvs::srv::TriggerRequest,
        std_srvs/srv/Trigger_Response => std_srvs::srv::TriggerResponse,
        tf2_msgs/msg/TFMessage => input::TfMessage,
        tf2_msgs/msg/TFMessage => tf2_msgs::msg::TFMessage,
        visualization_msgs/msg/MarkerArray => visualization_msgs::msg::MarkerArray,
    }
}

/// What Python made of one type.
#[derive(Deserialize)]
struct Made {
    r#type: String,
    variant: String,
    bytes: String,
    value: Value,
    constants: BTreeMap<String, u64>,
}

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len() / 2).map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).unwrap()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Where the bytes of two writers differ, but for padding: there a writer may leave anything, and a
/// reader must not care. Theirs may be longer: rmw's estimate has room for what empty sequences might
/// align, and what is behind the last field means nothing.
fn differences(read: Reader, theirs: &[u8], ours: &[u8]) -> Vec<usize> {
    let is_padding = |index: usize| {
        let mut changed = theirs.to_vec();
        changed[index] ^= 0x55;
        read(&changed).is_ok_and(|read| read.bytes == ours)
    };
    let differ = (0..ours.len()).filter(|&index| theirs.get(index) != Some(&ours[index]));
    differ.filter(|&index| index >= theirs.len() || !is_padding(index)).collect()
}

#[test]
fn every_type_agrees_with_rosidl() {
    let Some(environment) = ros::environment() else { return };
    let types = types();
    let mut arguments = vec!["write"];
    arguments.extend(types.iter().map(|(name, _)| *name));
    let lines = ros::python(&environment, "rosidl_peer/exchange.py", &arguments);
    let made: Vec<Made> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(made.len(), 2 * types.len());
    let mut returned = Vec::new();
    for (made, (name, read)) in made.iter().zip(types.iter().flat_map(|pair| [pair; 2])) {
        assert_eq!(made.r#type, *name);
        let theirs = unhex(&made.bytes);
        let ours = read(&theirs).unwrap_or_else(|error| panic!("{name}, {}: {error}", made.variant));
        assert_eq!(ours.value, made.value, "{name}, {}", made.variant);
        // rosidl gives a message without fields one that is not seen; nobody is sent such a message.
        if made.value != json!({}) {
            let differ = differences(*read, &theirs, &ours.bytes);
            assert!(differ.is_empty(), "{name}, {}: {differ:?}\n{theirs:02x?}\n{:02x?}", made.variant, ours.bytes);
            returned.push(json!({"type": name, "variant": made.variant, "bytes": hex(&ours.bytes)}));
        }
    }
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(json!(returned).to_string().as_bytes()).unwrap();
    let count = ros::python(&environment, "rosidl_peer/exchange.py", &["read", file.path().to_str().unwrap()]);
    assert_eq!(count.trim(), returned.len().to_string());

    let constants = |name: &str| {
        let made = made.iter().find(|made| made.r#type == format!("{}/msg/{name}", own::PACKAGE)).unwrap();
        made.constants.iter().map(|(name, value)| (name.clone(), *value)).collect::<Vec<_>>()
    };
    let pairs = |pairs: &[(&str, u8)]| {
        let mut pairs: Vec<_> = pairs.iter().map(|(name, value)| ((*name).to_owned(), u64::from(*value))).collect();
        pairs.sort();
        pairs
    };
    let expected = [
        ("INFORMED_BY_PRIOR", own::Quantity::INFORMED_BY_PRIOR),
        ("INFORMED_BY_DYNAMICS", own::Quantity::INFORMED_BY_DYNAMICS),
    ];
    assert_eq!(constants("Quantity"), pairs(&expected));
    let expected = [
        ("VERDICT_INSUFFICIENT", own::Criticism::VERDICT_INSUFFICIENT),
        ("VERDICT_ADEQUATE", own::Criticism::VERDICT_ADEQUATE),
        ("VERDICT_EFFECT_FOUND", own::Criticism::VERDICT_EFFECT_FOUND),
        ("VERDICT_UNEXPLAINED", own::Criticism::VERDICT_UNEXPLAINED),
    ];
    assert_eq!(constants("Criticism"), pairs(&expected));
    let expected = [
        ("WRENCH_HELD", own::PredictedPartPoses::WRENCH_HELD),
        ("WRENCH_PLANNED", own::PredictedPartPoses::WRENCH_PLANNED),
    ];
    assert_eq!(constants("PredictedPartPoses"), pairs(&expected));
}

/// What is defined is in the list above.
#[test]
fn every_definition_is_compared() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let listed: Vec<&str> = types().into_iter().map(|(name, _)| name).collect();
    for (folder, parts) in [("msg", &[""][..]), ("srv", &["_Request", "_Response"])] {
        for entry in std::fs::read_dir(root.join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_str().unwrap();
            for part in parts {
                let full = format!("{}/{folder}/{name}{part}", own::PACKAGE);
                assert!(listed.contains(&full.as_str()), "{full}");
            }
        }
    }
}
