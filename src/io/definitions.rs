//! Definitions of the message types that can be written, as the schema text of a bag.
//!
//! <https://mcap.dev/spec/registry#ros2msg>: the type's own definition, then each that it depends
//! on after a line of 80 `=` and `MSG: package/Name`. Standard ones without the comments of the originals.

/// The type's definition with all that it depends on; `None` for a type not known here.
pub fn full_text(type_name: &str) -> Option<String> {
    let short = type_name.replace("/msg/", "/");
    let mut text = definition(&short)?.to_owned();
    let mut pending = vec![short];
    let mut index = 0;
    while let Some(current) = pending.get(index).cloned() {
        let package = current.split('/').next().unwrap_or_default().to_owned();
        for dependency in dependencies(definition(&current)?, &package) {
            if !pending.contains(&dependency) {
                let separator = "=".repeat(80);
                text += &format!("{separator}\nMSG: {dependency}\n{}", definition(&dependency)?);
                pending.push(dependency);
            }
        }
        index += 1;
    }
    Some(text)
}

/// The types of other messages that a definition names; those of its own package go without its name.
fn dependencies(definition: &str, package: &str) -> impl Iterator<Item = String> {
    let lines = definition.lines().map(|line| line.split('#').next().unwrap_or_default());
    let types = lines.filter_map(|line| line.split_whitespace().next()?.split('[').next());
    let messages = types.filter(|name| name.contains('/') || name.starts_with(|first: char| first.is_uppercase()));
    messages.map(move |name| if name.contains('/') { name.to_owned() } else { format!("{package}/{name}") })
}

/// A message of this package, as it is in msg/.
macro_rules! own {
    ($name:literal) => {
        include_str!(concat!("../../msg/", $name, ".msg"))
    };
}

fn definition(short_name: &str) -> Option<&'static str> {
    Some(match short_name {
        "builtin_interfaces/Time" => "int32 sec\nuint32 nanosec\n",
        "std_msgs/Header" => "builtin_interfaces/Time stamp\nstring frame_id\n",
        "sensor_msgs/PointField" => {
            "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n\
             uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
        }
        "sensor_msgs/PointCloud2" => {
            "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n\
             bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
        }
        "geometry_msgs/Vector3" => "float64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/Point" => "float64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/Quaternion" => "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
        "geometry_msgs/Wrench" => "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
        "geometry_msgs/WrenchStamped" => "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n",
        "geometry_msgs/Pose" => "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "geometry_msgs/PoseWithCovariance" => "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
        "geometry_msgs/PoseWithCovarianceStamped" => "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
        "geometry_msgs/Transform" => "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        "geometry_msgs/TransformStamped" => {
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
        }
        "tf2_msgs/TFMessage" => "geometry_msgs/TransformStamped[] transforms\n",
        "std_msgs/String" => "string data\n",
        "std_msgs/ColorRGBA" => "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
        "builtin_interfaces/Duration" => "int32 sec\nuint32 nanosec\n",
        "sensor_msgs/JointState" => {
            "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
        }
        "sensor_msgs/CompressedImage" => "std_msgs/Header header\nstring format\nuint8[] data\n",
        "visualization_msgs/UVCoordinate" => "float32 u\nfloat32 v\n",
        "visualization_msgs/MeshFile" => "string filename\nuint8[] data\n",
        "visualization_msgs/Marker" => {
            "int32 ARROW=0\nint32 CUBE=1\nint32 SPHERE=2\nint32 CYLINDER=3\nint32 LINE_STRIP=4\n\
             int32 LINE_LIST=5\nint32 CUBE_LIST=6\nint32 SPHERE_LIST=7\nint32 POINTS=8\n\
             int32 TEXT_VIEW_FACING=9\nint32 MESH_RESOURCE=10\nint32 TRIANGLE_LIST=11\nint32 ARROW_STRIP=12\n\
             int32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n\
             std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
             geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\n\
             bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\n\
             string texture_resource\nsensor_msgs/CompressedImage texture\nUVCoordinate[] uv_coordinates\n\
             string text\nstring mesh_resource\nMeshFile mesh_file\nbool mesh_use_embedded_materials\n"
        }
        "visualization_msgs/MarkerArray" => "Marker[] markers\n",
        "diagnostic_msgs/KeyValue" => "string key\nstring value\n",
        "diagnostic_msgs/DiagnosticStatus" => {
            "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n\
             string hardware_id\nKeyValue[] values\n"
        }
        "diagnostic_msgs/DiagnosticArray" => "std_msgs/Header header\nDiagnosticStatus[] status\n",
        "bayesian_object_models/Counter" => own!("Counter"),
        "bayesian_object_models/Criticism" => own!("Criticism"),
        "bayesian_object_models/EdgePosterior" => own!("EdgePosterior"),
        "bayesian_object_models/Effect" => own!("Effect"),
        "bayesian_object_models/EffectParameter" => own!("EffectParameter"),
        "bayesian_object_models/ObjectPosterior" => own!("ObjectPosterior"),
        "bayesian_object_models/PartPosterior" => own!("PartPosterior"),
        "bayesian_object_models/PredictedPartPose" => own!("PredictedPartPose"),
        "bayesian_object_models/PredictedPartPoses" => own!("PredictedPartPoses"),
        "bayesian_object_models/PrismaticAxis" => own!("PrismaticAxis"),
        "bayesian_object_models/Quantity" => own!("Quantity"),
        "bayesian_object_models/ResidualScore" => own!("ResidualScore"),
        "bayesian_object_models/RevoluteAxis" => own!("RevoluteAxis"),
        "bayesian_object_models/WindowRecord" => own!("WindowRecord"),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::messages::{POINT_CLOUD_TYPE, POSE_TYPE, TF_TYPE, WRENCH_TYPE};

    #[test]
    fn every_type_read_can_be_written() {
        for (name, dependencies) in [(POINT_CLOUD_TYPE, 3), (WRENCH_TYPE, 4), (POSE_TYPE, 6), (TF_TYPE, 6)] {
            let text = full_text(name).unwrap();
            assert_eq!(text.matches("\nMSG: ").count(), dependencies, "{text}");
        }
        assert_eq!(full_text("std_msgs/msg/Empty"), None);
    }

    #[test]
    fn every_type_that_is_published_can_be_written() {
        let own = |name: &str| format!("bayesian_object_models/msg/{name}");
        let standard = ["std_msgs/msg/String", "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"];
        let published = ["ObjectPosterior", "PredictedPartPoses", "Criticism"].map(own);
        for name in standard.into_iter().chain(published.iter().map(String::as_str)) {
            assert!(full_text(name).is_some(), "{name}");
        }
        let markers = full_text("visualization_msgs/msg/MarkerArray").unwrap();
        assert!(markers.contains("MSG: visualization_msgs/UVCoordinate\n"), "{markers}");
        let posterior = full_text(&own("ObjectPosterior")).unwrap();
        assert_eq!(posterior.matches("MSG: bayesian_object_models/Quantity\n").count(), 1, "{posterior}");
    }
}
