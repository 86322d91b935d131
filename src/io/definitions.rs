//! Definitions of the message types that can be written, as the schema text of a bag.
//!
//! <https://mcap.dev/spec/registry#ros2msg>: the type's own definition, then each that it depends
//! on after a line of 80 `=` and `MSG: package/Name`. Without the comments of the originals.

/// The type's definition with all that it depends on; `None` for a type not known here.
pub fn full_text(type_name: &str) -> Option<String> {
    let short = type_name.replace("/msg/", "/");
    let mut text = definition(&short)?.to_owned();
    let mut pending = vec![short];
    let mut index = 0;
    while let Some(current) = pending.get(index).cloned() {
        for dependency in dependencies(definition(&current)?) {
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

/// The types of other messages that a definition names.
fn dependencies(definition: &str) -> impl Iterator<Item = String> {
    let types = definition.lines().filter_map(|line| line.split_whitespace().next());
    types.filter(|name| name.contains('/')).map(|name| name.split('[').next().unwrap_or(name).to_owned())
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
        assert_eq!(full_text("std_msgs/msg/String"), None);
    }
}
